"""A rigid body in the tunnel: its truth, the air around it, its holder, pushes, tether, net and limits.

The truth is computed per whole millisecond from time 0: `advance(now_us)` does every step that ends at or before
`now_us`. The same generator and the same inputs give the same bits, however the time is divided into calls. Subclasses
compute flow and actuators: `hil.floaty.plant`, `hil.world.rigid`.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import ClassVar

import numpy as np

from firmware_py.elementary import cos
from hil.errors import LabError
from hil.world import layout as at
from hil.world.body import Setting, Vector, View
from hil.world.config import PlantConfig
from hil.world.fixed_order import normal
from hil.world.plates import State
from hil.world.room import Room
from hil.world.tunnel import Tunnel

NOISE_ROWS = 2048  # steps of gusts drawn at once
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
AT_REST = (0.0, 0.0, 0.0)
LOSS_TEXTS = {
    at.LEFT_SIDEWAYS: "left the flow: {:.2f} m from the axis",
    at.ROSE: "left the flow: {:.2f} m above the hover point",
    at.FELL: "fell: {:.2f} m below the hover point",
    at.TETHER_TAUT: "tether taut, {:.2f} m below the hover point",
    at.TUMBLED: "tumbled: tilt {:.2f} rad",
}


class InTunnel:
    """The common part of all bodies in the tunnel: the views of `hil.world.body.Motion`, and v_WB (3,) [m/s].

    `s` is the body's array, including mass and inertia.
    """

    loss_texts: ClassVar[Mapping[int, str]] = LOSS_TEXTS  # by the cause in LOST, with its value
    # Compute forces and accelerations from the state; do every step up to `_now_us`, True: the draws ran out before.
    _evaluate: Callable[[], object]
    _advance: Callable[[], bool]
    escs: View | None = None  # the outputs drive no ESCs

    def __init__(self, s: State, tunnel: Tunnel, config: PlantConfig, rng_gust: np.random.Generator) -> None:
        self._s, self.tunnel = s, tunnel
        tether, ground, limits = config.tether, config.ground, config.limits
        s[at.TETHER_ANCHOR + 2] = s[at.HOVER_HEIGHT] + tether.anchor_height
        s[at.TETHER_LENGTH], s[at.TETHER_STIFFNESS] = tether.length, tether.stiffness
        s[at.TETHER_DAMPING] = tether.damping
        s[at.NET_HEIGHT], s[at.FRICTION] = ground.height, ground.friction
        s[at.NET_STIFFNESS], s[at.NET_DAMPING] = ground.stiffness, ground.damping
        s[at.FOOT_SPREAD], s[at.FOOT_BELOW] = ground.foot_spread, ground.foot_below
        spread, below = ground.foot_spread, ground.foot_below
        s[at.FOOT_REACH] = math.sqrt(2.0 * spread * spread + below * below)
        s[at.LIMIT_RADIUS], s[at.LIMIT_BELOW], s[at.LIMIT_ABOVE] = limits.radius, limits.below, limits.above
        s[at.LIMIT_COS_TILT] = cos(limits.tilt)
        s[at.NEXT_US] = s[at.AFTER_US] = math.inf
        self.room = Room(floor=ground.height)
        self._rng = rng_gust
        self._draws = normal(rng_gust, (NOISE_ROWS, 14))
        self._now_us = np.zeros(1, np.int64)
        self._due_us = 0  # until then the truth is constant
        self.state, self.pushes = self._view(at.P, 13), self._view(at.PUSH, 6)
        self.p_WB, self.v_WB, self.q_WB = self._view(at.P, 3), self._view(at.V, 3), self._view(at.Q, 4)
        self.omega_B = self._view(at.OMEGA, 3)
        self.specific_force_B, self.flow_W = self._view(at.SPECIFIC_FORCE, 3), self._view(at.FLOW, 3)
        self.vibration = self._view(at.VIBRATION, 2)

    def _view(self, start: int, count: int) -> View:
        view = self._s[start : start + count]
        view.flags.writeable = False
        return view

    def _settings(self, places: Mapping[str, int]) -> dict[str, Setting]:
        """Return settings of the four actuators, NAME.1 to NAME.4, from the first place of each in the array."""
        s = self._s
        return {
            f"{name}.{i + 1}": Setting(partial(s.item, place + i), partial(s.__setitem__, place + i))
            for name, place in places.items()
            for i in range(4)
        }

    def place(self, p_WB: Vector, q_WB: Vector, v_WB: Vector = AT_REST, omega_B: Vector = AT_REST) -> None:
        """Set the state of the body; `q_WB` is normalised. Raises LabError for an invalid pose."""
        s = self._s
        length = math.sqrt(math.fsum(component * component for component in q_WB))
        if not (length > 0.0 and all(map(math.isfinite, (*p_WB, *q_WB, *v_WB, *omega_B)))):
            raise LabError(f"cannot place the plant at p_WB = {p_WB}, q_WB = {q_WB}: not a finite pose")
        s[at.P : at.P + 3], s[at.Q : at.Q + 4] = p_WB, np.asarray(q_WB) / length
        s[at.V : at.V + 3], s[at.OMEGA : at.OMEGA + 3] = v_WB, omega_B
        self._evaluate()

    def advance(self, now_us: int) -> None:
        """Advance the truth to the last whole millisecond at or before `now_us`."""
        if now_us < self._due_us:
            return
        self._now_us[0] = now_us
        while self._advance():
            self._draws[:] = normal(self._rng, self._draws.shape)
        self._due_us = now_us - now_us % at.STEP_US + at.STEP_US

    @property
    def lost(self) -> str | None:
        """The first reason why the flight is over; None while it flies."""
        cause = int(self._s[at.LOST])
        return self.loss_texts[cause].format(self._s[at.LOST_VALUE]) if cause else None

    def hold(self) -> None:
        s = self._s
        s[at.HELD] = 1.0
        s[at.V : at.V + 3] = s[at.OMEGA : at.OMEGA + 3] = 0.0
        self._evaluate()

    def put_back(self, p_WB: Vector) -> None:
        self._s[at.LOST] = 0.0
        self.place(p_WB, UPRIGHT)
        self.hold()

    def release(self) -> None:
        self._s[at.HELD] = 0.0
        self._evaluate()

    def push(self, force_W: Vector, torque_B: Vector = AT_REST) -> None:
        self._s[at.PUSH : at.PUSH + 3], self._s[at.PUSH_TORQUE : at.PUSH_TORQUE + 3] = force_W, torque_B
