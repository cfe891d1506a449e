"""The kinds of faults in a flight, each with the value of the world that it changes, its size, and its outcome.

A size has customary units (deg, ms); `scale` converts it to SI. Several faults may change one knob at once: the size of
each is then blended into the value from before the first of them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Literal

from hil.config import DEFAULT_PROFILE
from hil.errors import LabError, blame, hint, shown
from hil.laboratory.arguments import checked, fits
from hil.laboratory.bodies import FAILURES
from hil.laboratory.robot import LINKS, Robot, attributes_of, probe
from hil.world.body import Failure

Outcome = Literal["holds", "degrades", "failsafe", "lost", ""]
OCCLUSION_RADIUS = 0.3  # [m] around the axis: the shadow covers the robot anywhere in its box
PUSH_S = 0.1  # this and the sizes of pushes and shadow: what the default profile withstands
MARKERS_ON = "markers.enabled=true"
GLIMPSE_S = 0.3  # shorter than the supervisor's patience of 0.5 s

Read = Callable[[Robot], float]
Turn = Callable[[Robot, float], None]
Blend = Callable[[float, float], float]


@checked
@dataclass(frozen=True, slots=True, eq=False)
class Knob:
    """One number of the world. `read` creates whatever it needs; `blend` combines its value with a fault's size."""

    read: Read
    turn: Turn
    blend: Blend


@checked
@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault. `low` and `high` bound its size; if they are equal, the size is fixed.

    `outcome` is that of a hover with the default size and duration, 6 s after the fault begins, with the default profile
    or, for another robot that ships, with its own:

        holds     all limits of the hover hold
        degrades  a limit fails, the robot flies on
        failsafe  the supervisor opens the loop, the robot flies on
        lost      the flight ends there
        (empty)   not stated: a user's own kind
    """

    meaning: str
    unit: str  # of the size
    size: float  # default
    low: float
    high: float
    knobs: tuple[Knob, ...] = field(repr=False)
    outcome: Outcome = ""
    scale: float = 1.0  # from the unit to SI
    duration_s: float = math.inf  # default; inf: to the end of the flight
    link: Literal["", "radio", "mavlink"] = ""  # the only link that it affects
    markers: bool = False  # affects markers: only with `markers.enabled`
    body: str = (
        ""  # the only body with the part that fails, also the name of its profile; or of the file of a user's
    )

    @property
    def sized(self) -> bool:
        """Whether its size can be chosen."""
        return self.low < self.high

    @property
    def needs(self) -> str:
        """The requirements on the flight, as options of `floaty fly`; empty: none."""
        if self.is_of_file:
            return f"[robot] body = {self.body}"
        if self.body not in ("", DEFAULT_PROFILE):
            return f"--profile {self.body}"
        return f"--link {self.link}" if self.link else f"--set {MARKERS_ON}" if self.markers else ""

    def acts_on(self, body: str) -> bool:
        """Whether a robot with this body has the part that fails."""
        return self.body in ("", body) or (self.is_of_file and self.body == Path(body).name)

    @property
    def is_of_file(self) -> bool:
        """Whether its body is a user's."""
        return self.body.endswith(".py")


def add(value: float, size: float) -> float:
    """Add up."""
    return value + size


def times(value: float, size: float) -> float:
    """Multiply the factors."""
    return value * size


def either(value: float, size: float) -> float:
    """Return the chance of one or the other."""
    return 1.0 - (1.0 - value) * (1.0 - size)


@checked
def knob(owner: Callable[[Robot], object], name: str, blend: Blend) -> Knob:
    """Return the knob for a plain attribute of a part of the robot, by part and attribute name.

    Raises `LabError` for an attribute that is missing or not a number.
    """
    try:
        part = owner(probe("", markers=True))
    except Exception as error:
        raise LabError(f"knob {name!r}: {blame(error)}") from error
    if name not in (known := attributes_of(part)):
        raise LabError(f"knob {name!r} of {type(part).__name__}: {hint(name, known)}")
    return _attribute(owner, name, blend)


