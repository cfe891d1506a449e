"""Reads the types that a module of the core or of the user writes: of fields with their marks, of arguments and results."""

import ast
from collections.abc import Mapping
from typing import Any

from firmware_py.core.subset import Logged, Sensed, Settable, Tunable
from firmware_py.export import hints
from firmware_py.export.errors import FollowUpError, RefusalError, refusal
from firmware_py.export.syntax import (
    ARRAYS,
    I32,
    SCALARS,
    VOID,
    Constant,
    Mark,
    Module,
    StructType,
    ValueType,
)

MARKS: Mapping[str, type[Any]] = {mark.__name__: mark for mark in (Tunable, Logged, Sensed, Settable)}
MARK_FORM = 'Tunable(default, "unit", low=.., high=..) of a parameter, Logged("unit") of memory, Sensed("unit") of a sensor'


class Annotations:
    """Reads the annotations of one module."""

    def __init__(self, module: Module) -> None:
        self._module = module

    def _refuse(self, node: ast.AST, reason: str) -> RefusalError:
        return refusal(self._module.path, node, reason)

    def field_kind(self, annotation: ast.expr, node: ast.stmt) -> tuple[ValueType, tuple[Mark, ...]]:
        """Return the type of a field and its marks."""
        match annotation:
            case ast.Name(id="f32" | "i32" as base):
                return ValueType(base), ()
            case ast.Subscript(
                value=ast.Name(id="Annotated"), slice=ast.Tuple(elts=[ast.Name(id=name), *rest])
            ):
                calls = [one for one in rest if isinstance(one, ast.Call)]
                marks = tuple(self._mark(call, node) for call in calls)
                values = [self._size(size) for size in rest if not isinstance(size, ast.Call)]
                shape = tuple(value for value in values if isinstance(value, int))
                sizes = len(rest) - len(marks)
                if self._module.own and len(marks) > 1:
                    raise self._refuse(node, f"field with {len(marks)} marks: write one of them")
                if name in ARRAYS and len(shape) == sizes in (1, 2):
                    return ValueType(ARRAYS[name], len(shape), shape), marks
                if name in ("f32", "i32") and not sizes:
                    return ValueType(name), marks
        name = ast.unparse(node).partition(":")[0]
        hint = f": write {name}: {self._type_for(annotation)}"
        raise self._refuse(node, f"field type {ast.unparse(annotation)}{hint}")

    @staticmethod
    def _type_for(annotation: ast.expr | None) -> str:
        """Return the type of the subset that comes nearest to another one."""
        match annotation:
            case ast.Subscript(value=ast.Name(id="Annotated"), slice=ast.Tuple(elts=[ast.Name(id=name), *_])):
                pass
            case ast.Subscript(value=value):
                name = ast.unparse(value)
            case None:
                return "f32"
            case _:
                name = ast.unparse(annotation)
        return hints.TYPES.get(name.rpartition(".")[2], "f32, or i32")

    def _size(self, node: ast.expr) -> object:
        """Return the value of a number or constant; None for anything else."""
        known = self._module.names.get(node.id) if isinstance(node, ast.Name) else None
        if isinstance(known, Constant) and known.kind == I32:
            return int(known.text)
        return node.value if isinstance(node, ast.Constant) else None

    def _mark(self, call: ast.Call, node: ast.stmt) -> Mark:
        """Return a field's mark as a parameter or a log variable."""
        name = ast.unparse(call.func)
        try:
            given = [self._value(argument) for argument in call.args]
            named = {str(keyword.arg): self._value(keyword.value) for keyword in call.keywords}
            mark: Mark = MARKS[name](*given, **named)
            numbers = (mark.default, mark.low, mark.high) if isinstance(mark, Tunable) else ()
            typed = isinstance(mark.unit, str) and all(type(number) in (int, float) for number in numbers)
            if not self._module.own or (
                typed and (numbers or mark in (Logged(mark.unit), Sensed(mark.unit)))
            ):
                return mark
        except (KeyError, TypeError, ValueError):
            pass
        raise self._refuse(node, f"{ast.unparse(call)}: expected {MARK_FORM}")

    def _value(self, node: ast.expr) -> Any:
        """Return the value of a literal, or of a constant of this module."""
        constant = self._module.names.get(node.id) if isinstance(node, ast.Name) else None
        return int(constant.text) if isinstance(constant, Constant) else ast.literal_eval(node)

    def result(self, node: ast.FunctionDef) -> ValueType:
        """Return the type of a function's result."""
        match node.returns:
            case ast.Constant(value=None):
                return VOID
            case ast.Name(id=name) if name in SCALARS:
                return SCALARS[name]
        returned = [part.value for part in ast.walk(node) if isinstance(part, ast.Return)]
        form = self._type_for(node.returns) if any(returned) else "None"
        reason = f"{node.name} has no result type f32, i32, bool or None: write -> {form.partition(',')[0]}"
        raise self._refuse(node, reason)

    def argument_kind(self, argument: ast.arg, node: ast.FunctionDef) -> ValueType:
        """Return the type of an argument."""
        match argument.annotation:
            case ast.Name(id=name) if name in self._module.broken:
                raise FollowUpError(name)
            case ast.Name(id=name) if name in SCALARS:
                return SCALARS[name]
            case ast.Name(id=name) if name in ARRAYS:
                return ValueType(ARRAYS[name], 1)
            case ast.Name(id=name) if isinstance(struct := self._module.names.get(name), StructType):
                return ValueType(struct.name, struct=struct)
        reason = f"argument {argument.arg} of {node.name} has no type of the subset"
        raise self._refuse(argument, f"{reason}{self._type_of_argument(argument)}")

    def _type_of_argument(self, argument: ast.arg) -> str:
        """Return ": write ..." with a type for an argument."""
        structs = {name: one for name, one in self._module.names.items() if isinstance(one, StructType)}
        if isinstance(argument.annotation, ast.Name | ast.Attribute):
            name = ast.unparse(argument.annotation).rpartition(".")[2]
            if name in hints.TYPES:
                array = hints.TYPES[name].startswith("Annotated")
                form = "F32s" if array else hints.TYPES[name].partition(",")[0]
                return f": write {argument.arg}: {form}"
            near = hints.nearest(name, [*structs, *SCALARS, *ARRAYS], f"{argument.arg}: ")
            if name in hints.HOMES or "there are" not in near:
                return hints.nearest(name, []) or near
        meant = {"data": "Input"}.get(argument.arg, argument.arg.capitalize())
        return f": write {argument.arg}: {meant if meant in structs or meant in hints.HOMES else 'f32'}"
