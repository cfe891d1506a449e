"""The flow's force and torque on the body: air at five points, nine plates, identified correction; compiled.

Plates (paper, "Force analysis"): F_k = 1/2 rho C_D A_k (w_k.n_k)|w_k.n_k| n_k with the wind w_k at plate k.
The correction (docs/explanation/plant.md) then scales and adds so that the linearisation equals a chosen set of constants.
"""

import math

import numpy as np
from numpy.typing import NDArray

from firmware_py.elementary import tan
from hil.world import layout as at
from hil.world.fixed_order import compiled, sine_ahead

# Slope of the wind above which identified stiffness does not grow.
TILT_MAX = tan(math.radians(35.0))
LIFT_U4_MAX = 0.55  # [rad] largest |u4| in the fit of the lift ratio l(u4)
UPFLOW_MIN = 0.1  # [m/s] keeps the slope of the wind finite when the air stands still

State = NDArray[np.float64]  # (layout.SIZE,)
Wrench = tuple[float, float, float, float, float, float]  # force [N] and torque [N m]


@compiled
def limit(value: float, low: float, high: float) -> float:
    """Return `value` inside [low, high]."""
    return min(max(value, low), high)


@compiled
def orient(s: State) -> None:
    """Write R_WB of q_WB."""
    w, x, y, z = s[at.Q], s[at.Q + 1], s[at.Q + 2], s[at.Q + 3]
    r = at.R
    s[r], s[r + 1], s[r + 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    s[r + 3], s[r + 4], s[r + 5] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    s[r + 6], s[r + 7], s[r + 8] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@compiled
def upflow(s: State, x: float, y: float) -> float:
    """Return the vertical mean flow [m/s] over (x, y) [m, W] at the height of the body."""
    reach = (x * x + y * y) / (s[at.PROFILE_RADIUS] * s[at.PROFILE_RADIUS])
    height = s[at.P + 2] - s[at.HOVER_HEIGHT]
    slope = 1.0 - s[at.HEIGHT_SLOPE] * height
    flow: float = s[at.FAN] * s[at.SPEED] / (1.0 + reach * reach * reach) * slope
    depth = s[at.OCCLUSION + 3]
    if depth > 0.0:
        dx, dy = x - s[at.OCCLUSION], y - s[at.OCCLUSION + 1]
        reach = (dx * dx + dy * dy) / (s[at.OCCLUSION + 2] * s[at.OCCLUSION + 2])
        flow *= 1.0 - depth / (1.0 + reach * reach * reach)
    return flow


@compiled
def blow(s: State) -> None:
    """Write the air at the centre of mass (FLOW, W) and the wind relative to the body there (WIND, B)."""
    x, y = s[at.P], s[at.P + 1]
    spread = (x * x + y * y) / (s[at.GUST_RADIUS] * s[at.GUST_RADIUS])
    s[at.ROUGHNESS] = s[at.FAN] * s[at.GUST_SCALE] * min(1.0 + spread * spread, s[at.GUST_GROWTH_MAX])
    for i in range(3):
        s[at.FLOW + i] = s[at.ROUGHNESS] * (s[at.GUSTS + i] + s[at.GUSTS + 3 + i]) + s[at.SIDE_WIND + i]
    s[at.UPFLOW] = upflow(s, x, y)
    s[at.FLOW + 2] += s[at.UPFLOW]
    wx, wy, wz = s[at.FLOW] - s[at.V], s[at.FLOW + 1] - s[at.V + 1], s[at.FLOW + 2] - s[at.V + 2]
    for i in range(3):
        s[at.WIND + i] = s[at.R + i] * wx + s[at.R + 3 + i] * wy + s[at.R + 6 + i] * wz


@compiled
def flap_upflow(s: State, flap: int) -> float:
    """Return by how much [m/s] the vertical flow at a flap exceeds that at the centre of mass."""
    x, y, z, r = s[at.FLOW_POINTS + 2 * flap], s[at.FLOW_POINTS + 2 * flap + 1], s[at.AXIS_HEIGHT], at.R
    there_x = s[at.P] + s[r] * x + s[r + 1] * y + s[r + 2] * z
    there_y = s[at.P + 1] + s[r + 3] * x + s[r + 4] * y + s[r + 5] * z
    gust = s[at.ROUGHNESS] * (s[at.GUSTS + 6 + flap] + s[at.GUSTS + 10 + flap])
    more: float = upflow(s, there_x, there_y) - s[at.UPFLOW] + gust
    return more


@compiled
def strike(s: State, plate: int, c: float, d: float, ux: float, uy: float, uz: float) -> Wrench:
    """Return force and torque of a flap's plate at a cosine and sine, in the wind (ux, uy, uz) at the flap; in B."""
    n, r = at.NORMAL + 9 * plate, at.CENTRE + 9 * plate
    ox, oy, oz = s[at.OMEGA], s[at.OMEGA + 1], s[at.OMEGA + 2]
    nx = s[n] + s[n + 3] * c + s[n + 6] * d
    ny = s[n + 1] + s[n + 4] * c + s[n + 7] * d
    nz = s[n + 2] + s[n + 5] * c + s[n + 8] * d
    rx = s[r] + s[r + 3] * c + s[r + 6] * d
    ry = s[r + 1] + s[r + 4] * c + s[r + 7] * d
    rz = s[r + 2] + s[r + 5] * c + s[r + 8] * d
    wn = (ux - oy * rz + oz * ry) * nx + (uy - oz * rx + ox * rz) * ny
    wn += (uz - ox * ry + oy * rx) * nz
    f = s[at.PRESSURE] * s[at.AREA + plate] * wn * abs(wn)
    fx, fy, fz = f * nx, f * ny, f * nz
    return fx, fy, fz, ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx


@compiled
def added(a: Wrench, b: Wrench) -> Wrench:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@compiled
def press(s: State) -> None:
    """Write force and torque of all plates at their current (DRAG) and hover angles (HOVER_DRAG), in B."""
    bz = s[at.WIND + 2]
    base = s[at.PRESSURE] * s[at.BASE_AREA] * bz * abs(bz)
    s[at.PLATE_FORCES], s[at.PLATE_FORCES + 1], s[at.PLATE_FORCES + 2] = 0.0, 0.0, base
    total = hover = (0.0, 0.0, base, 0.0, 0.0, 0.0)
    for flap in range(4):
        more = flap_upflow(s, flap)
        ux = s[at.WIND] + s[at.R + 6] * more
        uy = s[at.WIND + 1] + s[at.R + 7] * more
        uz = s[at.WIND + 2] + s[at.R + 8] * more
        angle = -s[at.FLAPS + flap] if flap % 2 == 0 else s[at.FLAPS + flap]  # 0 and 2 are mirror images of 1
        c, d = sine_ahead(angle, 1), sine_ahead(angle, 0)
        flat, kink = strike(s, 2 * flap, c, d, ux, uy, uz), strike(s, 2 * flap + 1, c, d, ux, uy, uz)
        total = added(added(total, flat), kink)
        arrow = at.PLATE_FORCES + 3 + 3 * flap
        s[arrow], s[arrow + 1], s[arrow + 2] = flat[0] + kink[0], flat[1] + kink[1], flat[2] + kink[2]
        if s[at.CORRECTED] != 0.0:
            c, d = s[at.HOVER_TURN], s[at.HOVER_TURN + 1]
            hover = added(hover, strike(s, 2 * flap, c, d, ux, uy, uz))
            hover = added(hover, strike(s, 2 * flap + 1, c, d, ux, uy, uz))
    for i in range(6):
        s[at.DRAG + i], s[at.HOVER_DRAG + i] = total[i], hover[i]


@compiled
def correct(s: State) -> None:
    """Scale and add to DRAG so that the model's linearisation is the identified one (docs/explanation/plant.md)."""
    wx, wy, wz = s[at.WIND], s[at.WIND + 1], s[at.WIND + 2]
    q = (wx * wx + wy * wy + wz * wz) / (s[at.AIRSPEED] * s[at.AIRSPEED])
    root_q = math.sqrt(q)
    tilt_x = q * limit(wx / max(wz, UPFLOW_MIN), -TILT_MAX, TILT_MAX)
    tilt_y = q * limit(wy / max(wz, UPFLOW_MIN), -TILT_MAX, TILT_MAX)
    d1, d2 = s[at.FLAPS] - s[at.HOVER_FLAPS], s[at.FLAPS + 1] - s[at.HOVER_FLAPS + 1]
    d3, d4 = s[at.FLAPS + 2] - s[at.HOVER_FLAPS + 2], s[at.FLAPS + 3] - s[at.HOVER_FLAPS + 3]
    u2 = 0.25 * (d1 - d2 - d3 + d4)
    u4 = limit(0.25 * (-d1 + d2 - d3 + d4), -LIFT_U4_MAX, LIFT_U4_MAX)
    lift = s[at.LIFT_FIT + 6]
    for power in range(5, -1, -1):
        lift = lift * u4 + s[at.LIFT_FIT + power]

    f, h = at.DRAG, at.HOVER_DRAG  # x y z force, x y z torque
    s[f] = s[h] + s[at.X_INPUT] * (s[f] - s[h]) - s[at.X_TILT] * tilt_x
    s[f + 1] = s[h + 1] + s[at.Y_INPUT] * (s[f + 1] - s[h + 1]) + s[at.Y_TILT] * tilt_y
    s[f + 2] *= (1.0 + s[at.Z_INPUT] * u4) / lift
    s[f + 3] = s[h + 3] + s[at.ROLL_INPUT] * (s[f + 3] - s[h + 3]) + s[at.ROLL_TILT] * tilt_y
    s[f + 3] += root_q * s[at.ROLL_RATE] * s[at.OMEGA]
    s[f + 4] = s[h + 4] + q * s[at.PITCH_INPUT] * u2 - s[at.PITCH_TILT] * tilt_x
    s[f + 4] += root_q * s[at.PITCH_RATE] * s[at.OMEGA + 1]
    s[f + 5] = s[h + 5] + s[at.YAW_INPUT] * (s[f + 5] - s[h + 5]) + root_q * s[at.YAW_RATE] * s[at.OMEGA + 2]


@compiled
def drag(s: State) -> None:
    """Compute everything from R to HOVER_DRAG from state, inputs and constants."""
    orient(s)
    blow(s)
    press(s)
    if s[at.CORRECTED] != 0.0:
        correct(s)
    for i in range(6):
        s[at.DRAG + i] *= s[at.DRAG_FACTOR]
    for arrow in range(at.PLATE_FORCES, at.PLATE_FORCES + 15, 3):
        x, y, z = s[arrow], s[arrow + 1], s[arrow + 2]
        for i in range(3):
            r = at.R + 3 * i
            s[arrow + i] = s[at.DRAG_FACTOR] * (s[r] * x + s[r + 1] * y + s[r + 2] * z)
