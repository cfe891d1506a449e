"""Reads the modules of the flight core: constants, structs and the signatures of the kernels, with their comments.

The body of a kernel is left to `expressions.py` and `functions.py`. The text is only parsed, never run.
"""

import ast
import io
import tokenize
from collections.abc import Mapping
from math import prod
from typing import Any

from firmware_py.core.subset import Logged, Settable, Tunable
from firmware_py.export import hints
from firmware_py.export.errors import ExportError, refusal
from firmware_py.export.literals import array_literal, constant_literal
from firmware_py.export.syntax import (
    ARRAYS,
    C_KEYWORDS,
    CORE,
    ENTRY,
    OWN,
    PACKAGE,
    SCALARS,
    SHARED,
    SUBSET,
    VOID,
    Constant,
    Mark,
    Module,
    Named,
    Signature,
    StructField,
    StructType,
    ValueType,
)

MARKS: Mapping[str, type[Any]] = {"Tunable": Tunable, "Logged": Logged, "Settable": Settable}
MOST_NUMBERS = 65536  # in the constant arrays of a module: 256 KiB, a quarter of the flash
MARK_FORM = 'Tunable(default, "unit", low=.., high=..) of a parameter, or Logged("unit") of the memory'


def read_modules(texts: Mapping[str, str], own: Mapping[str, str], first: str = ENTRY) -> list[Module]:
    """Return the modules that the `first` one needs, each after those that it imports; texts by module name.

    `own` has the files of the user's modules, whose errors include a replacement.
    """
    done: dict[str, Module] = {}
    _read_after_imports(first, texts, own, done, ())
    return list(done.values())


def _read_after_imports(
    name: str,
    texts: Mapping[str, str],
    own: Mapping[str, str],
    done: dict[str, Module],
    chain: tuple[str, ...],
) -> None:
    if name in done:
        return
    path = own.get(name, f"firmware_py/core/{name}.py")
    try:
        tree = ast.parse(texts[name], path)
    except SyntaxError as error:
        raise ExportError(f"{path}:{error.lineno or 1}: {error.msg}") from None
    for node in tree.body:
        for needed in _imported_modules(node):
            if needed in chain or needed == name or needed not in texts:
                raise refusal(path, node, f"cannot import {needed}: not a module of the core, or in a circle")
            _read_after_imports(needed, texts, own, done, (*chain, name))
    done[name] = _Reader(
        Module(name, path, ast.get_docstring(tree) or "", name in own), texts[name], tree, done
    ).module


def _imported_modules(node: ast.stmt) -> list[str]:
    if not isinstance(node, ast.ImportFrom):
        return []
    if node.module in (PACKAGE, OWN):
        return [alias.name for alias in node.names]
    if node.module and node.module.startswith(PACKAGE + ".") and node.module != SUBSET:
        return [node.module.removeprefix(PACKAGE + ".")]
    return []


