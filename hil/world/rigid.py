"""A user's robot: a rigid body whose forces a Python method computes; integration, air and holder are here.

A subclass states mass and inertia and computes a wrench; it may move actuators once per millisecond. Midpoint rule and
time grid are Floaty's. Only the elementary functions of `firmware_py.elementary` have the same bits everywhere.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Protocol

import numpy as np

from firmware_py.compiling import bound
from firmware_py.core.subset import i32
from hil.errors import LabError, blame
from hil.world.body import Channel, OwnSensor, Quantity, Setting, Vector
from hil.world.config import BatteryConfig, PlantConfig, TunnelConfig
from hil.world.in_tunnel import UPRIGHT, TunnelBody
from hil.world.motion import accelerate, begin, move, surround, watch
from hil.world.scene import Markers, Part, VisualModel, ball, eight_markers
from hil.world.servos import OUTPUTS
from hil.world.structs import NOISE_ROWS, STEP_US, Rigid
from hil.world.tunnel import Tunnel

STEP_S = STEP_US * 1e-6
MOST = 1e6  # [N], [N m] a larger force moves the body to where no picture can be drawn
EXPECTED = "expected force and torque, each of three numbers"


class World(Protocol):
    """The sections of a profile that every body in the tunnel needs."""

    @property
    def tunnel(self) -> TunnelConfig:
        """The flow."""

    @property
    def plant(self) -> PlantConfig:
        """The tether, ground, limits, and the factors on mass and inertia."""

    @property
    def battery(self) -> BatteryConfig:
        """The power of the electronics."""


class RigidBody(TunnelBody):
    """A body made of `mass` [kg], `inertia` about x, y, z of B [kg m2] and a method `wrench`.

    `counts` are the last counts of the board's four timers.
    """

    mass: ClassVar[float]
    inertia: ClassVar[tuple[float, float, float]]
    outputs: Sequence[tuple[int, int]] = OUTPUTS
    settings: Mapping[str, Setting] = {}
    parts: tuple[Part, ...] = (ball(0.05),)
    logged: Mapping[str, tuple[str, str]] = {}  # by attribute: names of its numbers, and their unit
    sensed: Mapping[str, tuple[str, str]] = {}  # likewise, of sensors that own logic reads
    radius: float = 0.1  # [m] of the ball with the cameras' markers

    def __init__(self, world: World, rng_gust: np.random.Generator, p_WB: Vector) -> None:
        """Start upright and at rest at a place [m]. Raises `LabError` for an invalid subclass."""
        body, tunnel = Rigid.allocate(), Tunnel(world.tunnel)
        super().__init__(body, tunnel, world.plant, rng_gust)
        self._body.mass = self._stated("mass", 1)[0] * world.plant.mass_factor
        self._body.inertia[:] = np.multiply(self._stated("inertia", 3), world.plant.inertia_factor)
        if world.plant.constant_factors or world.plant.drag_factor != 1.0:
            raise LabError("plant.constant_factors and plant.drag_factor act on floaty only")
        self.counts: tuple[int, ...] = (0, 0, 0, 0)
        self._electronics = world.battery.electronics_power
        self._failed: str | None = None
        air = tunnel.air
        self._air = air.fields
        self._surround, self._accelerate = bound(surround, body, air), bound(accelerate, body)
        self._begin, self._move = bound(begin, body, air, self._draws), bound(move, body)
        self._watch = bound(watch, body, air)
        self.place(p_WB, UPRIGHT)
        if self._failed is not None:
            raise LabError(self._failed)

    # For the subclass

    def wrench(self, wind_B: list[float]) -> tuple[Vector, Vector]:
        """Return force [N] and torque [N m] without weight, each (3,) in B; `wind_B` [m/s] is the air against the body."""
        raise LabError(f"{type(self).__name__} has no method wrench")

    def actuate(self, duration: float) -> None:
        """Move the actuators for a millisecond, `duration` [s], towards `counts`."""

    def power(self) -> float:
        """Return the actuators' current power [W]."""
        return 0.0

    def channels(self) -> tuple[Channel, ...]:
        """Return its log channels besides its motion: the `logged` attributes, as columns `robot.NAME`."""
        return tuple(
            Channel(
                "float64",
                partial(self._given, name, partial(getattr, self, name), len(names.split())),
                (Quantity(tuple(f"robot.{one}" for one in names.split()), unit),),
            )
            for name, (names, unit) in self.logged.items()
        )

    @property
    def sensors(self) -> Mapping[str, OwnSensor]:  # type: ignore[override]
        """The attributes or methods in `sensed`: what they give at 100 Hz reaches own logic, and columns `sensor.NAME`."""
        return {
            name: OwnSensor(
                tuple(names.split()),
                unit,
                partial(self._given, name, partial(self._measured, name), len(names.split())),
            )
            for name, (names, unit) in self.sensed.items()
        }

    def _measured(self, name: str) -> Any:
        value = getattr(self, name)
        return value() if callable(value) else value

    @property
    def time_s(self) -> float:
        """The time of the laboratory."""
        return 1e-6 * float(self._body.time_us)

    # For the laboratory

    @property
    def look(self) -> VisualModel:
        """Its parts; the ghost at the goal is a cross. Raises `LabError` for anything else as parts."""
        if not (isinstance(self.parts, Sequence) and all(isinstance(part, Part) for part in self.parts)):
            raise LabError(
                f"{type(self).__name__}.parts = {self.parts!r}: expected (ball(..), box(..), Part(..))"
            )
        cross = tuple(np.array((-line, line)) for line in self.radius * np.eye(3))
        return VisualModel(
            self.parts, (), cross, (0.0, 0.0, 0.0), tuple(map(tuple, self.markers.places.tolist()))
        )

    @property
    def markers(self) -> Markers:
        """Eight markers; only the trunk hides them."""
        return Markers(eight_markers(self.radius))

    def set_counts(self, now_us: int, counts: Sequence[int]) -> None:
        """Take the counts of the timers; they take effect at the next millisecond."""
        self.advance(now_us)
        self.counts = tuple(counts)

    def draw(self, now_us: int, cell_V: float) -> float:
        """Return the power [W] of electronics and actuators."""
        (power,) = self._given("power", self.power, 1)
        if not math.isfinite(power):
            self._fail(f"{type(self).__name__}.power returned {power}: expected watts")
            power = 0.0
        return self._electronics + power

    @property
    def lost(self) -> str | None:
        """The first reason why the flight is over, or an error in the user's code; None while it flies."""
        return self._failed or super().lost

    def _stated(self, name: str, count: int) -> list[float]:
        """Return the positive numbers of a class attribute. Raises `LabError` for anything else."""
        value: Any = getattr(self, name, None)
        numbers = _numbers(value, count)
        if not numbers or not all(0.0 < number < math.inf for number in numbers):
            what = "a number above 0" if count == 1 else f"{count} numbers above 0"
            raise LabError(f"{type(self).__name__}.{name} = {value!r}: expected {what}")
        return numbers

    def _asked(self, ask: Callable[..., Any], *given: Any) -> Any:
        """Call a method of the subclass; an error there ends the flight, and the answer is None."""
        try:
            return ask(*given)
        except Exception as error:
            return self._fail(blame(error))

    def _given(self, name: str, ask: Callable[[], Any], count: int) -> list[float]:
        """Return the numbers that the subclass gives; where they are not that many, end the flight and return zeros."""
        given = self._asked(ask)
        numbers = _numbers(given, count)
        if not numbers:
            what = "a number" if count == 1 else f"{count} numbers"
            self._fail(f"{type(self).__name__}.{name} is {given!r}: expected {what}")
        return numbers or [0.0] * count

    def _evaluate(self) -> None:
        """Compute air, wrench and accelerations; an invalid wrench ends the flight with the body clamped."""
        self._surround()
        if self._failed is None:
            given = self._asked(self.wrench, self._air.wind_B.tolist())
            parts = list(given) if isinstance(given, tuple | list) else []
            force, torque = (_numbers(part, 3) for part in parts) if len(parts) == 2 else ([], [])
            if not (force and torque):
                self._fail(f"{type(self).__name__}.wrench returned {given!r}: {EXPECTED}")
            elif not all(abs(number) < MOST for number in force + torque):
                self._fail(f"{type(self).__name__}.wrench returned force {force} N, torque {torque} N m")
            else:
                self._body.wrench_B[:] = force + torque
        self._accelerate()

    def _fail(self, why: str) -> None:
        if self._failed is None:
            self._failed = f"{why} at {self.time_s:.2f} s" if self._body.time_us else why
        self._body.wrench_B[:] = 0.0
        self._body.held = i32(1)
        self._accelerate()

    def _advance(self) -> None:
        body, air = self._body, self._air
        while air.noise_row < NOISE_ROWS and body.time_us + STEP_US <= body.until_us:
            self._step()

    def _step(self) -> None:
        body = self._body
        self._begin()
        if self._failed is None:
            self._asked(self.actuate, STEP_S)
        if body.held:
            self._evaluate()
            return
        for duration in (0.5 * STEP_S, STEP_S):
            body.duration = duration
            self._move()
            self._evaluate()
        if not body.lost:
            self._watch()


def _numbers(value: Any, count: int) -> list[float]:
    """Return a vector of so many numbers, or one; empty for anything else."""
    parts = value if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str) else (value,)
    numbers = [float(one) for one in parts if isinstance(one, int | float | np.generic)]
    return numbers if len(numbers) == count else []
