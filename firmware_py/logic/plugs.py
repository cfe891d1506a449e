"""The plug points of the core, and what a user's module provides for them, read from its text.

A hook is a kernel with a fixed name. It takes those of these arguments that it names:

    parameters: Parameters, data: Input, estimator: Estimator, control: Control     of the core
    own: a struct whose fields are all Tunable                                      the module's parameters
        memory: a struct                                                                its state; fields may be Logged
        sensed: a struct whose fields are all Sensed                                    the robot's own sensors
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from inspect import signature
from math import isfinite
from types import FunctionType

import numpy as np

from firmware_py import table
from firmware_py.core import entry
from firmware_py.core.subset import Logged, Sensed, Tunable
from firmware_py.export.errors import RefusalError
from firmware_py.export.locals import find_writes
from firmware_py.export.syntax import BROKEN, I32, VOID, Module, Signature, StructField, StructType, ValueType
from firmware_py.table import SCALARS, CoreParameter, CoreVariable, Place
from firmware_py.wire.toc import MAX_NAME

GROUP = "logic"  # of parameters, log variables and columns of the log
PARAMETER_ROOM = 12  # characters: MAVLink has 16, of which OWN_ takes four
VARIABLE_ROOM = MAX_NAME - len(GROUP)
BLOCKS = {name: kind.__name__ for name, kind in table.BLOCKS.items()}  # of the core, in their order
CORE_STRUCTS = {
    name: BLOCKS[name] for name in ("parameters", "data", "estimator", "control")
}  # that hooks may take
OWN, MEMORY, SENSED = "own", "memory", "sensed"
_SIGNATURES = {
    name: signature(function)
    for name, function in vars(entry).items()
    if isinstance(function, FunctionType) and name != "kernel" and not name.startswith("_")
}
# The default core's entry points, and the blocks that they take; those that have an answer.
CALLS: Mapping[str, tuple[str, ...]] = {name: tuple(one.parameters) for name, one in _SIGNATURES.items()}
ANSWERING = frozenset(name for name, one in _SIGNATURES.items() if one.return_annotation is not None)


@dataclass(frozen=True, slots=True)
class PlugPoint:
    """A place for a user's module: its hooks with their results, and the arguments that they may write."""

    name: str  # the key of the profile
    hooks: Mapping[str, ValueType]
    writes: frozenset[str]


CONTROLLER = PlugPoint("controller", {"control_law": VOID, "reset_law": VOID}, frozenset({"control", MEMORY}))
ESTIMATOR = PlugPoint(
    "estimator", {"reset": VOID, "file_pose": I32, "estimate": VOID}, frozenset({"estimator", MEMORY})
)
POINTS = (CONTROLLER, ESTIMATOR)


@dataclass(frozen=True, slots=True)
class Plug:
    """A module at its plug point."""

    point: PlugPoint
    hooks: Mapping[str, tuple[str, ...]]  # the arguments of those that it has
    structs: Mapping[str, StructType]  # by argument: own, memory, sensed
    parameters: tuple[CoreParameter, ...]
    variables: tuple[CoreVariable, ...]
    charged: Mapping[str, int]  # cycles of the hooks in which loops are charged

    def block(self, argument: str) -> str:
        """Return the name of the memory behind an argument of a hook."""
        return argument if argument in CORE_STRUCTS else f"{self.point.name}_{argument}"


def read_plug(point: PlugPoint, module: Module) -> Plug:
    """Return what a module provides; its `refusals` have what does not fit, with file, line and what is expected."""
    hooks: dict[str, tuple[str, ...]] = {}
    structs: dict[str, StructType] = {}
    kernels = [thing for thing in module.defined if isinstance(thing, Signature)]
    for kernel in kernels:
        find_writes(kernel)
        if kernel.node.name in point.hooks:
            with module.refusals.note():
                _check_signature(point, kernel, structs)
            hooks[kernel.node.name] = tuple(kernel.arguments)
    for name in point.hooks:
        if name not in hooks and not (name == "reset_law" and MEMORY not in structs):
            there = ", ".join(kernel.node.name for kernel in kernels) or "none"
            with module.refusals.note():
                if name not in module.broken:
                    raise _refusal(
                        module, 1, f"no function {name}; functions there: {there}: write def {name}"
                    )
    parameters: list[CoreParameter] = []
    variables: list[CoreVariable] = []
    for field in structs[OWN].fields.values() if OWN in structs else ():
        with module.refusals.note():
            parameters.append(_parameter(point, module, field))
    for argument in (MEMORY, SENSED):
        for field in structs[argument].fields.values() if argument in structs else ():
            with module.refusals.note():
                variables += _variables(point, argument, module, field)
    structs = dict(sorted(structs.items(), reverse=True))  # sensed, own, memory
    return Plug(point, hooks, structs, tuple(parameters), tuple(variables), {})


