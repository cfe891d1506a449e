"""Analyses a kernel's statements before they are printed: the block of each local, and the names it writes through.

A local of Python belongs to the function, one of C to a block. A local is declared at its first assignment when that
assignment is in the innermost block that holds all uses, otherwise at the head of the function. A read that some path
reaches without a value is refused.
"""

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from firmware_py.export.errors import refusal
from firmware_py.export.literals import constant_literal
from firmware_py.export.ranges import Ranges
from firmware_py.export.syntax import C_KEYWORDS, I32, Constant, Signature

Block = tuple[int, ...]


@dataclass(slots=True)
class Local:
    """A local of a kernel: where it is first assigned and how often; `home` is the block of all its uses."""

    first: ast.AST
    block: Block
    home: Block
    assignments: int


def find_locals(kernel: Signature, anywhere: bool = False) -> tuple[dict[str, Local], set[str]]:
    """Return the locals by name, and the names of the loop variables.

    A local whose `home` is not the block of its first assignment is declared at the head of the function. `anywhere`: reads
    are not compared with the paths that reach them.
    """
    found: dict[str, Local] = {}
    targets = [node.target for node in ast.walk(kernel.node) if isinstance(node, ast.For)]
    loops = {target.id for target in targets if isinstance(target, ast.Name)}
    own = set(kernel.arguments) | loops
    stored = {node.id: node for node in _stores(kernel.node) if node.id not in kernel.lost}
    note = kernel.scope.refusals.note
    for name, store in stored.items():
        if name in C_KEYWORDS or name.removesuffix("_end") in loops - {name}:
            with note():
                reason = f"{name} is a word of C or the end of a loop: write another name"
                raise refusal(kernel.path, store, reason)
    for name, block, node in _uses(kernel.node.body, ()):
        if name not in stored or name in own:
            if name in own and isinstance(node.ctx, ast.Store):
                with note():
                    reason = (
                        f"{name} is an argument or a loop variable and is assigned: write to another name"
                    )
                    raise refusal(kernel.path, node, reason)
            continue
        if anywhere and name not in found and not isinstance(node.ctx, ast.Store):
            raise refusal(kernel.path, node, f"{name} is read before it has a value")
        local = found.setdefault(name, Local(node, block, block, 0))
        local.assignments += isinstance(node.ctx, ast.Store)
        local.home = _common(local.home, block)
    if not anywhere:
        early = _Paths(kernel, set(found)).early
        for node in early.values():
            with note():
                raise refusal(kernel.path, node, _without_value(kernel, node, stored))
        kernel.lost |= set(early)
    return found, loops


def _without_value(kernel: Signature, read: ast.Name, stored: Mapping[str, ast.Name]) -> str:
    """Return the refusal of a local that some path reads without a value."""
    uses = [name for name in ast.walk(kernel.node) if isinstance(name, ast.Name) and name.id == read.id]
    first = min(use.lineno for use in uses)
    line = max(node.lineno for node in kernel.node.body if node.lineno <= first)
    assigned = [
        node.value
        for node in ast.walk(kernel.node)
        if isinstance(node, ast.Assign) and stored[read.id] in node.targets
    ]
    whole = (
        bool(assigned) and constant_literal(assigned[0]) is not None and "f32" not in ast.unparse(assigned[0])
    )
    zero = "i32(0)" if whole else "f32(0.0)"
    return f"{read.id} is read before it has a value: write {read.id} = {zero} before line {line}"


class _Paths:
    """Follows the paths through a kernel; `early` has the first read of each local that a path reaches without a value."""

    def __init__(self, kernel: Signature, locals_: set[str]) -> None:
        self.early: dict[str, ast.Name] = {}
        self._kernel = kernel
        self._all = locals_
        self._broken_off: list[set[str]] = []  # what has a value where the innermost loop is left
        self._block(kernel.node.body, set())

    def _block(self, body: list[ast.stmt], have: set[str]) -> set[str]:
        """Return the locals that have a value behind a block; all, where nothing goes on."""
        for node in body:
            have = self._statement(node, have)
        return have

    def _statement(self, node: ast.stmt, have: set[str]) -> set[str]:
        match node:
            case ast.If():
                self._read(node.test, have)
                return self._block(node.body, have) & self._block(node.orelse, have)
            case ast.For():
                return self._loop(node, have)
            case ast.Break():
                self._broken_off.append(have)
                return self._all
            case ast.Return() | ast.Continue():
                self._read(node, have)
                return self._all
            case ast.Assign():
                self._read(node.value, have)
        self._read(node, have)
        return have | {name.id for name in _stores(node)}

    def _loop(self, node: ast.For, have: set[str]) -> set[str]:
        self._read(node.iter, have)
        outer, self._broken_off = self._broken_off, []
        behind = self._block(node.body, have)
        if not self._runs(node) or _continues(node.body):
            behind = have
        behind = behind.intersection(*self._broken_off)
        self._broken_off = outer
        return behind

    def _runs(self, node: ast.For) -> bool:
        """Return whether a loop is sure to run once."""
        limits = node.iter.args if isinstance(node.iter, ast.Call) else []
        names = dict.fromkeys((*self._all, *self._kernel.arguments), I32)
        return bool(limits) and Ranges(self._kernel.scope, names, I32).runs(limits)

    def _read(self, node: ast.AST, have: set[str]) -> None:
        augmented = node.target if isinstance(node, ast.AugAssign) else None
        for name in ast.walk(node):
            if not isinstance(name, ast.Name) or name.id not in self._all or name.id in have:
                continue
            if isinstance(name.ctx, ast.Load) or name is augmented:
                self.early.setdefault(name.id, name)


