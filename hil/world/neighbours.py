"""What robots in one room do to one another: the wakes of their rotors, and the contact of spheres around them.

Rotors give the air the momentum that carries their robot. Its wake is a round jet that keeps this momentum and spreads
linearly, with a Gaussian profile; a robot inside has that wind, the sum of all wakes. Spheres that overlap push each other
apart along the line of their centres, as spring and damper. Frame W of the room; all values hold for one instant.
"""

import math
from typing import Annotated

from firmware_py.core.subset import F64s, Integer, Struct, f64, i32
from hil.world.fixed_order import compiled, exp

ROBOTS_MAX = 16
AIR_DENSITY = 1.2  # [kg/m3]


class Neighbours(Struct):
    """The robots of a swarm; rows beyond `count` are unused."""

    count: i32
    flies: Annotated[F64s, ROBOTS_MAX]  # 1: it is in the air; 0: its flight is over
    # Inputs
    p_WB: Annotated[F64s, ROBOTS_MAX, 3]  # [m]
    v_WB: Annotated[F64s, ROBOTS_MAX, 3]  # [m/s]
    lift_W: Annotated[F64s, ROBOTS_MAX, 3]  # [N] by which the rotors carry the robot
    # Outputs
    wake_W: Annotated[F64s, ROBOTS_MAX, 3]  # [m/s] of the air at a robot, by the others
    touch_W: Annotated[F64s, ROBOTS_MAX, 3]  # [N] of the others on a robot
    least: f64  # [m] between two that fly; inf: fewer than two do
    one: i32  # the rows of these two
    other: i32
    # Constants
    radius: f64  # [m] of a sphere
    stiffness: f64  # [N/m]
    damping: f64  # [N s/m]
    wake: f64  # factor on the speed of a wake
    wake_radius: f64  # [m] at the rotors
    wake_spread: f64  # growth of the radius per length


@compiled
def blow_at(near: Neighbours, above: Integer, below: Integer) -> None:
    """Add the wake of one robot at the place of another."""
    lift, p = near.lift_W, near.p_WB
    lx, ly, lz = lift[above, 0], lift[above, 1], lift[above, 2]
    thrust = math.sqrt(lx * lx + ly * ly + lz * lz)
    if thrust <= 0.0:
        return
    ax, ay, az = -lx / thrust, -ly / thrust, -lz / thrust
    dx, dy, dz = p[below, 0] - p[above, 0], p[below, 1] - p[above, 1], p[below, 2] - p[above, 2]
    along = dx * ax + dy * ay + dz * az
    if along <= 0.0:
        return
    aside2 = max(dx * dx + dy * dy + dz * dz - along * along, 0.0)
    width = near.wake_radius + near.wake_spread * along
    # a Gaussian jet of speed w exp(-(r / b)2) has the momentum flow rho pi b2 w2 / 2
    speed = near.wake * math.sqrt(2.0 * thrust / (AIR_DENSITY * math.pi)) / width
    speed = speed * exp(-aside2 / (width * width))
    near.wake_W[below, 0] = near.wake_W[below, 0] + speed * ax
    near.wake_W[below, 1] = near.wake_W[below, 1] + speed * ay
    near.wake_W[below, 2] = near.wake_W[below, 2] + speed * az


@compiled
def meet(near: Neighbours, a: Integer, b: Integer) -> None:
    """Record the distance of two robots, and push them apart where their spheres overlap."""
    p, v, touch = near.p_WB, near.v_WB, near.touch_W
    dx, dy, dz = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    if distance < near.least:
        near.least = distance
        near.one = i32(a)
        near.other = i32(b)
    depth = 2.0 * near.radius - distance
    if depth <= 0.0 or distance <= 0.0:
        return
    ux, uy, uz = dx / distance, dy / distance, dz / distance
    apart = (v[b, 0] - v[a, 0]) * ux + (v[b, 1] - v[a, 1]) * uy + (v[b, 2] - v[a, 2]) * uz
    force = max(near.stiffness * depth - near.damping * apart, 0.0)
    fx, fy, fz = force * ux, force * uy, force * uz
    touch[a, 0], touch[a, 1], touch[a, 2] = touch[a, 0] - fx, touch[a, 1] - fy, touch[a, 2] - fz
    touch[b, 0], touch[b, 1], touch[b, 2] = touch[b, 0] + fx, touch[b, 1] + fy, touch[b, 2] + fz


@compiled
def interact(near: Neighbours) -> None:
    """Compute wakes, contacts and the least distance from places, speeds and lifts."""
    near.least = math.inf
    for a in range(near.count):
        for i in range(3):
            near.wake_W[a, i] = 0.0
            near.touch_W[a, i] = 0.0
    for a in range(near.count):
        for b in range(near.count):
            if near.flies[a] != 0.0 and near.flies[b] != 0.0:
                if a < b:
                    meet(near, a, b)
                if a != b and near.wake > 0.0:
                    blow_at(near, a, b)
