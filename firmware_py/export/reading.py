"""Reads the modules of the flight core: constants, structs and the signatures of the kernels, with their comments.

The body of a kernel is left to `expressions.py` and `functions.py`. The text is only parsed, never run.
"""

import ast
import io
import tokenize
from collections.abc import Mapping
from functools import lru_cache
from math import prod
from typing import Any

from firmware_py.core import subset
from firmware_py.core.subset import Settable
from firmware_py.export import hints
from firmware_py.export.annotations import Annotations
from firmware_py.export.errors import ExportError, FollowUpError, RefusalError, Refusals, refusal
from firmware_py.export.literals import array_literal, constant_literal
from firmware_py.export.sieve import Sieve, uses
from firmware_py.export.syntax import (
    BROKEN,
    C_KEYWORDS,
    CORE,
    ENTRY,
    OWN,
    PACKAGE,
    SHARED,
    SUBSET,
    Constant,
    Module,
    Named,
    Signature,
    StructField,
    StructType,
    ValueType,
    parsed,
)

MOST_NUMBERS = 65536  # in the constant arrays of a module: 256 KiB, a quarter of the flash


def read_modules(texts: Mapping[str, str], own: Mapping[str, str], first: str = ENTRY) -> list[Module]:
    """Return the modules that the `first` one needs, each after those that it imports; texts by module name.

    `own` has the files of the user's modules, whose errors include a replacement. All refusals of the `first` one, if it
    is the user's, are in its `refusals`; of the others the first one is raised.
    """
    done: dict[str, Module] = {}
    refusals = Refusals(collecting=first in own)
    _read_after_imports(first, texts, own, done, (), refusals)
    return list(done.values())


def _read_after_imports(
    name: str,
    texts: Mapping[str, str],
    own: Mapping[str, str],
    done: dict[str, Module],
    chain: tuple[str, ...],
    refusals: Refusals,
) -> None:
    if name in done:
        return
    path = own.get(name, f"firmware_py/core/{name}.py")
    try:
        tree = parsed(texts[name], path)
    except SyntaxError as error:
        raise RefusalError(path, error.lineno or 1, str(error.msg)) from None
    for node in tree.body:
        for needed in _imported_modules(node):
            if needed in chain or needed == name or needed not in texts:
                with refusals.note():
                    reason = f"cannot import {needed}: not a module of the core, or in a circle"
                    near = (
                        hints.nearest(needed, texts, f"{PACKAGE}.")
                        if needed not in texts
                        else ": leave it out"
                    )
                    raise refusal(path, node, f"{reason}{near}")
            else:
                _read_after_imports(needed, texts, own, done, (*chain, name), Refusals())
    module = Module(name, path, ast.get_docstring(tree) or "", name in own, refusals=refusals)
    done[name] = _Reader(module, texts[name], tree, done).module


def _imported_modules(node: ast.stmt) -> list[str]:
    if not isinstance(node, ast.ImportFrom):
        return []
    if node.module in (PACKAGE, OWN):
        return [alias.name for alias in node.names]
    if node.module and node.module.startswith(PACKAGE + ".") and node.module != SUBSET:
        return [node.module.removeprefix(PACKAGE + ".")]
    return []


@lru_cache(maxsize=64)
def _comments(text: str) -> tuple[dict[int, str], dict[int, str]]:
    """Return the comments on lines of their own, and those behind code, by their lines."""
    standing: dict[int, str] = {}
    trailing: dict[int, str] = {}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            own_line = not token.line[: token.start[1]].strip()
            comments = standing if own_line else trailing
            words = token.string.lstrip("# ").split("  # ")[0]
            if not words.startswith(("fmt:", "noqa", "type:")):
                comments[token.start[0]] = words
    return standing, trailing


def read_comments(module: Module, text: str) -> None:
    """Add the comments of a text to its module."""
    module.standing, module.trailing = _comments(text)