def leaves(body: list[ast.stmt]) -> bool:
    """Return whether nothing goes on behind a block."""
    last = body[-1] if body else None
    if isinstance(last, ast.If):
        return leaves(last.body) and leaves(last.orelse)
    return isinstance(last, ast.Return | ast.Break | ast.Continue)


def _continues(body: list[ast.stmt]) -> bool:
    """Return whether a loop's body may end early with `continue`."""
    return any(isinstance(part, ast.Continue) for line in body for part in ast.walk(line))


def find_writes(kernel: Signature) -> None:
    """Find the kernels that a kernel calls, and the names through which it writes; those called come first."""
    aliases: dict[str, str] = {}
    for node in ast.walk(kernel.node):
        match node:
            case ast.Assign(targets=[ast.Name(id=name), *_], value=ast.Attribute() | ast.Name() as source):
                aliases[name] = _root(source)
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=sources)):
                pairs = zip(targets, sources, strict=False)
                aliases |= {one.id: _root(source) for one, source in pairs if isinstance(one, ast.Name)}
    roots: dict[str, ast.AST] = {}
    for node in ast.walk(kernel.node):
        if isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store):
            roots[_root(node)] = node
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            callee = kernel.scope.names.get(node.func.id)
            if isinstance(callee, Signature):
                with kernel.scope.refusals.note():
                    _check_above(kernel, callee, node)
                kernel.calls |= {callee.c_name} | callee.calls
                given = zip(node.args, callee.arguments, strict=False)
                roots |= {_root(argument): node for argument, name in given if name in callee.writes}
    roots |= {aliases[root]: node for root, node in roots.items() if root in aliases}
    for root, node in roots.items():
        if isinstance(kernel.scope.names.get(root), Constant) and root not in kernel.arguments:
            with kernel.scope.refusals.note():
                reason = f"{root} is a constant and is written: write to a field of the memory struct"
                raise refusal(kernel.path, node, reason)
    kernel.writes = set(roots)


def _check_above(kernel: Signature, callee: Signature, node: ast.Call) -> None:
    if callee is kernel:
        raise refusal(
            kernel.path, node, f"{kernel.node.name} calls itself: recursion: write a loop over range(..)"
        )
    if callee.path == kernel.path and callee.node.lineno > kernel.node.lineno:
        reason = f"{callee.node.name} is defined below its caller: write it above {kernel.node.name}"
        raise refusal(kernel.path, node, reason)


def _root(node: ast.expr) -> str:
    """Return the name at the bottom of a chain of fields and indices; empty for anything else."""
    while isinstance(node, ast.Attribute | ast.Subscript):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def _stores(function: ast.stmt) -> Iterator[ast.Name]:
    for node in ast.walk(function):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node


def _common(one: Block, other: Block) -> Block:
    length = 0
    while length < min(len(one), len(other)) and one[length] == other[length]:
        length += 1
    return one[:length]


def _uses(body: list[ast.stmt], block: Block) -> Iterator[tuple[str, Block, ast.Name]]:
    """Yield name, block and node of every use of a name in the order of evaluation."""
    for node in body:
        match node:
            case ast.If():
                yield from _names(node.test, block)
                yield from _uses(node.body, (*block, id(node), 0))
                yield from _uses(node.orelse, (*block, id(node), 1))
            case ast.For():
                yield from _names(node.iter, block)
                yield from _uses(node.body, (*block, id(node), 0))
            case ast.While():
                yield from _names(node.test, block)
                yield from _uses(node.body, (*block, id(node), 0))
            case ast.Assign():
                yield from _names(node.value, block)
                for target in node.targets:
                    yield from _names(target, block)
            case _:
                yield from _names(node, block)


def _names(node: ast.AST, block: Block) -> Iterator[tuple[str, Block, ast.Name]]:
    for name in ast.walk(node):
        if isinstance(name, ast.Name):
            yield name.id, block, name
