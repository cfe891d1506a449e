"""Every function of the wire returns for random arguments what it returned: coders and readers of all protocols."""

import inspect
import math
import struct
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any, get_type_hints

import pymavlink.dialects.v20.development as dialect
import pytest

from firmware_py.wire import (
    WireError,
    core_port,
    crtp,
    high_level,
    localisation,
    log,
    mavlink,
    mavlink_services,
    memories,
    parameters,
    setpoints,
)
from firmware_py.wire.scalars import PARAMETER_SCALARS, Scalar
from firmware_py.wire.telemetry import ALL_BLOCKS, Sample
from support.approved import approve, judge, tiers
from support.random_use import Random, shown

RETURNED = Path(__file__).with_name("wire.json")
PACKAGES = ("pymavlink",)
MODULES = (
    core_port, crtp, high_level, localisation, log, mavlink, mavlink_services, memories, parameters, setpoints,
)  # fmt: skip
FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, 3.0, 400.0, -720.5, 1e9, 2e9, 1e-9, math.nan, math.inf, -math.inf)
CALLS, TRIES = 200, 30
UNFIT = (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError, struct.error)


def seen(value: Any) -> str:
    """Return a value with six digits; of a message its fields, of a sample the number of its block."""
    match value:
        case bytes():
            return value.hex()
        case dialect.MAVLink_message():
            return seen([*value.to_dict().items()])
        case Sample():
            return seen((value.block.id, value.timestamp_ms, value.values))
        case tuple() | list():
            return f"({', '.join(map(seen, value))})"
    return shown(value, digits=6)


@cache
def declared(function: Callable[..., Any]) -> list[tuple[Any, bool]]:
    """Return the type of each parameter, and whether it takes any number of arguments."""
    hints, listed = get_type_hints(function), inspect.signature(function).parameters.items()
    return [(hints[name], one.kind == one.VAR_POSITIONAL) for name, one in listed]


