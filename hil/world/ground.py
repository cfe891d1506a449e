"""The net over the tunnel's exit, and the robot's four feet on it; compiled. Air blows through it unhindered.

A foot is a spring and a damper that only push, and dry friction, smooth at rest.
"""

import math

from hil.world import layout as at
from hil.world.fixed_order import compiled
from hil.world.plates import State

CREEP = 0.02  # [m/s] below this speed friction fades


@compiled
def stand(s: State) -> None:
    """Write force and torque of the net on the body: GROUND, force [N] in W and torque [N m] in B."""
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
