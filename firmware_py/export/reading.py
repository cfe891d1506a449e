"""Reads the modules of the flight core: constants, structs and the signatures of the kernels, with their comments.

What stands inside a kernel is left to `expressions.py` and `functions.py`. Nothing is run: the text alone counts.
"""

import ast
import io
import tokenize
from collections.abc import Mapping

import numpy as np

from firmware_py.export.errors import refusal
from firmware_py.export.syntax import (
    ARRAYS,
    C_KEYWORDS,
    ENTRY,
    F32,
    I32,
    PACKAGE,
    SCALARS,
    SHARED,
    SUBSET,
    VOID,
    Constant,
    Kernel,
    Kind,
    Module,
    Named,
    StructField,
    StructType,
)


def read_modules(texts: Mapping[str, str]) -> list[Module]:
    """Return the modules that the entry module needs, each after those that it imports; texts by module name."""
    done: dict[str, Module] = {}
    _read_after_imports(ENTRY, texts, done, ())
    return list(done.values())


def _read_after_imports(
    name: str, texts: Mapping[str, str], done: dict[str, Module], chain: tuple[str, ...]
) -> None:
    if name in done:
        return
    path = f"firmware_py/core/{name}.py"
    tree = ast.parse(texts[name], path)
    for node in tree.body:
        for needed in _imported_modules(node):
            if needed in chain or needed == name or needed not in texts:
                raise refusal(path, node, f"cannot import {needed}: not a module of the core, or in a circle")
            _read_after_imports(needed, texts, done, (*chain, name))
    done[name] = _Reader(name, path, texts[name], tree, done).module


def _imported_modules(node: ast.stmt) -> list[str]:
    if not isinstance(node, ast.ImportFrom):
        return []
    if node.module == PACKAGE:
        return [alias.name for alias in node.names]
    if node.module and node.module.startswith(PACKAGE + ".") and node.module != SUBSET:
        return [node.module.removeprefix(PACKAGE + ".")]
    return []


