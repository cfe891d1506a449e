"""The flow's force and torque on the body: air at five points, nine plates, identified correction; compiled.

Plates (paper, "Force analysis"): F_k = 1/2 rho C_D A_k (w_k.n_k)|w_k.n_k| n_k with the wind w_k at plate k.
The correction (docs/explanation/plant.md) then scales and adds so that the linearisation equals a chosen set of constants.
"""

import math

from firmware_py.core.subset import Integer
from firmware_py.elementary import tan
from hil.world.fixed_order import compiled, sine_ahead
from hil.world.structs import Air, Flaps, Rigid

# Slope of the wind above which identified stiffness does not grow.
TILT_MAX = tan(math.radians(35.0))
LIFT_U4_MAX = 0.55  # [rad] largest |u4| in the fit of the lift ratio l(u4)
UPFLOW_MIN = 0.1  # [m/s] keeps the slope of the wind finite when the air stands still


@compiled
def limit(value: float, low: float, high: float) -> float:
    """Return `value` inside [low, high]."""
    return min(max(value, low), high)


@compiled
def orient(body: Rigid) -> None:
    """Write R_WB of q_WB."""
    q, R = body.q_WB, body.R_WB
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@compiled
def upflow(body: Rigid, air: Air, x: float, y: float) -> float:
    """Return the vertical mean flow [m/s] over (x, y) [m, W] at the height of the body."""
    reach = (x * x + y * y) / (air.profile_radius * air.profile_radius)
    height = body.p_WB[2] - air.hover_height
    slope = 1.0 - air.height_slope * height
    flow: float = air.fan * air.speed / (1.0 + reach * reach * reach) * slope
    if air.occlusion_depth > 0.0:
        dx, dy = x - air.occlusion_W[0], y - air.occlusion_W[1]
        near = (dx * dx + dy * dy) / (air.occlusion_radius * air.occlusion_radius)
        flow = flow * (1.0 - air.occlusion_depth / (1.0 + near * near * near))
    return flow


@compiled
def blow(body: Rigid, air: Air) -> None:
    """Write the air at the centre of mass and the wind relative to the body there."""
    x, y = body.p_WB[0], body.p_WB[1]
    spread = (x * x + y * y) / (air.gust_radius * air.gust_radius)
    air.roughness = air.fan * air.gust_scale * min(1.0 + spread * spread, air.gust_growth_max)
    for i in range(3):
        air.flow_W[i] = air.roughness * (air.gusts[i] + air.gusts[3 + i]) + air.side_wind_W[i]
    air.upflow = upflow(body, air, x, y)
    air.flow_W[2] = air.flow_W[2] + air.upflow
    wx, wy, wz = air.flow_W[0] - body.v_WB[0], air.flow_W[1] - body.v_WB[1], air.flow_W[2] - body.v_WB[2]
    for i in range(3):
        air.wind_B[i] = body.R_WB[0, i] * wx + body.R_WB[1, i] * wy + body.R_WB[2, i] * wz


@compiled
def flap_upflow(body: Rigid, air: Air, flaps: Flaps, flap: Integer) -> float:
    """Return by how much [m/s] the vertical flow at a flap exceeds that at the centre of mass."""
    point, R = flaps.flow_points, body.R_WB
    x, y, z = point[flap, 0], point[flap, 1], point[flap, 2]
    there_x = body.p_WB[0] + R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
    there_y = body.p_WB[1] + R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
    gust = air.roughness * (air.gusts[6 + flap] + air.gusts[10 + flap])
    more: float = upflow(body, air, there_x, there_y) - air.upflow + gust
    return more


@compiled
def strike(body: Rigid, flaps: Flaps, flap: Integer, part: Integer, c: float, d: float) -> None:
    """Write force and torque of a flap's flat part 0 or kink 1, at a cosine and sine, in the wind at the flap."""
    plate = 2 * flap + part
    n, r, u, wrench = flaps.normal, flaps.centre, flaps.wind_B, flaps.struck
    ox, oy, oz = body.omega_B[0], body.omega_B[1], body.omega_B[2]
    nx = n[plate, 0] + n[plate, 3] * c + n[plate, 6] * d
    ny = n[plate, 1] + n[plate, 4] * c + n[plate, 7] * d
    nz = n[plate, 2] + n[plate, 5] * c + n[plate, 8] * d
    rx = r[plate, 0] + r[plate, 3] * c + r[plate, 6] * d
    ry = r[plate, 1] + r[plate, 4] * c + r[plate, 7] * d
    rz = r[plate, 2] + r[plate, 5] * c + r[plate, 8] * d
    across = (
        (u[0] - oy * rz + oz * ry) * nx + (u[1] - oz * rx + ox * rz) * ny + (u[2] - ox * ry + oy * rx) * nz
    )
    f = flaps.pressure * flaps.area[plate] * across * abs(across)
    fx, fy, fz = f * nx, f * ny, f * nz
    wrench[part, 0], wrench[part, 1], wrench[part, 2] = fx, fy, fz
    wrench[part, 3], wrench[part, 4], wrench[part, 5] = (
        ry * fz - rz * fy,
        rz * fx - rx * fz,
        rx * fy - ry * fx,
    )


