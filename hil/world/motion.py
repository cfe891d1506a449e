"""The plant's step of one millisecond: gusts, servos, tether, net, rigid body by the midpoint rule, end of a flight;
compiled."""

import math

from firmware_py.core.subset import F64s, Integer, f64, i32
from hil.world.fixed_order import atan2, compiled, exp
from hil.world.plates import blow, drag, orient
from hil.world.structs import GUSTS, NOISE_ROWS, Air, Flaps, Rigid

LEFT_SIDEWAYS, ROSE, FELL, TETHER_TAUT, TUMBLED = 1, 2, 3, 4, 5  # causes of a loss
GRAVITY = 9.81  # [m/s2]
CREEP = 0.02  # [m/s] below this speed a foot's friction fades


@compiled
def pull(body: Rigid) -> None:
    """Write the force of the tether; the line is tied to the base plate, above B."""
    lever, R, v, anchor = body.tether_height, body.R_WB, body.v_WB, body.tether_anchor
    dx = body.p_WB[0] + lever * R[0, 2] - anchor[0]
    dy = body.p_WB[1] + lever * R[1, 2] - anchor[1]
    dz = body.p_WB[2] + lever * R[2, 2] - anchor[2]
    span = math.sqrt(dx * dx + dy * dy + dz * dz)
    stretch = span - body.tether_length
    tension = 0.0
    if stretch > 0.0:
        ox, oy = lever * body.omega_B[0], lever * body.omega_B[1]
        vx = v[0] + R[0, 0] * oy - R[0, 1] * ox  # of the knot
        vy = v[1] + R[1, 0] * oy - R[1, 1] * ox
        vz = v[2] + R[2, 0] * oy - R[2, 1] * ox
        away = (vx * dx + vy * dy + vz * dz) / span
        tension = max(body.tether_stiffness * stretch + body.tether_damping * away, 0.0)
    share = -tension / span
    body.pull_W[0], body.pull_W[1], body.pull_W[2] = share * dx, share * dy, share * dz


@compiled
def push_foot(body: Rigid, bx: float, by: float, bz: float) -> None:
    """Add the net's force and torque on the foot at (bx, by, bz) [m, B]."""
    R, v, g = body.R_WB, body.v_WB, body.ground
    depth = body.net_height - (body.p_WB[2] + R[2, 0] * bx + R[2, 1] * by + R[2, 2] * bz)
    if depth <= 0.0:
        return
    ox, oy, oz = body.omega_B[0], body.omega_B[1], body.omega_B[2]
    wx, wy, wz = oy * bz - oz * by, oz * bx - ox * bz, ox * by - oy * bx  # omega x r, in B
    vx = v[0] + R[0, 0] * wx + R[0, 1] * wy + R[0, 2] * wz
    vy = v[1] + R[1, 0] * wx + R[1, 1] * wy + R[1, 2] * wz
    vz = v[2] + R[2, 0] * wx + R[2, 1] * wy + R[2, 2] * wz
    up = max(body.net_stiffness * depth - body.net_damping * vz, 0.0)
    drag = body.friction * up / max(math.sqrt(vx * vx + vy * vy), CREEP)
    fx, fy = -drag * vx, -drag * vy
    g[0], g[1], g[2] = g[0] + fx, g[1] + fy, g[2] + up
    px = R[0, 0] * fx + R[1, 0] * fy + R[2, 0] * up
    py = R[0, 1] * fx + R[1, 1] * fy + R[2, 1] * up
    pz = R[0, 2] * fx + R[1, 2] * fy + R[2, 2] * up
    g[3] = g[3] + (by * pz - bz * py)
    g[4] = g[4] + (bz * px - bx * pz)
    g[5] = g[5] + (bx * py - by * px)


@compiled
def stand(body: Rigid) -> None:
    """Write force and torque of the net on the body's four feet.

    A foot is a spring and a damper that only push, and dry friction, smooth at rest. Air blows through the net unhindered.
    """
    for i in range(6):
        body.ground[i] = 0.0
    if body.p_WB[2] > body.net_height + body.foot_reach:
        return
    spread, below = body.foot_spread, -body.foot_below
    push_foot(body, spread, spread, below)
    push_foot(body, spread, -spread, below)
    push_foot(body, -spread, spread, below)
    push_foot(body, -spread, -spread, below)