@cache
def _attribute(owner: Callable[[Robot], object], name: str, blend: Blend) -> Knob:
    return Knob(
        lambda robot: float(getattr(owner(robot), name)),
        lambda robot, value: setattr(owner(robot), name, value),
        blend,
    )


# A kind states what it needs: its link, or markers.
_mocap = partial(_attribute, lambda robot: robot.mocap)
_markers = partial(_attribute, lambda robot: robot.mocap.markers)
_radio = partial(_attribute, lambda robot: robot.air)
_serial = partial(_attribute, lambda robot: robot.uart)


def _component(
    index: int, read: Callable[[Robot], Sequence[float]], write: Callable[[Robot, list[float]], object]
) -> Knob:
    """Return the knob for one component of a vector."""

    def turn(robot: Robot, value: float) -> None:
        values = list(map(float, read(robot)))
        values[index] = value
        write(robot, values)

    return Knob(lambda robot: float(read(robot)[index]), turn, add)


@cache
def _setting(name: str, blend: Blend) -> Knob:
    return Knob(
        lambda robot: robot.body.settings[name].read(),
        lambda robot, value: robot.body.settings[name].write(value),
        blend,
    )


def _of_body(body: str, one: Failure) -> Kind:
    blend = {"add": add, "times": times}[one.blend]
    return Kind(
        one.meaning, one.unit, one.size, one.low, one.high, (_setting(one.setting, blend),), one.outcome, one.scale,
        body=body,
    )  # fmt: skip


def _bias(axis: int) -> Knob:
    return _component(
        axis, lambda robot: robot.imu.rate_bias, lambda robot, bias: robot.imu.set_rate_bias(*bias)
    )


def _side_wind(axis: int) -> Knob:
    def write(robot: Robot, wind: list[float]) -> None:
        wind[axis] = max(-20.0, min(wind[axis], 20.0))
        robot.body.tunnel.set_side_wind(*wind)

    return _component(axis, lambda robot: robot.body.tunnel.side_wind, write)


def _push(part: int) -> Knob:
    def write(robot: Robot, pushes: list[float]) -> None:
        robot.push(pushes[:3], pushes[3:])

    return _component(part, lambda robot: list(robot.pushes), write)


UPLINK_LOSS, DOWNLINK_LOSS = (_radio(f"{way}_loss", either) for way in ("uplink", "downlink"))
RADIO_BITS = tuple(_radio(f"{way}_bit_error_rate", either) for way in ("uplink", "downlink"))
SERIAL_BITS = tuple(_serial(f"{way}_bit_error_rate", either) for way in ("uplink", "downlink"))
GYRO_NOISE = Knob(
    lambda robot: robot.imu.noise_scale,
    lambda robot, value: robot.imu.set_noise_scale(min(value, 1000.0)),
    times,
)
GYRO_RANGE = Knob(
    lambda robot: robot.imu.rate_range, lambda robot, value: robot.imu.set_rate_range(value), min
)
FREEZE = Knob(lambda robot: float(robot.imu.frozen), lambda robot, value: robot.imu.freeze(value > 0.5), max)
SILENCE = Knob(
    lambda robot: float(robot.imu.silent), lambda robot, value: robot.imu.silence(value > 0.5), max
)
FANS = Knob(
    lambda robot: robot.body.tunnel.fan_factor,
    lambda robot, value: robot.body.tunnel.set_fan_factor(min(value, 2.0)),
    times,
)
SHADOW = Knob(
    lambda robot: robot.body.tunnel.shadow,
    lambda robot, value: robot.body.tunnel.block(0.0, 0.0, OCCLUSION_RADIUS, value),
    either,
)
GUSTS = Knob(
    lambda robot: robot.body.tunnel.gust_scale,
    lambda robot, value: robot.body.tunnel.set_gust_scale(min(value, 5.0)),
    times,
)
LOAD = _attribute(lambda robot: robot.thief, "share", lambda value, size: min(value + size, 1.0))
SAG = _attribute(lambda robot: robot.battery, "sag_V", add)

DEG = math.radians(1.0)
MS = 1e3  # us: times stay whole microseconds

