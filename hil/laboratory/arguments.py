"""Checks every call from a user's program: names and types, by the signature of the called function.

Subscripted types are checked element by element; any real number is a `float`, also numpy's, but a bool is not a number.
"""

import inspect
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, Unpack, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np

from hil.errors import LabError, hint, shown

Checked = TypeVar("Checked", bound=Callable[..., Any])
Value = TypeVar("Value")
PLAIN = {
    float: "a number", int: "a whole number", bool: "True or False", str: "text", Path: "a path", type(None): "None",
}  # fmt: skip


class Known(dict[str, Value]):
    """Values by name; reading one that is missing raises `LabError` with the nearest name."""

    def __init__(self, what: str, values: Mapping[str, Value]) -> None:
        super().__init__(values)
        self.what = what

    def __missing__(self, name: str) -> Value:
        raise LabError(f"{self.what} {shown(name)}: there is none; {hint(str(name), self)}")


def checked(function: Checked) -> Checked:
    """Raise `LabError` for every call of a function, or of a class, with an unknown name or a value of a wrong type."""
    if not inspect.isclass(function):
        return _guarded(function, function.__name__)
    function.__init__ = _guarded(function.__init__, function.__name__)  # type: ignore[method-assign]
    return function


def _guarded(function: Checked, name: str) -> Checked:
    signature = inspect.signature(function)
    own = [parameter for parameter in signature.parameters if parameter not in ("self", "cls")]

    @cache
    def expected() -> dict[str, Any]:
        """Return the type of each argument by its name, after all modules have been loaded."""
        found = {name: kind for name, kind in get_type_hints(function).items() if name in own}
        for kind in list(found.values()):
            if get_origin(kind) is Unpack:
                found |= get_type_hints(get_args(kind)[0])
        return found

    @wraps(function)
    def call(*values: Any, **options: Any) -> Any:
        __tracebackhide__ = True  # a failure shows the caller's line
        kinds = expected()
        for option in options.keys() - kinds.keys():
            raise LabError(f"{name}: unknown argument {option!r}; {hint(option, kinds)}")
        values, options = tuple(map(_plain, values)), {key: _plain(value) for key, value in options.items()}
        try:
            arguments = signature.bind(*values, **options).arguments
        except TypeError as error:
            raise LabError(f"{name}: {error}") from None
        for argument, value in arguments.items():
            kind = signature.parameters[argument].kind
            if kind is inspect.Parameter.VAR_KEYWORD:
                for option, one in value.items():
                    _require(name, option, one, kinds[option])
            elif argument in kinds:
                for one in value if kind is inspect.Parameter.VAR_POSITIONAL else (value,):
                    _require(name, argument, one, kinds[argument])
        return function(*values, **options)

    return call  # type: ignore[return-value]


def _plain(value: Any) -> Any:
    """Return a numpy number as a Python number, which can be stored in a file."""
    return value.item() if isinstance(value, np.generic) else value


def _require(function: str, name: str, value: Any, kind: Any) -> None:
    if not fits(value, kind):
        raise LabError(f"{function}: {name} = {shown(value)}: expected {_described(kind)}")


def fits(value: Any, kind: Any) -> bool:
    """Whether a value matches an annotation."""
    origin, parts = get_origin(kind) or kind, get_args(kind)
    if origin is Any or is_typeddict(origin):
        return True
    if origin in (Union, types.UnionType):
        return any(fits(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is Callable:
        return callable(value)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(
            fits(key, parts[0]) and fits(one, parts[1]) for key, one in value.items()
        )
    if origin in (tuple, Sequence, Iterable):
        if not isinstance(value, tuple | list):
            return False
        if origin is tuple and parts[-1] is not ...:
            return len(value) == len(parts) and all(map(fits, value, parts))
        return all(fits(one, parts[0]) for one in value)
    if origin in (float, int):
        return isinstance(value, Real if origin is float else Integral) and _is_number(value)
    if origin in (str, Path):
        return isinstance(value, origin) and _is_text(str(value))
    return isinstance(value, origin)


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except OverflowError:
        return False
    return not isinstance(value, bool)


def _is_text(value: str) -> bool:
    """Whether a file's name or content may be a text."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return "\0" not in value


def _described(kind: Any) -> str:
    origin, parts = get_origin(kind) or kind, get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_described, parts)))
    if origin is Literal:
        return " or ".join(filter(None, (", ".join(map(repr, parts[:-1])), repr(parts[-1]))))
    if origin is Callable:
        return "a function"
    if origin is Mapping:
        return f"a dictionary of {_described(parts[1])} by name"
    if origin is tuple and parts[-1] is not ...:
        return f"{len(parts)} times {_described(parts[0])}"
    if origin in (tuple, Sequence, Iterable):
        return f"a list of {_described(parts[0])}"
    return PLAIN.get(origin) or f"a {getattr(origin, '__name__', origin)}"