class _Reader:
    def __init__(self, module: Module, text: str, tree: ast.Module, done: dict[str, Module]) -> None:
        self.module = module
        self._tree = tree
        self._annotations = Annotations(module)
        self._done = done
        self._numbers = 0  # in constant arrays
        read_comments(module, text)
        for name in hints.not_imported(tree) if module.own else ():
            module.broken.add(name.id)
            with module.refusals.note():
                home = hints.HOMES.get(name.id, "typing")
                reason = (
                    f"{name.id} is not imported: write from {home} import {name.id} at the top of the file"
                )
                raise self._refuse(name, reason)
        for node in tree.body:
            with module.refusals.note():
                try:
                    self._statement(node)
                except ExportError:
                    module.broken |= _defined(node) - module.names.keys()
                    raise

    def _refuse(self, node: ast.AST, reason: str) -> RefusalError:
        return refusal(self.module.path, node, reason)

    def _statement(self, node: ast.stmt) -> None:
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                return
            case ast.Import() | ast.ImportFrom(module="numpy" | "math"):
                for place, reason in uses(self._tree, node):
                    with self.module.refusals.note():
                        raise refusal(self.module.path, place, reason)
                raise FollowUpError(node.names[0].name)
            case ast.ImportFrom():
                self._import(node)
            case ast.Assign(targets=[ast.Name(id=name)]):
                self._assign(node, name)
            case ast.ClassDef():
                self._define(node.name, self._struct(node), node)
            case ast.FunctionDef():
                self._define(node.name, self._kernel(node), node)
            case _:
                raise refusal(
                    self.module.path, node, f"{_at_top(node)} at the top of a module{_instead(node)}"
                )

    def _define(self, name: str, thing: Named, node: ast.stmt) -> None:
        if name in self.module.names or name in self.module.builtins:
            raise self._refuse(node, f"{name}: this name exists already: write another one")
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
            self._check_names(node, vars(subset))
            self.module.builtins |= {alias.name for alias in node.names}
        elif node.module in (PACKAGE, OWN):
            known = [alias.name for alias in node.names if alias.name in self._done]
            self.module.names |= {name: self._done[name] for name in known}
            self.module.broken |= {alias.name for alias in node.names} - set(known)
        elif node.module and node.module.startswith(PACKAGE + "."):
            source = self._done.get(node.module.removeprefix(PACKAGE + "."))
            if source is None:
                raise FollowUpError(node.module)
            self._check_names(node, source.names)
            for alias in node.names:
                if alias.name in source.names:
                    self._take(alias.name, source.names[alias.name], node)
        elif node.module != "typing":
            raise self._refuse(node, f"import from {node.module}{hints.imported(node)}")
        for alias in [alias for alias in node.names if alias.asname]:
            reason = f"import under another name: write from {node.module} import {alias.name}"
            raise self._refuse(node, reason)

    def _check_names(self, node: ast.ImportFrom, known: Mapping[str, Any]) -> None:
        """Refuse names that a module of the core does not have."""
        for alias in node.names:
            if alias.name not in known:
                self.module.broken.add(alias.name)
                with self.module.refusals.note():
                    near = hints.instead(hints.FUNCTIONS, alias.name) or hints.nearest(alias.name, known)
                    reason = f"{node.module} has no {alias.name}{near or ': leave it out'}"
                    raise self._refuse(node, reason)

    def _assign(self, node: ast.Assign, name: str) -> None:
        if isinstance(node.value, ast.Attribute) and isinstance(node.value.value, ast.Name):
            source = self.module.names.get(node.value.value.id)
            if isinstance(source, Module) and node.value.attr in source.names:
                thing = source.names[node.value.attr]
                self._take(name, thing, node)
                if isinstance(thing, Signature) and self.module.name == ENTRY and not name.startswith("_"):
                    thing.c_name, thing.public = f"{CORE}{name}", True
                return
        if any(isinstance(part, ast.Name) and part.id in self.module.broken for part in ast.walk(node.value)):
            raise FollowUpError(name)
        literal = self._array(name, node.value) or constant_literal(node.value)
        if literal is None:
            reason = f"constant {name} is none of {hints.CONSTANT_FORM}{hints.constant(name, node.value)}"
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
        bases = [ast.unparse(base) for base in node.bases]
        if bases != ["Struct"]:
            enum = any(base.rpartition(".")[2] in hints.ENUMS for base in bases)
            hint = hints.enumeration(node) if enum else f": write class {node.name}(Struct):"
            raise self._refuse(node, f"class {node.name} is not a Struct{hint}")
        fields: dict[str, StructField] = {}
        broken: set[str] = set()
        for line in node.body:
            with self.module.refusals.note():
                if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                    broken.add(line.target.id)
                    self._field(line, line.target.id, fields)
                    broken.remove(line.target.id)
                elif not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)):
                    broken |= _defined(line) or {""}
                    form = "a @kernel outside" if isinstance(line, ast.FunctionDef) else "a field as x: f32"
                    raise self._refuse(line, f"a struct has nothing but fields: write {form}")
        if not fields and not broken:
            raise self._refuse(node, f"struct {node.name} has no field: write one, as x: f32")
        prefix = self.module.name.removeprefix("own_").capitalize() if self.module.own else ""
        doc = ast.get_docstring(node) or ""
        return StructType(prefix + node.name, doc, fields, node.name, frozenset(broken))

    def _field(self, line: ast.AnnAssign, name: str, fields: dict[str, StructField]) -> None:
        """Read a field of a struct."""
        self._identifier(name, line)
        if line.value is not None:
            hint = f"write {name}: {ast.unparse(line.annotation)}, and its value in reset_law"
            raise self._refuse(line, f"a struct has nothing but fields: {hint}")
        if name in fields:
            raise self._refuse(line, f"{name}: this name exists already: write another one")
        kind, marks = self._annotations.field_kind(line.annotation, line)
        above, comment = self.module.above(line.lineno), self.module.comment(line)
        for mark in marks:
            if isinstance(mark, Settable) and not comment:
                comment = f"[{mark.unit}] {mark.meaning}"
        fields[name] = StructField(name, kind, above, comment, line.lineno, marks)

    def _kernel(self, node: ast.FunctionDef) -> Signature:
        note = self.module.refusals.note
        with note():
            if [ast.unparse(decorator) for decorator in node.decorator_list] != ["kernel"]:
                hint = "write @kernel alone above it"
                raise self._refuse(node, f"function {node.name} is not marked @kernel alone: {hint}")
        listed = node.args
        with note():
            if listed.vararg or listed.kwarg or listed.kwonlyargs or listed.posonlyargs or listed.defaults:
                hint = "write each value at the call"
                raise self._refuse(node, f"{node.name}: only plain arguments without defaults: {hint}")
        arguments = {}
        for argument in (*listed.posonlyargs, *listed.args, *listed.kwonlyargs):
            arguments[argument.arg] = BROKEN
            with note():
                self._identifier(argument.arg, node)
                arguments[argument.arg] = self._annotations.argument_kind(argument, node)
        result = BROKEN
        with note():
            result = self._annotations.result(node)
        sieve = Sieve(node)
        for place, reason in sieve.found:
            with note():
                raise self._refuse(place, f"{reason} (in {node.name})")
        public = self.module.name == ENTRY
        c_name = f"{CORE}{node.name}" if public else f"{self.module.name}_{node.name}"
        path = self.module.path
        return Signature(c_name, path, node, arguments, result, public, self.module, lost=sieve.lost)

    def _identifier(self, name: str, node: ast.AST) -> str:
        if name in C_KEYWORDS:
            raise refusal(self.module.path, node, f"{name} is a word of C: write another name")
        if not name.isascii() or name.startswith("__"):
            raise refusal(
                self.module.path, node, f"{name}: expected a name of a-z, 0-9 and _ without __ in front"
            )
        return name