class _Reader:
    """Reads one module."""

    def __init__(self, name: str, path: str, text: str, tree: ast.Module, done: dict[str, Module]) -> None:
        self.module = Module(name, path, ast.get_docstring(tree) or "")
        self._done = done
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                own_line = not token.line[: token.start[1]].strip()
                comments = self.module.standing if own_line else self.module.trailing
                words = token.string.lstrip("# ").split("  # ")[0]
                if not words.startswith(("fmt:", "noqa", "type:")):
                    comments[token.start[0]] = words
        for node in tree.body:
            self._statement(node)

    def _statement(self, node: ast.stmt) -> None:
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                return
            case ast.ImportFrom():
                self._import(node)
            case ast.Assign(targets=[ast.Name(id=name)]):
                self._assign(node, name)
            case ast.ClassDef():
                self._define(node.name, self._struct(node))
            case ast.FunctionDef():
                self._define(node.name, self._kernel(node))
            case _:
                raise refusal(self.module.path, node, f"{type(node).__name__} at the top of a module")

    def _define(self, name: str, thing: Named) -> None:
        self.module.names[name] = thing
        self.module.own.append(thing)

    def _import(self, node: ast.ImportFrom) -> None:
        if node.module == SUBSET:
            self.module.builtins |= {alias.name for alias in node.names}
        elif node.module == PACKAGE:
            self.module.names |= {alias.name: self._done[alias.name] for alias in node.names}
        elif node.module and node.module.startswith(PACKAGE + "."):
            source = self._done[node.module.removeprefix(PACKAGE + ".")]
            self.module.names |= {alias.name: source.names[alias.name] for alias in node.names}
        elif node.module != "typing":
            raise refusal(self.module.path, node, f"import from {node.module}")
        if any(alias.asname for alias in node.names):
            raise refusal(self.module.path, node, "import under another name")

    def _assign(self, node: ast.Assign, name: str) -> None:
        if isinstance(node.value, ast.Attribute) and isinstance(node.value.value, ast.Name):
            source = self.module.names.get(node.value.value.id)
            if isinstance(source, Module) and node.value.attr in source.names:
                self.module.names[name] = source.names[node.value.attr]
                return
        literal = constant_literal(node.value)
        if literal is None:
            raise refusal(
                self.module.path, node, f"constant {name} is neither f32(number) nor a 32-bit integer"
            )
        kind, text = literal
        shared = self.module.name == SHARED
        c_name = f"FLOATY_{name}" if shared else name
        self._define(name, Constant(c_name, kind, text, self.module.comment(node), shared))

    def _struct(self, node: ast.ClassDef) -> StructType:
        if [ast.unparse(base) for base in node.bases] != ["Struct"]:
            raise refusal(self.module.path, node, f"class {node.name} is not a Struct")
        fields: dict[str, StructField] = {}
        for line in node.body:
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name) and line.value is None:
                name = self._identifier(line.target.id, line)
                kind = self._field_kind(line.annotation, line)
                fields[name] = StructField(
                    name, kind, self.module.above(line.lineno), self.module.comment(line)
                )
            elif not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)):
                raise refusal(self.module.path, line, "a struct has nothing but fields")
        return StructType(node.name, ast.get_docstring(node) or "", fields)

    def _field_kind(self, annotation: ast.expr, node: ast.stmt) -> Kind:
        match annotation:
            case ast.Name(id="f32" | "i32" as base):
                return Kind(base)
            case ast.Subscript(
                value=ast.Name(id="Annotated"), slice=ast.Tuple(elts=[ast.Name(id=array), *sizes])
            ):
                values = [size.value for size in sizes if isinstance(size, ast.Constant)]
                shape = tuple(value for value in values if isinstance(value, int))
                if array in ARRAYS and len(shape) == len(sizes) in (1, 2):
                    return Kind(ARRAYS[array], len(shape), shape)
        raise refusal(self.module.path, node, f"field type {ast.unparse(annotation)}")

    def _kernel(self, node: ast.FunctionDef) -> Kernel:
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
        public = self.module.name == ENTRY
        c_name = f"floaty_core_{node.name}" if public else f"{self.module.name}_{node.name}"
        return Kernel(c_name, self.module.path, node, arguments, result, public, self.module)

    def _argument_kind(self, argument: ast.arg, node: ast.FunctionDef) -> Kind:
        match argument.annotation:
            case ast.Name(id=name) if name in SCALARS:
                return SCALARS[name]
            case ast.Name(id=name) if name in ARRAYS:
                return Kind(ARRAYS[name], 1)
            case ast.Name(id=name) if isinstance(self.module.names.get(name), StructType):
                return Kind(name)
            case ast.Subscript(value=ast.Name(id="Memory"), slice=ast.Name(id=name)) if isinstance(
                self.module.names.get(name), StructType
            ):
                return Kind(name, memory=True)
        raise refusal(
            self.module.path, argument, f"argument {argument.arg} of {node.name} has no type of the subset"
        )

    def _identifier(self, name: str, node: ast.AST) -> str:
        if name in C_KEYWORDS:
            raise refusal(self.module.path, node, f"{name} is a word of C")
        return name


def constant_literal(node: ast.expr) -> tuple[Kind, str] | None:
    """Return type and C literal of `f32(number)`, `i32(integer)` or an integer; None for anything else."""
    match node:
        case ast.Call(func=ast.Name(id="f32"), args=[argument], keywords=[]):
            number = _number(argument)
            with np.errstate(over="ignore"):
                value = np.float32(0 if number is None else number)
            return (F32, float_literal(value)) if number is not None and np.isfinite(value) else None
        case ast.Call(func=ast.Name(id="i32"), args=[argument], keywords=[]):
            node = argument
    number = _number(node)
    if isinstance(number, int) and -(2**31) < number < 2**31:
        return I32, str(number)
    return None


def float_literal(value: np.float32) -> str:
    """Return the shortest decimal that every correct compiler reads as this very float."""
    text = str(value)
    return f"{text if '.' in text or 'e' in text else text + '.0'}f"


def _number(node: ast.expr) -> int | float | None:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
            return -value
    return None
