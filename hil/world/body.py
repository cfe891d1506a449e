"""The laboratory's interface to a robot's body: timer outputs in; motion, air, supply power, loss and log columns out.

Floaty (`hil.world.floaty.plant`) is one of them. SI units; frames W (world, z up) and B (body, x forward, y left, z up,
origin at the centre of mass). Times are the laboratory's, in whole microseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hil.world.room import Room
from hil.world.scene import Markers, VisualModel
from hil.world.tunnel import Tunnel

Vector = Sequence[float]
ACTUATORS = (1, 2, 3, 4)  # the numbers of a body's servos or motors, as in their names
View = NDArray[np.float64]  # read-only, of memory that lives as long as the body


@dataclass(frozen=True, slots=True)
class Quantity:
    """Columns of the log that share a unit and a frame (W, B, G, S or empty)."""

    names: tuple[str, ...]
    unit: str
    frame: str = ""


@dataclass(frozen=True, slots=True)
class Channel:
    """Columns that are read together: `read` returns the values of all the quantities' columns in order (or one number)."""

    dtype: str
    read: Callable[[], Any]
    quantities: tuple[Quantity, ...]


@dataclass(frozen=True, slots=True)
class OwnSensor:
    """A sensor of a user's body, for own logic: the names of its numbers, their unit, and what it measures now."""

    names: tuple[str, ...]
    unit: str
    read: Callable[[], Sequence[float]]


@dataclass(frozen=True, slots=True)
class Setting:
    """A number of a body that a fault changes in flight."""

    read: Callable[[], float]
    write: Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Failure:
    """A kind of fault of a body: the size in `unit`, and the settings that it changes, in SI by `scale`."""

    meaning: str
    unit: str
    size: float  # default
    low: float
    high: float
    setting: str
    blend: Literal["add", "times"]  # combines sizes with one another and with the setting
    outcome: Literal["holds", "degrades", "failsafe", "lost"]  # of the hover, as of `Kind`
    scale: float = 1.0


def of_each_actuator(kinds: Mapping[str, Failure]) -> dict[str, Failure]:
    """Return the kinds for each of the four actuators: its number takes the place of {} in names and texts."""
    return {
        name.format(number): replace(
            kind, meaning=kind.meaning.format(number), setting=kind.setting.format(number)
        )
        for name, kind in kinds.items()
        for number in ACTUATORS
    }


class Motion(Protocol):
    """The current truth, as views of fixed memory."""

    @property
    def state(self) -> View:
        """p_WB [m], v_WB [m/s], q_WB (w x y z) and omega_B [rad/s] in one piece, (13,)."""

    @property
    def p_WB(self) -> View:
        """(3,) [m]."""

    @property
    def q_WB(self) -> View:
        """(4,) w x y z, of unit length."""

    @property
    def omega_B(self) -> View:
        """(3,) [rad/s] of B against W, in B."""

    @property
    def specific_force_B(self) -> View:
        """(3,) [m/s2] as measured by an accelerometer at the centre of mass; (0, 0, g) at rest."""

    @property
    def vibration(self) -> View:
        """(2,) [rad/s, m/s2] rms per axis that motors add to a sample's rate and specific force."""

    @property
    def flow_W(self) -> View:
        """(3,) [m/s] of the air at the centre of mass."""


@dataclass(frozen=True, slots=True)
class Carrier:
    """What carries a board: a body's motion, the room around it, the random stream of the sensors, decks by name.

    `escs` (4,) are the speeds [rpm] of motors whose ESCs take DSHOT at the board's outputs; None: it has no ESCs.
    """

    motion: Motion
    rng: np.random.Generator
    room: Room = field(default_factory=Room)
    decks: tuple[str, ...] = ()
    escs: View | None = None


class Body(Motion, Protocol):
    """A flying body. It starts at rest, and is held from `hold` to `release`."""

    @property
    def outputs(self) -> Sequence[tuple[int, int]]:
        """Timer and channel, from 0, of the microcontroller's outputs that drive it: M1 to M4."""

    @property
    def tunnel(self) -> Tunnel:
        """The air around it, whose knobs faults change."""

    @property
    def pushes(self) -> View:
        """The force [N, W] and torque [N m, B] of the last `push`, (6,)."""

    @property
    def room(self) -> Room:
        """The surfaces around it that its distance sensors see."""

    @property
    def escs(self) -> View | None:
        """The speeds of motors with ESCs that take DSHOT [rpm], (4,); None: it has none."""

    @property
    def look(self) -> VisualModel:
        """Its look, for the pictures."""

    @property
    def markers(self) -> Markers:
        """Its markers for the cameras."""

    @property
    def settings(self) -> Mapping[str, Setting]:
        """The settings that faults may change, besides `push` and `tunnel`, by name."""

    @property
    def sensors(self) -> Mapping[str, OwnSensor]:
        """The sensors that a user's robot declares, by name; own logic reads their samples."""

    @property
    def lost(self) -> str | None:
        """The first reason why the flight is over, with its value and unit; None while it flies."""

    @property
    def lift(self) -> float:
        """The force [N] along z of B that air, floor and holder have on it: rotors in still air push the air as hard."""

    def advance(self, now_us: int) -> None:
        """Advance the truth by all of its steps that end at or before `now_us`."""

    def set_counts(self, now_us: int, counts: Sequence[int]) -> None:
        """Take the compare counts of the timers at `outputs`; they take effect when they would on hardware."""

    def draw(self, now_us: int, cell_V: float) -> float:
        """Return the mean power [W] of the whole robot since the last call, at `cell_V` [V] per cell."""

    def hold(self) -> None:
        """Clamp the body where it is, at rest; actuators, air and sensors continue."""

    def release(self) -> None:
        """Release it."""

    def put_back(self, p_WB: Vector) -> None:
        """Hold it upright at a place, as at its start, and clear the cause of a loss; the actuators continue."""

    def push(self, force_W: Vector, torque_B: Vector = (0.0, 0.0, 0.0)) -> None:
        """Apply a force [N] at the centre of mass and a torque [N m] until the next call."""

    def channels(self) -> tuple[Channel, ...]:
        """Return its log channels besides its motion."""
