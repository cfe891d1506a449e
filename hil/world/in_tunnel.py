"""A rigid body in the tunnel: its truth, the air around it, its holder, pushes, tether, net and limits.

The truth is computed per whole millisecond from time 0: `advance(now_us)` does every step that ends at or before
`now_us`. The same generator and the same inputs give the same bits, however the time is divided into calls. Subclasses
compute flow and actuators: `hil.world.floaty.plant`, `hil.world.rigid`.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import ClassVar

import numpy as np

from firmware_py.core.subset import Block, i32
from firmware_py.elementary import cos
from hil.errors import LabError
from hil.world.body import OwnSensor, Setting, Vector, View
from hil.world.config import PlantConfig
from hil.world.fixed_order import normal
from hil.world.motion import FELL, LEFT_SIDEWAYS, ROSE, TETHER_TAUT, TUMBLED
from hil.world.room import Room
from hil.world.structs import GUSTS, NOISE_ROWS, STEP_US, Rigid
from hil.world.tunnel import Tunnel

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
AT_REST = (0.0, 0.0, 0.0)
LOSS_TEXTS = {
    LEFT_SIDEWAYS: "left the flow: {:.2f} m from the axis",
    ROSE: "left the flow: {:.2f} m above the hover point",
    FELL: "fell: {:.2f} m below the hover point",
    TETHER_TAUT: "tether taut, {:.2f} m below the hover point",
    TUMBLED: "tumbled: tilt {:.2f} rad",
}


class TunnelBody:
    """The common part of all bodies in the tunnel: the views of `hil.world.body.Motion`, and v_WB (3,) [m/s].

    `acceleration_W` [m/s2] and `alpha_B` [rad/s2] are (3,). The body's memory includes mass and inertia.
    """

    loss_texts: ClassVar[Mapping[int, str]] = LOSS_TEXTS  # by the cause in `lost`, with its value
    # Compute forces and accelerations from the state; do every step that is due, as long as there are draws.
    _evaluate: Callable[[], object]
    _advance: Callable[[], object]
    escs: View | None = None  # the outputs drive no ESCs
    sensors: Mapping[str, OwnSensor] = {}

    def __init__(
        self, body: Block[Rigid], tunnel: Tunnel, config: PlantConfig, rng_gust: np.random.Generator
    ) -> None:
        self.tunnel, self._body = tunnel, body.fields
        b, air = body.fields, tunnel.air
        tether, ground, limits = config.tether, config.ground, config.limits
        b.step_us = STEP_US
        b.tether_anchor[2] = air.fields.hover_height + tether.anchor_height
        b.tether_length, b.tether_stiffness = tether.length, tether.stiffness
        b.tether_damping = tether.damping
        b.net_height, b.friction = ground.height, ground.friction
        b.net_stiffness, b.net_damping = ground.stiffness, ground.damping
        b.foot_spread, b.foot_below = ground.foot_spread, ground.foot_below
        spread, below = ground.foot_spread, ground.foot_below
        b.foot_reach = math.sqrt(2.0 * spread * spread + below * below)
        b.limit_radius, b.limit_below, b.limit_above = limits.radius, limits.below, limits.above
        b.limit_cos_tilt = cos(limits.tilt)
        self.room = Room(floor=ground.height)
        self._rng = rng_gust
        self._draws = normal(rng_gust, (NOISE_ROWS, GUSTS))
        self._until_us, self._lost = body.cell("until_us"), body.cell("lost")
        self._noise_row = air.cell("noise_row")
        self._due_us = 0  # until then the truth is constant
        self.state = seen(body.piece("p_WB", 13))
        self.p_WB, self.v_WB, self.q_WB, self.omega_B = map(seen, (b.p_WB, b.v_WB, b.q_WB, b.omega_B))
        self.acceleration_W, self.alpha_B = seen(b.acceleration_W), seen(b.alpha_B)
        self.specific_force_B, self.vibration = seen(b.specific_force_B), seen(b.vibration)
        self.flow_W, self.pushes = seen(air.fields.flow_W), seen(b.push)

    def place(self, p_WB: Vector, q_WB: Vector, v_WB: Vector = AT_REST, omega_B: Vector = AT_REST) -> None:
        """Set the state of the body; `q_WB` is normalised. Raises LabError for an invalid pose."""
        b = self._body
        length = math.sqrt(math.fsum(component * component for component in q_WB))
        if not (length > 0.0 and all(map(math.isfinite, (*p_WB, *q_WB, *v_WB, *omega_B)))):
            raise LabError(f"cannot place the plant at p_WB = {p_WB}, q_WB = {q_WB}: not a finite pose")
        b.p_WB[:], b.q_WB[:] = p_WB, np.asarray(q_WB) / length
        b.v_WB[:], b.omega_B[:] = v_WB, omega_B
        self._evaluate()

    def advance(self, now_us: int) -> None:
        """Advance the truth to the last whole millisecond at or before `now_us`."""
        if now_us < self._due_us:
            return
        self._until_us[0] = now_us
        self._advance()
        while self._noise_row[0] == NOISE_ROWS:
            self._draws[:], self._noise_row[0] = normal(self._rng, self._draws.shape), 0
            self._advance()
        self._due_us = now_us - now_us % STEP_US + STEP_US

    @property
    def lost(self) -> str | None:
        """The first reason why the flight is over; None while it flies."""
        cause = self._lost[0]
        return self.loss_texts[cause].format(self._body.lost_value) if cause else None

    @property
    def lift(self) -> float:
        """The force [N] along z of B that air, floor and holder have on the body."""
        return float(self._body.mass * self.specific_force_B[2])

    def hold(self) -> None:
        self._body.held = i32(1)
        self._body.v_WB[:] = self._body.omega_B[:] = 0.0
        self._evaluate()

    def put_back(self, p_WB: Vector) -> None:
        self._body.lost = i32(0)
        self.place(p_WB, UPRIGHT)
        self.hold()

    def release(self) -> None:
        self._body.held = i32(0)
        self._evaluate()

    def push(self, force_W: Vector, torque_B: Vector = AT_REST) -> None:
        self._body.push[:3], self._body.push[3:] = force_W, torque_B


def seen(memory: View) -> View:
    """Return a read-only view."""
    view = memory.view()
    view.flags.writeable = False
    return view


def settings_of(places: Mapping[str, View]) -> dict[str, Setting]:
    """Return settings of the four actuators, NAME.1 to NAME.4, from the memory of each."""
    return {
        f"{name}.{i + 1}": Setting(partial(memory.item, i), partial(memory.__setitem__, i))
        for name, memory in places.items()
        for i in range(4)
    }
