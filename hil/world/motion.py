"""The plant's step of one millisecond: gusts, servos, tether, net, rigid body by the midpoint rule, end of a flight;
compiled."""

import math

import numpy as np
from numpy.typing import NDArray

from hil.world import layout as at
from hil.world.fixed_order import atan2, compiled, exp
from hil.world.plates import State, blow, drag, orient

GRAVITY = 9.81  # [m/s2]
CREEP = 0.02  # [m/s] below this speed a foot's friction fades


@compiled
def pull(s: State) -> None:
    """Write the force of the tether (PULL, W); the line is tied to the base plate, AXIS_HEIGHT above B."""
    lever, r = s[at.AXIS_HEIGHT], at.R
    dx = s[at.P] + lever * s[r + 2] - s[at.TETHER_ANCHOR]
    dy = s[at.P + 1] + lever * s[r + 5] - s[at.TETHER_ANCHOR + 1]
    dz = s[at.P + 2] + lever * s[r + 8] - s[at.TETHER_ANCHOR + 2]
    span = math.sqrt(dx * dx + dy * dy + dz * dz)
    stretch = span - s[at.TETHER_LENGTH]
    tension = 0.0
    if stretch > 0.0:
        ox, oy = lever * s[at.OMEGA], lever * s[at.OMEGA + 1]
        vx = s[at.V] + s[r] * oy - s[r + 1] * ox  # of the knot
        vy = s[at.V + 1] + s[r + 3] * oy - s[r + 4] * ox
        vz = s[at.V + 2] + s[r + 6] * oy - s[r + 7] * ox
        away = (vx * dx + vy * dy + vz * dz) / span
        tension = max(s[at.TETHER_STIFFNESS] * stretch + s[at.TETHER_DAMPING] * away, 0.0)
    share = -tension / span
    s[at.PULL], s[at.PULL + 1], s[at.PULL + 2] = share * dx, share * dy, share * dz


@compiled
def stand(s: State) -> None:
    """Write force and torque of the net on the body's four feet: GROUND, force [N] in W and torque [N m] in B.

    A foot is a spring and a damper that only push, and dry friction, smooth at rest. Air blows through the net unhindered.
    """
    g, r = at.GROUND, at.R
    for i in range(6):
        s[g + i] = 0.0
    if s[at.P + 2] > s[at.NET_HEIGHT] + s[at.FOOT_REACH]:
        return
    ox, oy, oz = s[at.OMEGA], s[at.OMEGA + 1], s[at.OMEGA + 2]
    bz = -s[at.FOOT_BELOW]
    for foot in range(4):
        bx = s[at.FOOT_SPREAD] if foot < 2 else -s[at.FOOT_SPREAD]
        by = s[at.FOOT_SPREAD] if foot % 2 == 0 else -s[at.FOOT_SPREAD]
        depth = s[at.NET_HEIGHT] - (s[at.P + 2] + s[r + 6] * bx + s[r + 7] * by + s[r + 8] * bz)
        if depth <= 0.0:
            continue
        wx, wy, wz = oy * bz - oz * by, oz * bx - ox * bz, ox * by - oy * bx  # omega x r, in B
        vx = s[at.V] + s[r] * wx + s[r + 1] * wy + s[r + 2] * wz
        vy = s[at.V + 1] + s[r + 3] * wx + s[r + 4] * wy + s[r + 5] * wz
        vz = s[at.V + 2] + s[r + 6] * wx + s[r + 7] * wy + s[r + 8] * wz
        up = max(s[at.NET_STIFFNESS] * depth - s[at.NET_DAMPING] * vz, 0.0)
        drag = s[at.FRICTION] * up / max(math.sqrt(vx * vx + vy * vy), CREEP)
        fx, fy = -drag * vx, -drag * vy
        s[g], s[g + 1], s[g + 2] = s[g] + fx, s[g + 1] + fy, s[g + 2] + up
        px = s[r] * fx + s[r + 3] * fy + s[r + 6] * up
        py = s[r + 1] * fx + s[r + 4] * fy + s[r + 7] * up
        pz = s[r + 2] * fx + s[r + 5] * fy + s[r + 8] * up
        s[g + 3] += by * pz - bz * py
        s[g + 4] += bz * px - bx * pz
        s[g + 5] += bx * py - by * px


@compiled
def evaluate(s: State) -> None:
    """Compute forces and accelerations from state, inputs and constants."""
    drag(s)
    accelerate(s)