KINDS: dict[str, Kind] = {
    "mocap.dropout": Kind(
        "share of the frames in which the body is not tracked", "", 1.0, 0.0, 1.0,
        (_mocap("dropout", either),), "holds", duration_s=GLIMPSE_S,
    ),
    "mocap.outlier": Kind(
        "every position is wrong by this distance, each in its own random direction", "m", 0.3, 0.0, 5.0,
        (_mocap("wrong_by", max),), "holds", duration_s=GLIMPSE_S,
    ),
    "mocap.swap": Kind(
        "markers swapped: every pose is turned by 180 deg about z and shifted by this along x of B", "m", 0.1, 0.001, 1.0,
        (_mocap("swapped_by", max),), "holds", duration_s=GLIMPSE_S,
    ),
    "mocap.freeze": Kind(
        "every frame repeats the last pose, with a new time stamp", "", 1.0, 1.0, 1.0,
        (_mocap("frozen", max),), "holds", duration_s=GLIMPSE_S,
    ),
    "mocap.latency": Kind(
        "the cameras' computer needs this much longer", "ms", 40.0, 0.0, 500.0,
        (_mocap("more_latency_us", add),), "holds", MS,
    ),
    "marker.hidden": Kind(
        "this many markers are covered, from the first one on", "", 4.0, 0.0, 8.0,
        (_markers("hidden", max),), "holds", markers=True,
    ),
    "marker.swap": Kind(
        "markers 1 and 3 have each other's label: the pose is turned over, or missing where the fit is found bad",
        "", 1.0, 1.0, 1.0, (_markers("swapped", max),), "holds", duration_s=GLIMPSE_S, markers=True,
    ),
    "marker.noise": Kind(
        "factor on the noise of every marker", "", 2.0, 0.0, 100.0,
        (_markers("noise_scale", times),), "holds", markers=True,
    ),
    "marker.ghosts": Kind(
        "this many additional reflections, which are not markers", "", 5.0, 0.0, 50.0,
        (_markers("ghosts", add),), "holds", markers=True,
    ),
    "radio.loss": Kind(
        "packets lost on the air, per try, in both directions", "", 0.5, 0.0, 1.0,
        (UPLINK_LOSS, DOWNLINK_LOSS), "holds", link="radio",
    ),
    "radio.uplink_loss": Kind(
        "packets to the board lost on the air, per try", "", 0.5, 0.0, 1.0, (UPLINK_LOSS,), "holds", link="radio"
    ),
    "radio.downlink_loss": Kind(
        "answers of the board lost on the air, per try", "", 0.5, 0.0, 1.0, (DOWNLINK_LOSS,), "holds", link="radio"
    ),
    "radio.bit_errors": Kind(
        "wrong bits on the air, in both directions; one of them loses the packet", "", 1e-3, 0.0, 0.5, RADIO_BITS, "holds",
        link="radio",
    ),
    "radio.jitter": Kind(
        "packets to the board wait up to this long at the host", "ms", 15.0, 0.0, 500.0,
        (_radio("uplink_jitter_us", add),), "holds", MS, link="radio",
    ),
    "radio.cut": Kind(
        "nothing passes, in either direction", "", 1.0, 1.0, 1.0, (UPLINK_LOSS, DOWNLINK_LOSS), "holds",
        duration_s=GLIMPSE_S, link="radio",
    ),
    "serial.bit_errors": Kind(
        "wrong bits on the line, in both directions", "", 1e-4, 0.0, 0.5, SERIAL_BITS, "holds", link="mavlink"
    ),
    "serial.cut": Kind(
        "the cable is out", "", 0.0, 0.0, 0.0, (_serial("connected", times),), "holds", duration_s=GLIMPSE_S, link="mavlink"
    ),
    **{
        f"imu.bias.{name}": Kind(
            f"the gyro's zero about {axis} has moved", "deg/s", 5.0, -200.0, 200.0, (_bias(index),), "holds", DEG
        )
        for index, (name, axis) in enumerate(zip("pqr", "xyz", strict=True))
    },
    "imu.noise": Kind(
        "factor on the white noise of gyro and accelerometer", "", 10.0, 0.0, 1000.0, (GYRO_NOISE,), "holds"
    ),
    "imu.saturation": Kind(
        "the gyro's range ends here", "deg/s", 20.0, 1.0, 2000.0, (GYRO_RANGE,), "holds", DEG
    ),
    "imu.freeze": Kind("the IMU repeats its last sample", "", 1.0, 1.0, 1.0, (FREEZE,), "failsafe", duration_s=GLIMPSE_S),
    "imu.silent": Kind(
        "the IMU raises no data-ready interrupt", "", 1.0, 1.0, 1.0, (SILENCE,), "failsafe", duration_s=GLIMPSE_S
    ),
    **{name: _of_body(body, one) for body, kinds in FAILURES.items() for name, one in kinds.items()},
    "wind.side_x": Kind("side wind along x of W", "m/s", 0.25, -20.0, 20.0, (_side_wind(0),), "degrades"),
    "wind.side_y": Kind("side wind along y of W", "m/s", 2.0, -20.0, 20.0, (_side_wind(1),), "degrades"),
    "wind.fan": Kind("factor on all that the fans blow", "", 0.95, 0.0, 2.0, (FANS,), "degrades"),
    "wind.occlusion": Kind(
        "share of the flow that something below the robot takes away", "", 0.2, 0.0, 1.0, (SHADOW,), "degrades",
        duration_s=0.4,
    ),
    "wind.gusts": Kind("factor on the gusts", "", 2.0, 0.0, 5.0, (GUSTS,), "degrades"),
    **{
        f"push.{axis}": Kind(
            f"force along {axis} of W", "N", size, -20.0, 20.0, (_push(part),), "degrades", duration_s=PUSH_S
        )
        for part, (axis, size) in enumerate((("x", 1.0), ("y", 2.0), ("z", 2.0)))
    },
    **{
        f"push.{angle}": Kind(
            f"torque about {axis} of B", "N m", 0.02, -1.0, 1.0, (_push(3 + part),), "holds", duration_s=PUSH_S
        )
        for part, (angle, axis) in enumerate(zip(("roll", "pitch", "yaw"), "xyz", strict=True))
    },
    "cpu.load": Kind(
        "share of every tick that a task above all others takes", "", 0.3, 0.0, 1.0, (LOAD,), "holds"
    ),
    "battery.sag": Kind("the supply is this much lower", "V", 1.0, 0.0, 4.0, (SAG,), "failsafe"),
}  # fmt: skip