class Callers(Random):
    """Calls functions with arguments of the types that they declare."""

    def __init__(self, seed: int, module: ModuleType) -> None:
        super().__init__(seed)
        layouts = [one.size for one in vars(module).values() if isinstance(one, struct.Struct)]
        self.sizes = [size + extra for size in layouts for extra in (-1, 0, 1, 2)] + [0, 1, 2]
        text = inspect.getsource(module).upper()
        self.kinds = [one for _, one in sorted(dialect.mavlink_map.items()) if one.msgname in text]
        self.packed: list[bytes] = []
        self.messages: dict[type[dialect.MAVLink_message], list[dialect.MAVLink_message]] = {}
        self.fitting: dict[str, list[type[dialect.MAVLink_message]]] = {}  # by function

    def number(self) -> float:
        """Return a number as programs send them, seldom an extreme one."""
        return self.pick(*FLOATS) if self.below(3) == 0 else 0.01 * (self.below(1000) - 500)

    def whole(self) -> int:
        """Return an integer of some size."""
        return self.below(self.pick(2, 8, 256, 65536, 1 << 31)) - self.pick(0, 0, 0, 1)

    def packet(self) -> bytes:
        """Return bytes as they come: another function's, damaged, or of a length that is read."""
        known = self.pick(*self.packed) if self.packed and self.below(2) else b""
        if not known:
            return bytes((self.below(self.pick(16, 256)),)) + self.data(
                *[max(0, size - 1) for size in self.sizes]
            )
        known = known[self.below(2) :]  # also without a packet's header
        return known[: len(known) - self.below(2)] if self.below(4) == 0 else known

    def message(self, fitting: Sequence[type[dialect.MAVLink_message]]) -> dialect.MAVLink_message:
        """Return another function's message, or one of a type that fits or that the module names, with random fields."""
        kind = self.pick(*fitting) if fitting and self.below(4) else self.pick(*self.kinds)
        if kind in self.messages and self.below(2):
            return self.pick(*self.messages[kind])
        fields = [self.field(kind, index) for index in range(len(kind.fieldnames))]
        made = kind(*fields)
        made._header = dialect.MAVLink_header(kind.id, srcSystem=self.below(9), srcComponent=self.below(9))
        return made

    def field(self, kind: Any, index: int) -> Any:
        """Return the value of a message's field, numbered in the order of its names."""
        at = kind.ordered_fieldnames.index(kind.fieldnames[index])
        size, real = kind.array_lengths[at], kind.fieldtypes[index] in ("float", "double")
        if kind.fieldtypes[index] == "char":
            return b"ab"
        values = [self.number() if real else self.below(100) for _ in range(max(1, size))]
        return values if size else values[0]

    def value(self, kind: Any, function: str = "") -> Any:
        """Return an argument of a type."""
        text = str(kind)
        if kind in (int, float, bool, bytes, str):
            made = {int: self.whole, float: self.number, bool: lambda: self.below(2) == 1, bytes: self.packet}
            return made[kind]() if kind in made else self.pick("hover.x", "ab", "x" * 20, "")
        if inspect.isclass(kind) and issubclass(kind, Enum):
            return self.pick(*kind)
        if kind is Scalar:
            return self.pick(*(one[1] for one in sorted(PARAMETER_SCALARS.items())))
        if kind is dialect.MAVLink_message:
            return self.message(self.fitting.get(function, ()))
        arguments = [one for one in getattr(kind, "__args__", ()) if one is not type(None)]
        if " | " in text or "Union" in text or "Optional" in text:
            return self.value(self.pick(*arguments))
        if text.startswith("tuple") and Ellipsis not in arguments:
            return tuple(map(self.value, arguments))
        if getattr(kind, "__origin__", None) in (Sequence, Iterable, tuple, list):
            rows = hasattr(arguments[0], "__origin__") and arguments[0].__origin__ is Sequence
            return [
                [self.below(99) for _ in "xyz"] if rows else self.value(arguments[0])
                for _ in range(1 + self.below(8))
            ]
        return kind(*(self.value(one) for one, _ in declared(kind)))

    def arguments(self, function: Callable[..., Any]) -> list[Any]:
        """Return arguments of a function."""
        found = []
        for kind, many in declared(function):
            if many:
                kinds = (kind, int) if kind is float else (kind,)
                found += [self.value(self.pick(*kinds)) for _ in range(self.below(9))]
            else:
                found.append(self.value(kind, function.__name__))
        return found

    def call(self, function: Callable[..., Any]) -> str:
        """Call a function until the arguments are of those that it is for, keep what it made, and return its answer."""
        for _ in range(TRIES):
            arguments = self.arguments(function)
            try:
                result = function(*arguments)
            except WireError as error:
                return f"refused {error}"
            except UNFIT:
                continue
            kinds = self.fitting.setdefault(function.__name__, [])
            kinds += [type(one) for one in arguments if type(one) in {*self.kinds} - {*kinds}]
            for one in result if isinstance(result, tuple | list) else (result,):
                if isinstance(one, bytes):
                    self.packed.append(one)
                if isinstance(one, dialect.MAVLink_message):
                    self.messages.setdefault(type(one), []).append(one)
            return seen(result)
        return "unfit"


def functions(module: ModuleType) -> dict[str, Callable[..., Any]]:
    """Return the public functions of a module."""
    return {
        name: one
        for name, one in vars(module).items()
        if inspect.isfunction(one) and one.__module__ == module.__name__ and not name.startswith("_")
    }


def returned(module: ModuleType) -> dict[str, str]:
    """Return what all functions of a module answer."""
    callers = Callers(1, module)
    for _ in range(CALLS):
        for name, function in functions(module).items():
            callers.log.note(name, callers.call(function))
    return callers.log.told()


def units() -> dict[str, str]:
    """Return what scalars and log blocks make of numbers."""
    callers = Callers(1, log)
    for scalar in PARAMETER_SCALARS.values():
        for use in (scalar.cast, scalar.pack, scalar.unpack) * CALLS:
            callers.log.note(f"{scalar.name} {use.__name__}", callers.call(use))
    for number, block in enumerate(ALL_BLOCKS):
        for _ in range(20):
            values = block.unpack(callers.rng.bytes(block.layout.size))
            callers.log.note(f"block {number}", seen(values), seen(block.si_of(values)))
    return callers.log.told()


FOUND: dict[str, Callable[[], dict[str, str]]] = {
    **{module.__name__.rpartition(".")[2]: partial(returned, module) for module in MODULES},
    "units": units,
}


@pytest.mark.parametrize(
    "name", tiers(FOUND, ("high_level", "localisation", "log", "mavlink", "mavlink_services"))
)
def test_the_wire_carries_what_it_carried(name: str) -> None:
    judge(RETURNED, name, FOUND[name](), *PACKAGES)


if __name__ == "__main__":
    approve(RETURNED, FOUND, *PACKAGES)
