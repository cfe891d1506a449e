"""Reads the laboratory's kernels from live functions: what they call, and the structs and numbers that they name.

The core's reader only parses text, because users' own logic goes through it. These kernels are parts of the laboratory and
imported already: a name means what it means to Python, in the globals of the function. So a struct is its dtype, and a
constant its value. Numbers are `f64` and integers; an integer is 64 bits wide everywhere but in memory. They may call the
core's kernels, which keep the core's types.
"""

import ast
import inspect
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType
from typing import Any, cast, get_origin

import numpy as np
from numpy.typing import NDArray

from firmware_py.core import subset
from firmware_py.core.subset import F32s, F64s, I32s, I64s, Integer, Struct, f32, f64, i32
from firmware_py.export.errors import ExportError, refusal
from firmware_py.export.literals import literal
from firmware_py.export.locals import find_writes
from firmware_py.export.reading import read_comments
from firmware_py.export.syntax import (
    BOOL,
    F32,
    F64,
    I32,
    I64,
    PACKAGE,
    VOID,
    Constant,
    Module,
    Signature,
    StructField,
    StructType,
    ValueType,
    parsed,
)

ARGUMENTS: tuple[tuple[Any, ValueType], ...] = (
    (f64, F64), (f32, F32), (int, I64), (i32, I64), (Integer, I64), (bool, BOOL),
    (F64s, ValueType("f64", 1)), (F32s, ValueType("f32", 1)), (I32s, ValueType("i32", 1)),
    (I64s, ValueType("i64", 1)),
)  # fmt: skip
Arrays = tuple[NDArray[Any], ...]
CALL = "call_of"  # in C, of `subset.call`
ELEMENTS = {np.dtype(f64): "f64", np.dtype(f32): "f32", np.dtype(i32): "i32", np.dtype(np.int64): "i64"}


@dataclass(slots=True)
class LiveModule(Module):
    """A module that is imported: what its names mean, and its functions' syntax by their first lines."""

    live: Mapping[str, Any] = field(default_factory=dict)
    functions: Mapping[int, ast.FunctionDef] = field(default_factory=dict)

    @property
    def core(self) -> bool:
        """Whether this is a module of the flight core."""
        return str(self.live["__name__"]).startswith(f"{PACKAGE}.")


@dataclass(slots=True)
class Kernels:
    """Kernels and all that they call, in the order of C, and their structs with the dtypes."""

    roots: list[Signature]
    kernels: list[Signature]
    structs: list[tuple[StructType, np.dtype[Any]]]


def read_kernels(functions: Sequence[Callable[..., Any]], arrays: Arrays) -> Kernels:
    """Return kernels that take records and arrays like these, and integers behind them.

    Raises `ExportError` for anything that has no equal in C.
    """
    reader = _Reader()
    roots = [reader.kernel(cast(FunctionType, function)) for function in functions]
    for kernel in roots:
        given = list(kernel.arguments.values())[len(arrays) :]
        if len(arrays) > len(kernel.arguments) or any(kind != I64 for kind in given):
            raise ExportError(
                f"{kernel.c_name} takes {len(kernel.arguments)} arguments, not {len(arrays)} and integers"
            )
        for (name, kind), array in zip(kernel.arguments.items(), arrays, strict=False):
            if kind.rank and kind.base == ELEMENTS.get(array.dtype):
                kernel.arguments[name] = ValueType(ELEMENTS[array.dtype], array.ndim, array.shape)
            elif kind.struct is None or array.dtype != reader.structs[kind.base][1]:
                raise ExportError(f"{name} of {kernel.c_name}: {array.dtype} is not its memory")
    return Kernels(roots, list(reader.kernels.values()), list(reader.structs.values()))