@compiled
def surround(body: Rigid, air: Air) -> None:
    """Compute attitude and air from state and inputs."""
    orient(body)
    blow(body, air)


@compiled
def accelerate(body: Rigid) -> None:
    """Compute tether, net and accelerations, for the wrench of air and rotors."""
    pull(body)
    stand(body)
    R, f, g, push, acceleration = body.R_WB, body.wrench_B, body.ground, body.push, body.acceleration_W
    if body.held != 0:  # the clamp supplies the missing force
        for i in range(3):
            acceleration[i] = 0.0
    else:
        for i in range(3):
            force = R[i, 0] * f[0] + R[i, 1] * f[1] + R[i, 2] * f[2]
            acceleration[i] = (force + push[i] + body.pull_W[i] + g[i]) / body.mass
        acceleration[2] = acceleration[2] - GRAVITY
    ax, ay, az = acceleration[0], acceleration[1], acceleration[2] + GRAVITY
    for i in range(3):
        body.specific_force_B[i] = R[0, i] * ax + R[1, i] * ay + R[2, i] * az

    px, py, pz = body.pull_W[0], body.pull_W[1], body.pull_W[2]
    lever = body.tether_height
    mx = f[3] + push[3] + g[3] - lever * (R[0, 1] * px + R[1, 1] * py + R[2, 1] * pz)
    my = f[4] + push[4] + g[4] + lever * (R[0, 0] * px + R[1, 0] * py + R[2, 0] * pz)
    mz = f[5] + push[5] + g[5]
    ix, iy, iz = body.inertia[0], body.inertia[1], body.inertia[2]
    ox, oy, oz = body.omega_B[0], body.omega_B[1], body.omega_B[2]
    body.alpha_B[0] = (mx - (iz - iy) * oy * oz) / ix  # I domega/dt = M - omega x I omega
    body.alpha_B[1] = (my - (ix - iz) * oz * ox) / iy
    body.alpha_B[2] = (mz - (iy - ix) * ox * oy) / iz


@compiled
def evaluate(body: Rigid, air: Air, flaps: Flaps) -> None:
    """Compute forces and accelerations from state, inputs and constants."""
    drag(body, air, flaps)
    accelerate(body)


@compiled
def turn_flaps(flaps: Flaps, duration: float) -> None:
    """Turn each flap towards its command for `duration` [s]: rate limit, then first order, then dead band; exact."""
    reach = flaps.rate_limit * flaps.lag  # [rad] errors beyond it run at the rate limit
    for i in range(4):
        left = duration * flaps.pace[i]
        before = flaps.angle[i]
        target = flaps.command[i] + flaps.trim[i]
        error = abs(target - before)
        if error > flaps.dead_band:
            if error > reach:
                run = min(left, (error - reach) / flaps.rate_limit)
                error = error - flaps.rate_limit * run
                left = left - run
            if left > 0.0:
                error = max(error * exp(-left / flaps.lag), flaps.dead_band)
            flaps.angle[i] = target - math.copysign(error, target - before)
            flaps.travel = flaps.travel + abs(flaps.angle[i] - before)


@compiled
def drive_servos(flaps: Flaps, start_us: float, end_us: float) -> None:
    """Turn the flaps from `start_us` to `end_us`, latching new counts at their times in between."""
    from_us = start_us
    if flaps.next_us < end_us:
        from_us = max(flaps.next_us, start_us)
        turn_flaps(flaps, (from_us - start_us) * 1e-6)
        for i in range(4):
            flaps.command[i] = flaps.next[i]
            flaps.next[i] = flaps.after[i]
        flaps.next_us = flaps.after_us
        flaps.after_us = math.inf
    turn_flaps(flaps, (end_us - from_us) * 1e-6)