def read_comments(module: Module, text: str) -> None:
    """Add the comments of a text to its module."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            own_line = not token.line[: token.start[1]].strip()
            comments = module.standing if own_line else module.trailing
            words = token.string.lstrip("# ").split("  # ")[0]
            if not words.startswith(("fmt:", "noqa", "type:")):
                comments[token.start[0]] = words


class _Reader:
    def __init__(self, module: Module, text: str, tree: ast.Module, done: dict[str, Module]) -> None:
        self.module = module
        self._tree = tree
        self._done = done
        self._numbers = 0  # in constant arrays
        read_comments(module, text)
        for node in tree.body:
            self._statement(node)

    def _statement(self, node: ast.stmt) -> None:
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                return
            case ast.Import() | ast.ImportFrom(module="numpy" | "math"):
                place, reason = hints.first_use(self._tree, node)
                raise refusal(self.module.path, place, reason)
            case ast.ImportFrom():
                self._import(node)
            case ast.Assign(targets=[ast.Name(id=name)]):
                self._assign(node, name)
            case ast.ClassDef():
                self._define(node.name, self._struct(node), node)
            case ast.FunctionDef():
                self._define(node.name, self._kernel(node), node)
            case _:
                raise refusal(self.module.path, node, f"{type(node).__name__} at the top of a module")

    def _define(self, name: str, thing: Named, node: ast.stmt) -> None:
        if name in self.module.names or name in self.module.builtins:
            raise refusal(self.module.path, node, f"{name}: this name exists already")
        self.module.names[name] = thing
        self.module.defined.append(thing)

    def _take(self, name: str, thing: "Named | Module", node: ast.stmt) -> None:
        """Take a name from another module."""
        if self.module.own and isinstance(thing, Signature) and thing.c_name in hints.GUARDED:
            text = f"{thing.node.name} of {thing.scope.path}{hints.instead(hints.GUARDED, thing.c_name)}"
            raise refusal(self.module.path, node, text)
        self.module.names[name] = thing

    def _import(self, node: ast.ImportFrom) -> None:
        if node.module == SUBSET:
            self.module.builtins |= {alias.name for alias in node.names}
        elif node.module in (PACKAGE, OWN):
            self.module.names |= {alias.name: self._done[alias.name] for alias in node.names}
        elif node.module and node.module.startswith(PACKAGE + "."):
            source = self._done[node.module.removeprefix(PACKAGE + ".")]
            for alias in node.names:
                if alias.name not in source.names:
                    raise refusal(self.module.path, node, f"{node.module} has no {alias.name}")
                self._take(alias.name, source.names[alias.name], node)
        elif node.module != "typing":
            raise refusal(self.module.path, node, f"import from {node.module}")
        if any(alias.asname for alias in node.names):
            raise refusal(self.module.path, node, "import under another name")

    def _assign(self, node: ast.Assign, name: str) -> None:
        if isinstance(node.value, ast.Attribute) and isinstance(node.value.value, ast.Name):
            source = self.module.names.get(node.value.value.id)
            if isinstance(source, Module) and node.value.attr in source.names:
                thing = source.names[node.value.attr]
                self._take(name, thing, node)
                if isinstance(thing, Signature) and self.module.name == ENTRY and not name.startswith("_"):
                    thing.c_name, thing.public = f"{CORE}{name}", True
                return
        literal = self._array(name, node.value) or constant_literal(node.value)
        if literal is None:
            reason = f"constant {name} is none of f32(number), a 32-bit integer and constant(numbers)"
            raise refusal(self.module.path, node, reason)
        kind, text = literal
        shared = self.module.name == SHARED and not kind.rank
        c_name = f"FLOATY_{name}" if shared else name
        self._define(name, Constant(c_name, kind, text, self.module.comment(node), shared), node)

    def _array(self, name: str, node: ast.expr) -> tuple[ValueType, str] | None:
        """Return type and C literal of `constant(..)`; None for anything else."""
        match node:
            case ast.Call(func=ast.Name(id="constant"), args=rows, keywords=[]):
                kind, text = array_literal(self.module.path, node, name, rows)
                self._numbers += prod(kind.shape)
                if self._numbers > MOST_NUMBERS:
                    reason = f"{name}: {self._numbers} numbers in the constant arrays of this file: at most {MOST_NUMBERS}"
                    raise refusal(self.module.path, node, reason)
                return kind, text
        return None

    def _struct(self, node: ast.ClassDef) -> StructType:
        if [ast.unparse(base) for base in node.bases] != ["Struct"]:
            raise refusal(self.module.path, node, f"class {node.name} is not a Struct")
        fields: dict[str, StructField] = {}
        for line in node.body:
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name) and line.value is None:
                name = self._identifier(line.target.id, line)
                if name in fields:
                    raise refusal(self.module.path, line, f"{name}: this name exists already")
                kind, marks = self._field_kind(line.annotation, line)
                above, comment = self.module.above(line.lineno), self.module.comment(line)
                for mark in marks:
                    if isinstance(mark, Settable) and not comment:
                        comment = f"[{mark.unit}] {mark.meaning}"
                fields[name] = StructField(name, kind, above, comment, line.lineno, marks)
            elif not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)):
                raise refusal(self.module.path, line, "a struct has nothing but fields")
        if not fields:
            raise refusal(self.module.path, node, f"struct {node.name} has no field")
        prefix = self.module.name.removeprefix("own_").capitalize() if self.module.own else ""
        return StructType(prefix + node.name, ast.get_docstring(node) or "", fields)

    def _field_kind(self, annotation: ast.expr, node: ast.stmt) -> tuple[ValueType, tuple[Mark, ...]]:
        match annotation:
            case ast.Name(id="f32" | "i32" as base):
                return ValueType(base), ()
            case ast.Subscript(
                value=ast.Name(id="Annotated"), slice=ast.Tuple(elts=[ast.Name(id=name), *rest])
            ):
                calls = [one for one in rest if isinstance(one, ast.Call)]
                marks = tuple(self._mark(call, node) for call in calls)
                values = [size.value for size in rest if isinstance(size, ast.Constant)]
                shape = tuple(value for value in values if isinstance(value, int))
                sizes = len(rest) - len(marks)
                if self.module.own and len(marks) > 1:
                    raise refusal(self.module.path, node, f"field with {len(marks)} marks")
                if name in ARRAYS and len(shape) == sizes in (1, 2):
                    return ValueType(ARRAYS[name], len(shape), shape), marks
                if name in ("f32", "i32") and not sizes:
                    return ValueType(name), marks
        raise refusal(self.module.path, node, f"field type {ast.unparse(annotation)}")

    def _mark(self, call: ast.Call, node: ast.stmt) -> Mark:
        """Return a field's mark as a parameter or a log variable."""
        name = ast.unparse(call.func)
        try:
            given = [self._value(argument) for argument in call.args]
            named = {str(keyword.arg): self._value(keyword.value) for keyword in call.keywords}
            mark: Mark = MARKS[name](*given, **named)
            numbers = (mark.default, mark.low, mark.high) if isinstance(mark, Tunable) else ()
            typed = isinstance(mark.unit, str) and all(type(number) in (int, float) for number in numbers)
            if not self.module.own or (typed and (numbers or mark == Logged(mark.unit))):
                return mark
        except (KeyError, TypeError, ValueError):
            pass
        raise refusal(self.module.path, node, f"{ast.unparse(call)}: expected {MARK_FORM}")

    def _value(self, node: ast.expr) -> Any:
        """Return the value of a literal, or of a constant of this module."""
        constant = self.module.names.get(node.id) if isinstance(node, ast.Name) else None
        return int(constant.text) if isinstance(constant, Constant) else ast.literal_eval(node)

    def _kernel(self, node: ast.FunctionDef) -> Signature:
        if [ast.unparse(decorator) for decorator in node.decorator_list] != ["kernel"]:
            raise refusal(self.module.path, node, f"function {node.name} is not marked @kernel alone")
        listed = node.args
        if listed.vararg or listed.kwarg or listed.kwonlyargs or listed.posonlyargs or listed.defaults:
            raise refusal(self.module.path, node, f"{node.name}: only plain arguments without defaults")
        arguments = {self._identifier(a.arg, node): self._argument_kind(a, node) for a in listed.args}
        result = VOID
        if not (isinstance(node.returns, ast.Constant) and node.returns.value is None):
            name = node.returns.id if isinstance(node.returns, ast.Name) else ""
            if name not in SCALARS:
                raise refusal(
                    self.module.path, node, f"{node.name} has no result type f32, i32, bool or None"
                )
            result = SCALARS[name]
        if outside := hints.outside_subset(node):
            raise refusal(self.module.path, outside[0], f"{outside[1]} (in {node.name})")
        public = self.module.name == ENTRY
        c_name = f"{CORE}{node.name}" if public else f"{self.module.name}_{node.name}"
        return Signature(c_name, self.module.path, node, arguments, result, public, self.module)

    def _argument_kind(self, argument: ast.arg, node: ast.FunctionDef) -> ValueType:
        match argument.annotation:
            case ast.Name(id=name) if name in SCALARS:
                return SCALARS[name]
            case ast.Name(id=name) if name in ARRAYS:
                return ValueType(ARRAYS[name], 1)
            case ast.Name(id=name) if isinstance(struct := self.module.names.get(name), StructType):
                return ValueType(struct.name, struct=struct)
        raise refusal(
            self.module.path, argument, f"argument {argument.arg} of {node.name} has no type of the subset"
        )

    def _identifier(self, name: str, node: ast.AST) -> str:
        if name in C_KEYWORDS:
            raise refusal(self.module.path, node, f"{name} is a word of C")
        if not name.isascii() or name.startswith("__"):
            raise refusal(
                self.module.path, node, f"{name}: expected a name of a-z, 0-9 and _ without __ in front"
            )
        return name