@compiled
def press(body: Rigid, air: Air, flaps: Flaps) -> None:
    """Write force and torque of all plates at their current and hover angles, and the plates' forces in B."""
    up, parts = air.wind_B[2], flaps.struck
    base = flaps.pressure * flaps.base_area * up * abs(up)
    for i in range(6):
        body.wrench_B[i], flaps.hover_wrench_B[i] = 0.0, 0.0
    body.wrench_B[2], flaps.hover_wrench_B[2] = base, base
    flaps.forces[0, 0], flaps.forces[0, 1], flaps.forces[0, 2] = 0.0, 0.0, base
    for flap in range(4):
        more = flap_upflow(body, air, flaps, flap)
        for i in range(3):
            flaps.wind_B[i] = air.wind_B[i] + body.R_WB[2, i] * more
        angle = flaps.angle[flap]
        if flap % 2 == 0:  # 0 and 2 are mirror images of 1
            angle = -angle
        c, d = sine_ahead(angle, 1), sine_ahead(angle, 0)
        strike(body, flaps, flap, 0, c, d)
        strike(body, flaps, flap, 1, c, d)
        for i in range(6):
            body.wrench_B[i] = body.wrench_B[i] + parts[0, i] + parts[1, i]
        for i in range(3):
            flaps.forces[1 + flap, i] = parts[0, i] + parts[1, i]
        if flaps.corrected != 0:
            strike(body, flaps, flap, 0, flaps.hover_turn[0], flaps.hover_turn[1])
            strike(body, flaps, flap, 1, flaps.hover_turn[0], flaps.hover_turn[1])
            for i in range(6):
                flaps.hover_wrench_B[i] = flaps.hover_wrench_B[i] + parts[0, i] + parts[1, i]


@compiled
def correct(body: Rigid, air: Air, flaps: Flaps) -> None:
    """Scale and add to the wrench so that the model's linearisation is the identified one (docs/explanation/plant.md)."""
    wx, wy, wz = air.wind_B[0], air.wind_B[1], air.wind_B[2]
    q = (wx * wx + wy * wy + wz * wz) / (flaps.airspeed * flaps.airspeed)
    root_q = math.sqrt(q)
    tilt_x = q * limit(wx / max(wz, UPFLOW_MIN), -TILT_MAX, TILT_MAX)
    tilt_y = q * limit(wy / max(wz, UPFLOW_MIN), -TILT_MAX, TILT_MAX)
    d1, d2 = flaps.angle[0] - flaps.hover[0], flaps.angle[1] - flaps.hover[1]
    d3, d4 = flaps.angle[2] - flaps.hover[2], flaps.angle[3] - flaps.hover[3]
    u2 = 0.25 * (d1 - d2 - d3 + d4)
    u4 = limit(0.25 * (-d1 + d2 - d3 + d4), -LIFT_U4_MAX, LIFT_U4_MAX)
    lift = flaps.lift_fit[6]
    for i in range(6):
        lift = lift * u4 + flaps.lift_fit[5 - i]

    f, h, rate = body.wrench_B, flaps.hover_wrench_B, body.omega_B
    by_input, by_tilt, by_rate = flaps.by_input, flaps.by_tilt, flaps.by_rate
    f[0] = h[0] + by_input[0] * (f[0] - h[0]) - by_tilt[0] * tilt_x
    f[1] = h[1] + by_input[1] * (f[1] - h[1]) + by_tilt[1] * tilt_y
    f[2] = f[2] * ((1.0 + by_input[2] * u4) / lift)
    f[3] = h[3] + by_input[3] * (f[3] - h[3]) + by_tilt[3] * tilt_y + root_q * by_rate[3] * rate[0]
    f[4] = h[4] + q * by_input[4] * u2 - by_tilt[4] * tilt_x + root_q * by_rate[4] * rate[1]
    f[5] = h[5] + by_input[5] * (f[5] - h[5]) + root_q * by_rate[5] * rate[2]


@compiled
def drag(body: Rigid, air: Air, flaps: Flaps) -> None:
    """Compute attitude, air, wrench and the plates' forces from state, inputs and constants."""
    orient(body)
    blow(body, air)
    press(body, air, flaps)
    if flaps.corrected != 0:
        correct(body, air, flaps)
    for i in range(6):
        body.wrench_B[i] = body.wrench_B[i] * flaps.drag_factor
    R = body.R_WB
    for part in range(5):
        x, y, z = flaps.forces[part, 0], flaps.forces[part, 1], flaps.forces[part, 2]
        for i in range(3):
            flaps.forces[part, i] = flaps.drag_factor * (R[i, 0] * x + R[i, 1] * y + R[i, 2] * z)