SHIPPED = frozenset(KINDS)


@checked
def declare(name: str, kind: Kind) -> Kind:
    """Register a user's kind of fault under a name. Raises `LabError` for a taken name or failing knobs."""
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise LabError(f"fault kind {name!r}: a name has letters, digits, dots, hyphens and underscores")
    if name in SHIPPED:
        raise LabError(f"fault kind {name}: the laboratory has one of that name")
    if not (kind.knobs and kind.low <= kind.size <= kind.high):
        raise LabError(
            f"fault kind {name}: size {kind.size:g} in {kind.low:g}..{kind.high:g}, {len(kind.knobs)} knobs: expected the "
            "size within its bounds, and a knob"
        )
    if not kind.is_of_file:  # whose robot is not known here: its flight tries the knobs
        _try(name, kind)
    KINDS[name] = kind
    return kind


def _try(name: str, kind: Kind) -> None:
    """Change and reset all knobs of a kind, on every robot that it affects. Raises `LabError` when that fails."""
    for link in (kind.link,) if kind.link else LINKS:
        robot = probe(link, kind.markers)
        for one in kind.knobs:
            try:
                before = one.read(robot)
                turned = one.blend(before, kind.scale * kind.size)
                if not (fits(before, float) and fits(turned, float)):
                    raise LabError(f"from {shown(before)} to {shown(turned)}: expected a number")
                one.turn(robot, turned)
                one.turn(robot, before)
            except Exception as error:
                raise LabError(f"fault kind {name}: with --link {link}: {blame(error)}") from error