@compiled
def surround(s: State) -> None:
    """Compute attitude and air from state and inputs."""
    orient(s)
    blow(s)


@compiled
def accelerate(s: State) -> None:
    """Compute tether, net and accelerations, for the force and torque in DRAG."""
    pull(s)
    stand(s)
    r, f, g, m = at.R, at.DRAG, at.GROUND, s[at.MASS]
    if s[at.HELD] != 0.0:  # the clamp supplies the missing force
        s[at.ACC] = s[at.ACC + 1] = s[at.ACC + 2] = 0.0
    else:
        for i in range(3):
            force = s[r + 3 * i] * s[f] + s[r + 3 * i + 1] * s[f + 1] + s[r + 3 * i + 2] * s[f + 2]
            s[at.ACC + i] = (force + s[at.PUSH + i] + s[at.PULL + i] + s[g + i]) / m
        s[at.ACC + 2] -= GRAVITY
    ax, ay, az = s[at.ACC], s[at.ACC + 1], s[at.ACC + 2] + GRAVITY
    for i in range(3):
        s[at.SPECIFIC_FORCE + i] = s[r + i] * ax + s[r + 3 + i] * ay + s[r + 6 + i] * az

    px, py, pz = s[at.PULL], s[at.PULL + 1], s[at.PULL + 2]
    lever = s[at.AXIS_HEIGHT]
    mx = s[f + 3] + s[at.PUSH_TORQUE] + s[g + 3] - lever * (s[r + 1] * px + s[r + 4] * py + s[r + 7] * pz)
    my = s[f + 4] + s[at.PUSH_TORQUE + 1] + s[g + 4] + lever * (s[r] * px + s[r + 3] * py + s[r + 6] * pz)
    mz = s[f + 5] + s[at.PUSH_TORQUE + 2] + s[g + 5]
    ix, iy, iz = s[at.INERTIA], s[at.INERTIA + 1], s[at.INERTIA + 2]
    ox, oy, oz = s[at.OMEGA], s[at.OMEGA + 1], s[at.OMEGA + 2]
    s[at.ALPHA] = (mx - (iz - iy) * oy * oz) / ix  # I domega/dt = M - omega x I omega
    s[at.ALPHA + 1] = (my - (ix - iz) * oz * ox) / iy
    s[at.ALPHA + 2] = (mz - (iy - ix) * ox * oy) / iz


@compiled
def turn_flaps(s: State, duration: float) -> None:
    """Turn each flap towards its command for `duration` [s]: rate limit, then first order, then dead band; exact."""
    reach = s[at.SERVO_RATE] * s[at.SERVO_TAU]  # [rad] errors beyond it run at the rate limit
    for i in range(4):
        left = duration * s[at.SERVO_SPEED + i]
        target = s[at.COMMAND + i] + s[at.SERVO_TRIM + i]
        error = abs(target - s[at.FLAPS + i])
        if error <= s[at.DEAD_BAND]:
            continue
        if error > reach:
            run = min(left, (error - reach) / s[at.SERVO_RATE])
            error -= s[at.SERVO_RATE] * run
            left -= run
        if left > 0.0:
            error = max(error * exp(-left / s[at.SERVO_TAU]), s[at.DEAD_BAND])
        before = s[at.FLAPS + i]
        s[at.FLAPS + i] = target - math.copysign(error, target - before)
        s[at.TRAVEL] += abs(s[at.FLAPS + i] - before)


@compiled
def drive_servos(s: State, start_us: float, end_us: float) -> None:
    """Turn the flaps from `start_us` to `end_us`, latching new counts at their times in between."""
    if s[at.NEXT_US] < end_us:
        latch_us = max(s[at.NEXT_US], start_us)
        turn_flaps(s, (latch_us - start_us) * 1e-6)
        for i in range(4):
            s[at.COMMAND + i] = s[at.NEXT + i]
            s[at.NEXT + i] = s[at.AFTER + i]
        s[at.NEXT_US] = s[at.AFTER_US]
        s[at.AFTER_US] = math.inf
        start_us = latch_us
    turn_flaps(s, (end_us - start_us) * 1e-6)


