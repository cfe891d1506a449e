"""The numbers of all modules are what they were: registers, bits, periods, limits, defaults.

Of each module its constants, the members and defaults of its classes, and the defaults of its functions; the keys of
profiles are approved with the flights. If a change is meant: make approve.
"""

import ast
import inspect
import json
import re
import struct
import sys
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import partial
from hashlib import sha256
from importlib import import_module
from itertools import chain
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

import firmware_py
import ground_station
import hil
from support.approved import approve
from support.paths import ROOT

NUMBERS = Path(__file__).with_name("numbers.json")
VARYING = {"firmware_py.compiling": ("_SOURCES", "PLAIN")}  # filled, or of the environment
EMPTY = ("{}", "()")  # before tests fill it
LONG = 160
HERE = {
    sys.executable: "PYTHON", str(ROOT): "PLACE",
    f"python{sys.version_info.major}.{sys.version_info.minor}": "PYTHON",
}  # fmt: skip
STARTED = ("__main__", "sitecustomize")  # run when they are imported
PLAIN = (bool, int, float, str, bytes, tuple, frozenset)
MODULES = [
    one.name
    for package in (firmware_py, ground_station, hil)
    for one in walk_packages(package.__path__, f"{package.__name__}.")
    if one.name.rpartition(".")[2] not in STARTED
]


def shown(value: Any) -> str:
    """Return a value as text, without what depends on the machine."""
    match value:
        case Enum():
            return f"{type(value).__name__}.{value.name}"
        case bool() | int() | str() | None:
            return repr(value)
        case float():
            return f"{value:.12g}"
        case bytes() | bytearray():
            return f"bytes {value.hex()}"
        case list() | tuple():
            return f"({', '.join(map(shown, value))})"
        case set() | frozenset():
            return f"{{{', '.join(sorted(map(shown, value)))}}}"
        case Mapping():
            return f"{{{', '.join(f'{shown(name)}: {shown(one)}' for name, one in value.items())}}}"
        case np.generic():
            return shown(value.item())
        case np.ndarray():
            return f"{value.dtype} {shown(value.tolist())}"
        case struct.Struct():
            return value.format
        case re.Pattern():
            return repr(value.pattern)
        case Path():
            return value.name if value != ROOT else "PLACE"
    if is_dataclass(value) and not isinstance(value, type):
        return f"{type(value).__name__}{shown([getattr(value, one.name) for one in fields(value)])}"
    return getattr(value, "__name__", type(value).__name__)


def brief(text: str) -> str:
    """Return a text without this machine's places, of a long one its begin and a hash."""
    for here, name in HERE.items():
        text = text.replace(here, name)
    return text if len(text) < LONG else f"{text[: LONG // 2]} .. {sha256(text.encode()).hexdigest()[:12]}"


def assigned(body: list[ast.stmt]) -> Iterator[str]:
    """Yield the names to which a module or class assigns."""
    for statement in body:
        targets = (
            statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
        )
        for node in chain.from_iterable(ast.walk(one) for one in targets if one is not None):
            if isinstance(node, ast.Name):
                yield node.id


def defaults(owner: str, function: Any) -> Iterator[tuple[str, Any]]:
    """Yield the defaults of a function's parameters."""
    for name, one in inspect.signature(function).parameters.items():
        if one.default is not one.empty:
            yield f"{owner}({name})", one.default


def members(kind: type) -> Iterator[tuple[str, Any]]:
    """Yield what a class has besides its methods, and their defaults."""
    if issubclass(kind, Enum):
        yield from ((f"{kind.__name__}.{name}", one.value) for name, one in kind.__members__.items())
        return
    yield from (
        (f"{kind.__name__}.{name}", one) for name, one in getattr(kind, "_field_defaults", {}).items()
    )
    given = fields(kind) if is_dataclass(kind) else ()
    yield from ((f"{kind.__name__}.{one.name}", one.default) for one in given if one.default is not MISSING)
    for name, one in vars(kind).items():
        if inspect.isfunction(one) and one.__module__ == kind.__module__ and name != "__new__":
            yield from () if given and name == "__init__" else defaults(f"{kind.__name__}.{name}", one)
        elif isinstance(one, PLAIN) and not name.startswith(("__", "_is_", "_field")):
            yield f"{kind.__name__}.{name}", one


def numbers(name: str) -> dict[str, str]:
    """Return what a module defines, by name."""
    module = import_module(name)
    names = sorted(set(assigned(ast.parse(inspect.getsource(module)).body)))
    own = [one for one in vars(module).values() if getattr(one, "__module__", "") == name]
    found = chain(
        (
            (one, getattr(module, one))
            for one in names
            if one.strip("_").isupper()
            and one not in VARYING.get(name, ())
            and shown(getattr(module, one)) not in EMPTY
        ),
        *(members(one) for one in own if inspect.isclass(one) and not issubclass(one, BaseModel)),
        *(defaults(one.__name__, one) for one in own if inspect.isfunction(one)),
    )
    return {place: brief(shown(value)) for place, value in found}


@pytest.fixture(scope="module")
def approved() -> dict[str, dict[str, str]]:
    content: dict[str, dict[str, str]] = json.loads(NUMBERS.read_text(encoding="utf-8"))
    return content


@pytest.mark.parametrize("name", MODULES)
def test_the_numbers_of_a_module_are_what_they_were(name: str, approved: dict[str, dict[str, str]]) -> None:
    """New ones are compared from the next `make approve` on."""
    try:
        found, known = numbers(name), approved.get(name, {})
    except ModuleNotFoundError as missing:
        pytest.skip(str(missing))
    both = found.keys() & known.keys()
    assert {one: found[one] for one in both} == {one: known[one] for one in both}


if __name__ == "__main__":
    approve(NUMBERS, {name: partial(numbers, name) for name in MODULES})