def _refusal(module: Module, line: int, reason: str) -> RefusalError:
    return RefusalError(module.path, line, reason)


def _check_signature(point: PlugPoint, kernel: Signature, structs: dict[str, StructType]) -> None:
    """Check what a hook takes and writes, and note the module's own structs."""
    name, module, line = kernel.node.name, kernel.scope, kernel.node.lineno
    for argument, kind in list(kernel.arguments.items()):
        if kind == BROKEN:
            continue
        fits = kind.base == CORE_STRUCTS.get(argument)
        if argument in (OWN, MEMORY, SENSED) and any(kind.struct is thing for thing in module.defined):
            assert kind.struct is not None
            fits = structs.setdefault(argument, kind.struct) is kind.struct
        if not fits:
            known = ", ".join(f"{key}: {value}" for key, value in CORE_STRUCTS.items())
            text = f"{name}: argument {argument}: expected any of {known}; own, memory, sensed: a struct of this file each"
            with module.refusals.note():
                kernel.arguments[argument] = BROKEN
                raise _refusal(module, line, text)
        elif argument in kernel.writes and argument not in point.writes:
            with module.refusals.note():
                may = " and ".join(sorted(point.writes))
                raise _refusal(
                    module, line, f"{name} writes {argument}: it may write {may}: write to a field of memory"
                )
    if kernel.result not in (BROKEN, point.hooks[name]):
        result = {"void": "None"}.get(point.hooks[name].base, point.hooks[name].base)
        kernel.result = BROKEN
        raise _refusal(module, line, f"{name}: expected -> {result}")


def _parameter(point: PlugPoint, module: Module, field: StructField) -> CoreParameter:
    name, mark = field.name, field.mark
    if not isinstance(mark, Tunable) or field.kind.rank:
        form = 'Annotated[f32, Tunable(default, "unit", low=.., high=..)]'
        raise _refusal(module, field.line, f"{name}: a parameter is {form}")
    scalar = SCALARS[field.kind.base]
    for number in (mark.default, mark.low, mark.high):
        held = scalar.cast(number)
        if not isfinite(held) or not (scalar.is_float or held == number):
            kind = "finite" if scalar.is_float else "whole"
            raise _refusal(module, field.line, f"{name}: {number:g}: expected a {kind} number of 32 bits")
    if not mark.low <= mark.default <= mark.high:
        text = f"{name}: default {mark.default:g} is outside {mark.low:g}..{mark.high:g}: write one inside"
        raise _refusal(module, field.line, text)
    if any(point.name == name for point in POINTS):
        raise _refusal(
            module, field.line, f"{name}: this name exists already, as a key of [logic]: write another name"
        )
    if len(name) > PARAMETER_ROOM:
        text = f"{name}: {len(name)} characters; MAVLink leaves a parameter's name {PARAMETER_ROOM}: write a shorter name"
        raise _refusal(module, field.line, text)
    return CoreParameter(
        f"{GROUP}.{name}", scalar, mark.unit, Place(f"{point.name}_{OWN}", name, scalar),
        low=mark.low, high=mark.high, default=mark.default,
    )  # fmt: skip


def _variables(point: PlugPoint, argument: str, module: Module, field: StructField) -> Iterator[CoreVariable]:
    mark, kind = field.mark, field.kind
    if argument == SENSED and (not isinstance(mark, Sensed) or kind.base != "f32" or kind.rank == 2):
        form = 'Annotated[f32, Sensed("unit")], or Annotated[F32s, n, Sensed("unit")]'
        raise _refusal(module, field.line, f"{field.name}: what a sensor measures is {form}")
    if mark is None:
        return
    if not isinstance(mark, Sensed if argument == SENSED else Logged) or kind.rank == 2:
        text = (
            f"{field.name}: in the memory numbers and lists of them may be Logged; parameters stand in `own`"
        )
        raise _refusal(module, field.line, text)
    for index in np.ndindex(kind.shape):
        name = "".join((field.name, *(str(number + 1) for number in index)))
        if len(name) > VARIABLE_ROOM:
            text = f"{name}: {len(name)} characters; a log variable's name has at most {VARIABLE_ROOM}: write a shorter name"
            raise _refusal(module, field.line, text)
        scalar = SCALARS[kind.base]
        place = Place(f"{point.name}_{argument}", field.name, scalar, index)
        yield CoreVariable(f"{GROUP}.{name}", scalar, mark.unit, place)