@compiled
def rotate(body: Rigid) -> None:
    """Set q to that before + duration/2 q (0, omega), of unit length, with the present q and omega."""
    half, q, before = 0.5 * body.duration, body.q_WB, body.before
    aw, ax, ay, az = q[0], q[1], q[2], q[3]
    ox, oy, oz = body.omega_B[0], body.omega_B[1], body.omega_B[2]
    qw = before[6] + half * (-ax * ox - ay * oy - az * oz)
    qx = before[7] + half * (aw * ox + ay * oz - az * oy)
    qy = before[8] + half * (aw * oy + az * ox - ax * oz)
    qz = before[9] + half * (aw * oz + ax * oy - ay * ox)
    norm = 1.0 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    q[0], q[1], q[2], q[3] = qw * norm, qx * norm, qy * norm, qz * norm


@compiled
def lose(body: Rigid, cause: Integer, value: float) -> None:
    """Record why the flight is over."""
    body.lost = i32(cause)
    body.lost_value = value


@compiled
def watch(body: Rigid, air: Air) -> None:
    """Record the first reason why the flight is over."""
    x, y, z = body.p_WB[0], body.p_WB[1], body.p_WB[2] - air.hover_height
    radius = math.sqrt(x * x + y * y)
    cos_tilt = body.R_WB[2, 2]
    if radius > body.limit_radius:
        lose(body, LEFT_SIDEWAYS, radius)
    elif z > body.limit_above:
        lose(body, ROSE, z)
    elif -z > body.limit_below:
        lose(body, FELL, -z)
    elif body.pull_W[0] != 0.0 or body.pull_W[1] != 0.0 or body.pull_W[2] != 0.0:
        lose(body, TETHER_TAUT, -z)
    elif cos_tilt < body.limit_cos_tilt:
        lose(body, TUMBLED, atan2(math.sqrt(1.0 - cos_tilt * cos_tilt), cos_tilt))


@compiled
def gust(air: Air, draws: F64s) -> None:
    """Advance the gusts by one step with the next row of unit normal `draws`."""
    row = air.noise_row
    air.noise_row = i32(row + 1)
    for i in range(GUSTS):
        air.gusts[i] = air.gust_decay[i] * air.gusts[i] + air.gust_kick[i] * draws[row, i]


@compiled
def begin(body: Rigid, air: Air, draws: F64s) -> None:
    """Begin a step: advance the gusts and the time, and keep the state."""
    gust(air, draws)
    body.time_us = body.time_us + body.step_us
    for i in range(3):
        body.before[i] = body.p_WB[i]
        body.before[3 + i] = body.v_WB[i]
        body.before[10 + i] = body.omega_B[i]
    for i in range(4):
        body.before[6 + i] = body.q_WB[i]


@compiled
def move(body: Rigid) -> None:
    """Set the state to that before, moved for the duration with the present velocities and accelerations."""
    for i in range(3):
        body.p_WB[i] = body.before[i] + body.duration * body.v_WB[i]
        body.v_WB[i] = body.before[3 + i] + body.duration * body.acceleration_W[i]
    rotate(body)
    for i in range(3):
        body.omega_B[i] = body.before[10 + i] + body.duration * body.alpha_B[i]


@compiled
def step(body: Rigid, air: Air, flaps: Flaps, draws: F64s) -> None:
    """Advance the plant by one step with unit normal `draws`; its accelerations hold for the start."""
    start_us = body.time_us
    middle_us, duration = start_us + 0.5 * body.step_us, body.step_us * 1e-6
    begin(body, air, draws)
    drive_servos(flaps, start_us, middle_us)
    if body.held != 0:
        drive_servos(flaps, middle_us, body.time_us)
        evaluate(body, air, flaps)
        return

    # To the middle with the rates at the start, then to the end with those at the middle.
    for part in range(2):
        body.duration = 0.5 * f64(1 + part) * duration
        move(body)
        if part == 1:
            drive_servos(flaps, middle_us, body.time_us)
        evaluate(body, air, flaps)
    if body.lost == 0:
        watch(body, air)


@compiled
def advance(body: Rigid, air: Air, flaps: Flaps, draws: F64s) -> None:
    """Do every step that is due, as long as there are draws."""
    for _ in range(air.noise_row, NOISE_ROWS):
        if body.time_us + body.step_us > body.until_us:
            return
        step(body, air, flaps, draws)
