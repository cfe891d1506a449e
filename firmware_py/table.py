"""The table of variables: every parameter and log variable of the flight core, as its fields declare them.

All code that serves, writes, stores, exports or documents a variable reads it here: the tables of contents, MAVLink's
parameters, the exported app, the keys of a profile, and the board's names for these keys.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np

from firmware_py.core.structs import Control, Estimator, Input, Parameters, Report, Sampling, Supervisor
from firmware_py.core.subset import F32s, Logged, Settable, f32
from firmware_py.wire.scalars import Scalar

SCALARS = {"f32": Scalar.F32, "i32": Scalar.I32}  # by the core's types


BLOCKS: Mapping[str, type] = {
    "parameters": Parameters, "data": Input, "estimator": Estimator, "control": Control, "sampling": Sampling,
    "supervisor": Supervisor, "report": Report,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Place:
    """Where a number is: the block, its field, and the element of an array."""

    block: str
    field: str
    scalar: Scalar  # in memory
    index: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class CoreVariable:
    """A number of the core under its name on the board; `stock`: the Crazyflie firmware has this name, too."""

    name: str
    scalar: Scalar
    unit: str
    place: Place
    stock: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class CoreParameter(CoreVariable):
    """A variable that clients may set from `low` to `high`; memory holds `scale` times that.

    `key` is its name in a profile, "section.key" or "section.key[element]"; empty: it is not in a profile.
    """

    low: float
    high: float
    key: str = ""
    scale: int = 1
    persistent: bool = True
    default: float = 0.0  # of own logic, where a profile has none

    @property
    def bounds(self) -> tuple[float, float]:
        """The lowest and highest allowed value in a profile's unit."""
        low, high = sorted((self.low * self.scale, self.high * self.scale))
        return low, high


@dataclass(frozen=True, slots=True)
class ProfileKey:
    """A key of the profile: a float32 or an int32, or `count` of them."""

    name: str
    base: str
    count: int
    mark: Settable


def whole_names(listed: str) -> list[str]:
    """Return "group.one" and "group.two" of "group.one two"."""
    group, _, ends = listed.partition(".")
    return [f"{group}.{end}" for end in ends.split()]


@dataclass(frozen=True, slots=True)
class _Field:
    block: str
    name: str
    base: str
    shape: tuple[int, ...]
    marks: tuple[Logged | Settable, ...]

    def named(self, mark: Logged | Settable) -> Iterator[tuple[int, CoreVariable]]:
        """Yield the numbers that a mark names, each with its index among the names."""
        scalar = Scalar[mark.type] if mark.type else SCALARS[self.base]
        unit = getattr(mark, "shown", "") or mark.unit
        section = "" if isinstance(mark, Logged) else mark.section
        names = mark.names or (section and f"{section}.{self.name}")
        for listed, stock in ((names, False), (mark.stock, True)):
            for number, name in enumerate(whole_names(listed)):
                element = np.unravel_index(mark.first + mark.step * number, self.shape) if self.shape else ()
                place = Place(self.block, self.name, SCALARS[self.base], tuple(map(int, element)))
                yield number, CoreVariable(name, scalar, unit, place, stock)

    def keys(self, mark: Settable) -> list[str]:
        """Return the keys of the numbers that a mark names."""
        words = (mark.key or self.name).split()
        if not mark.section:
            words = [""] * self.count
        elif len(words) < self.count:
            words = [f"{words[0]}[{element}]" for element in range(self.count)]
        return [word and f"{mark.section}.{word}" for word in words]

    @property
    def count(self) -> int:
        """How many numbers it holds."""
        return int(np.prod(self.shape))


def _declared(block: str, fields: type) -> Iterator[_Field]:
    for name, annotation in fields.__annotations__.items():
        kind, *extras = get_args(annotation) or (annotation,)
        shape = tuple(size for size in extras if isinstance(size, int))
        marks = tuple(mark for mark in extras if isinstance(mark, Logged | Settable))
        yield _Field(block, name, "f32" if kind in (f32, F32s) else "i32", shape, marks)


_FIELDS = tuple(field for block, fields in BLOCKS.items() for field in _declared(block, fields))

# In the order of the fields.
CORE_VARIABLES = tuple(
    variable
    for field in _FIELDS
    for mark in field.marks
    if isinstance(mark, Logged)
    for _, variable in field.named(mark)
)


def _parameters() -> Iterator[CoreParameter]:
    for field in _FIELDS:
        for mark in field.marks:
            if isinstance(mark, Settable):
                low, high = sorted((mark.low / mark.scale, mark.high / mark.scale))
                keys = field.keys(mark)
                for number, seen in field.named(mark):
                    yield CoreParameter(
                        seen.name, seen.scalar, seen.unit, seen.place, seen.stock,
                        low=low, high=high, key=keys[number], scale=mark.scale, persistent=mark.persistent,
                    )  # fmt: skip


CORE_PARAMETERS = tuple(_parameters())
OF_PROFILE: Mapping[str, CoreParameter] = {
    parameter.key: parameter for parameter in CORE_PARAMETERS if parameter.key and not parameter.stock
}


def on_board(name: str) -> tuple[str, float]:
    """Return the board's name and the factor for a profile's name; any other name is taken as the board's own."""
    parameter = OF_PROFILE.get(name)
    return (name, 1) if parameter is None else (parameter.name, 1 / parameter.scale)


def value_in(config: object, key: str) -> float:
    """Return a configuration's value for a key of `OF_PROFILE`."""
    section, _, rest = key.partition(".")
    name, _, element = rest.rstrip("]").partition("[")
    value = getattr(getattr(config, section), name)
    return float(value[int(element)] if element else value)


def profile_keys(section: str) -> Iterator[ProfileKey]:
    for field in _FIELDS:
        for mark in field.marks:
            if isinstance(mark, Settable) and mark.section == section:
                words = (mark.key or field.name).split()
                yield from (ProfileKey(word, field.base, field.count // len(words), mark) for word in words)