@compiled
def rotate(s: State, qw: float, qx: float, qy: float, qz: float, duration: float) -> None:
    """Set Q to q + duration/2 q (0, omega), of unit length; for the rate in OMEGA."""
    half = 0.5 * duration
    aw, ax, ay, az = s[at.Q], s[at.Q + 1], s[at.Q + 2], s[at.Q + 3]
    ox, oy, oz = s[at.OMEGA], s[at.OMEGA + 1], s[at.OMEGA + 2]
    qw += half * (-ax * ox - ay * oy - az * oz)
    qx += half * (aw * ox + ay * oz - az * oy)
    qy += half * (aw * oy + az * ox - ax * oz)
    qz += half * (aw * oz + ax * oy - ay * ox)
    norm = 1.0 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    s[at.Q], s[at.Q + 1], s[at.Q + 2], s[at.Q + 3] = qw * norm, qx * norm, qy * norm, qz * norm


@compiled
def watch(s: State) -> None:
    """Record the first reason why the flight is over."""
    x, y, z = s[at.P], s[at.P + 1], s[at.P + 2] - s[at.HOVER_HEIGHT]
    radius = math.sqrt(x * x + y * y)
    cos_tilt = s[at.R + 8]
    cause, value = 0, 0.0
    if radius > s[at.LIMIT_RADIUS]:
        cause, value = at.LEFT_SIDEWAYS, radius
    elif z > s[at.LIMIT_ABOVE]:
        cause, value = at.ROSE, z
    elif -z > s[at.LIMIT_BELOW]:
        cause, value = at.FELL, -z
    elif s[at.PULL] != 0.0 or s[at.PULL + 1] != 0.0 or s[at.PULL + 2] != 0.0:
        cause, value = at.TETHER_TAUT, -z
    elif cos_tilt < s[at.LIMIT_COS_TILT]:
        cause, value = at.TUMBLED, atan2(math.sqrt(1.0 - cos_tilt * cos_tilt), cos_tilt)
    if cause != 0:
        s[at.LOST], s[at.LOST_VALUE] = cause, value


@compiled
def gust(s: State, draws: NDArray[np.float64]) -> None:
    """Advance the gusts by one step with 14 unit normal `draws`."""
    for i in range(14):
        s[at.GUSTS + i] = s[at.GUST_DECAY + i] * s[at.GUSTS + i] + s[at.GUST_KICK + i] * draws[i]


@compiled
def move(s: State) -> None:
    """Set the state to BEFORE, moved for DURATION [s] with the present velocities and accelerations."""
    h, b = s[at.DURATION], at.BEFORE
    for i in range(3):
        s[at.P + i] = s[b + i] + h * s[at.V + i]
        s[at.V + i] = s[b + 3 + i] + h * s[at.ACC + i]
    rotate(s, s[b + 6], s[b + 7], s[b + 8], s[b + 9], h)
    for i in range(3):
        s[at.OMEGA + i] = s[b + 10 + i] + h * s[at.ALPHA + i]


@compiled
def step(s: State, draws: NDArray[np.float64], step_us: float) -> None:
    """Advance the plant by one step with 14 unit normal `draws`; ACC and ALPHA hold for the start."""
    gust(s, draws)
    start_us = s[at.TIME_US]
    middle_us, end_us = start_us + 0.5 * step_us, start_us + step_us
    s[at.TIME_US] = end_us
    drive_servos(s, start_us, middle_us)
    if s[at.HELD] != 0.0:
        drive_servos(s, middle_us, end_us)
        evaluate(s)
        return

    duration = step_us * 1e-6  # [s]
    for i in range(13):
        s[at.BEFORE + i] = s[at.P + i]
    # To the middle with the rates at the start, then to the end with those at the middle.
    for part in range(2):
        s[at.DURATION] = 0.5 * duration if part == 0 else duration
        move(s)
        if part == 1:
            drive_servos(s, middle_us, end_us)
        evaluate(s)
    if s[at.LOST] == 0.0:
        watch(s)


@compiled
def advance(s: State, draws: NDArray[np.float64], now_us: NDArray[np.int64]) -> bool:
    """Do every step that ends at or before `now_us[0]`; return True when the draws ran out before that."""
    row = int(s[at.NOISE_ROW])
    while s[at.TIME_US] + at.STEP_US <= now_us[0]:
        if row == draws.shape[0]:
            s[at.NOISE_ROW] = 0.0
            return True
        step(s, draws[row], at.STEP_US)
        row += 1
    s[at.NOISE_ROW] = row
    return False