class _Reader:
    def __init__(self) -> None:
        self.kernels: dict[FunctionType, Signature] = {}
        self.structs: dict[str, tuple[StructType, np.dtype[Any]]] = {}
        self._modules: dict[str, LiveModule] = {}
        self._open: list[FunctionType] = []

    def kernel(self, function: FunctionType) -> Signature:
        """Return a kernel after all that it calls."""
        if function in self.kernels:
            return self.kernels[function]
        module = self._module(function)
        node = module.functions.get(function.__code__.co_firstlineno)
        if node is None or node.name != function.__name__:
            raise ExportError(
                f"{module.path}: has no function {function.__name__} where it was imported from"
            )
        if function in self._open:
            raise refusal(module.path, node, f"{function.__name__} calls itself: recursion")
        self._open.append(function)
        for name in _names(node):
            self._define(module, name)
        self._open.pop()
        hints = function.__annotations__
        arguments = {one.arg: self._kind(module, one, hints.get(one.arg)) for one in node.args.args}
        result = VOID if hints.get("return", 0) is None else self._kind(module, node, hints.get("return"))
        c_name = f"{module.name}_{function.__name__}"
        kernel = Signature(c_name, module.path, node, arguments, result, False, module)
        find_writes(kernel)
        if any(module.live[name] is subset.call for name in _names(node) if name in module.builtins):
            kernel.calls.add(CALL)
        self.kernels[function] = kernel
        return kernel

    def _module(self, function: FunctionType) -> LiveModule:
        path = function.__code__.co_filename
        if path not in self._modules:
            text = Path(path).read_text("utf-8")
            tree = parsed(text, path)
            functions = {
                min([node.lineno, *(one.lineno for one in node.decorator_list)]): node
                for node in tree.body
                if isinstance(node, ast.FunctionDef)
            }
            name = function.__module__.replace(".", "_")
            doc = ast.get_docstring(tree) or ""
            module = LiveModule(name, path, doc, live=function.__globals__, functions=functions)
            module.builtins = {
                key
                for key, thing in module.live.items()
                if callable(thing) and vars(subset).get(key) is thing
            }
            read_comments(module, text)
            self._modules[path] = module
        return self._modules[path]

    def _define(self, module: LiveModule, name: str) -> None:
        """Give a kernel or a constant that a name means to the module."""
        thing = module.live.get(name)
        if name in module.names or name in module.builtins or thing is None:
            return
        if isinstance(thing, FunctionType):
            module.names[name] = self.kernel(thing)
        elif isinstance(call := getattr(thing, "call", None), FunctionType):  # for `yield from`
            module.names[name] = self.kernel(call)
        elif constant := _constant(f"{module.name}_{name}", thing, I32 if module.core else I64):
            module.names[name] = constant
            module.defined.append(constant)

    def _kind(self, module: LiveModule, node: ast.AST, annotation: Any) -> ValueType:
        if inspect.isclass(annotation) and issubclass(annotation, Struct):
            struct = self._struct(annotation)
            return ValueType(struct.name, struct=struct)
        if get_origin(annotation) is Generator:
            return I64
        for known, kind in ARGUMENTS:
            if annotation == known:
                return I32 if module.core and kind == I64 else kind
        raise refusal(module.path, node, f"{annotation!r} has no equal in C")

    def _struct(self, struct: type[Struct]) -> StructType:
        dtype = struct.dtype
        if struct.__name__ not in self.structs:
            fields = {}
            for name in dtype.names or ():
                element, shape = dtype[name].subdtype or (dtype[name], ())
                kind = ValueType(ELEMENTS[element], len(shape), shape)
                fields[name] = StructField(name, kind, "", "", 0)
            made = StructType(struct.__name__, inspect.getdoc(struct) or "", fields)
            self.structs[struct.__name__] = made, dtype
        found, its_dtype = self.structs[struct.__name__]
        if its_dtype != dtype:
            raise ExportError(f"two structs have the name {struct.__name__}")
        return found


def _names(node: ast.FunctionDef) -> Iterator[str]:
    """Yield the names that a function reads, without its annotations."""
    for line in node.body:
        for part in ast.walk(line):
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Load):
                yield part.id


def _constant(c_name: str, value: object, integer: ValueType) -> Constant | None:
    """Return a number, or numbers in a row, as a constant of C; None for anything else."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int):
        return Constant(c_name, integer, str(int(value)), "", False)
    if isinstance(value, np.float32):
        return Constant(c_name, F32, literal(value), "", False)
    if isinstance(value, float):
        return Constant(c_name, F64, double_literal(value), "", False)
    if isinstance(value, tuple) and value and all(isinstance(one, float) for one in value):
        text = ", ".join(double_literal(one) for one in value)
        return Constant(c_name, ValueType("f64", 1, (len(value),)), f"{{{text}}}", "", False)
    if isinstance(value, tuple) and value and all(isinstance(one, int) for one in value):
        text = ", ".join(str(one) for one in value)
        return Constant(c_name, ValueType("i64", 1, (len(value),)), f"{{{text}}}", "", False)
    return None


def double_literal(value: float) -> str:
    """Return the shortest decimal that every correct compiler reads as exactly this double."""
    if value != value:
        return '__builtin_nan("")'
    return repr(float(value)).replace("inf", "__builtin_inf()")