def _defined(node: ast.stmt) -> set[str]:
    """Return the names that a statement at the top of a module defines."""
    match node:
        case ast.ClassDef(name=name) | ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
            return {name}
        case ast.Import(names=names) | ast.ImportFrom(names=names):
            return {alias.asname or alias.name.partition(".")[0] for alias in names}
    return {
        part.id for part in ast.walk(node) if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)
    }


def _at_top(node: ast.stmt) -> str:
    """Return what users call a statement at the top of a module."""
    match node:
        case ast.AsyncFunctionDef(name=name):
            return f"async def {name}"
        case ast.Assign():
            return "several values in one assignment"
        case ast.AnnAssign():
            return "type of a constant"
        case ast.Expr():
            return "call" if isinstance(node.value, ast.Call) else "value"
    return hints.word(node)


def _instead(node: ast.stmt) -> str:
    """Return the replacement of a statement at the top of a module."""
    match node:
        case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
            return (
                hints.constant(name, value)
                if constant_literal(value) is None
                else f": write {name} = {ast.unparse(value)}"
            )
        case ast.AsyncFunctionDef(name=name):
            return f": write @kernel def {name}"
        case ast.Assign():
            return ": write one line for each constant"
        case ast.If() | ast.Expr():
            return ": leave it out"
    return ": write it inside a function marked @kernel"
