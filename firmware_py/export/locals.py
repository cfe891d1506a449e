"""Analyses a kernel's statements before they are printed: the block of each local, and the names it writes through.

A local of Python belongs to the function, one of C to a block. A local may be declared at its first assignment when that
assignment is in the innermost block that holds all uses; everything else is refused.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass

from firmware_py.export.errors import refusal
from firmware_py.export.syntax import C_KEYWORDS, Constant, Signature

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

    `anywhere`: a local may get its first value inside a block and be used outside.
    """
    found: dict[str, Local] = {}
    targets = [node.target for node in ast.walk(kernel.node) if isinstance(node, ast.For)]
    loops = {target.id for target in targets if isinstance(target, ast.Name)}
    own = set(kernel.arguments) | loops
    stored = {node.id: node for node in _stores(kernel.node)}
    for name, store in stored.items():
        if name in C_KEYWORDS or name.removesuffix("_end") in loops - {name}:
            raise refusal(kernel.path, store, f"{name} is a word of C or the end of a loop")
    for name, block, node in _uses(kernel.node.body, ()):
        if name not in stored or name in own:
            if name in own and isinstance(node.ctx, ast.Store):
                raise refusal(kernel.path, node, f"{name} is an argument or a loop variable and is assigned")
            continue
        assigned = isinstance(node.ctx, ast.Store)
        if name not in found:
            if not assigned:
                raise refusal(kernel.path, node, f"{name} is read before it has a value")
            found[name] = Local(node, block, block, 0)
        local = found[name]
        local.assignments += assigned
        local.home = _common(local.home, block)
    for name, local in found.items():
        if local.home != local.block and not anywhere:
            raise refusal(
                kernel.path, local.first, f"{name} gets its first value inside a block: give it one before"
            )
    return found, loops


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
                _check_above(kernel, callee, node)
                kernel.calls |= {callee.c_name} | callee.calls
                given = zip(node.args, callee.arguments, strict=False)
                roots |= {_root(argument): node for argument, name in given if name in callee.writes}
    roots |= {aliases[root]: node for root, node in roots.items() if root in aliases}
    for root, node in roots.items():
        if isinstance(kernel.scope.names.get(root), Constant) and root not in kernel.arguments:
            raise refusal(kernel.path, node, f"{root} is a constant and is written")
    kernel.writes = set(roots)


def _check_above(kernel: Signature, callee: Signature, node: ast.Call) -> None:
    if callee is kernel:
        raise refusal(kernel.path, node, f"{kernel.node.name} calls itself: recursion")
    if callee.path == kernel.path and callee.node.lineno > kernel.node.lineno:
        raise refusal(kernel.path, node, f"{callee.node.name} is defined below its caller (no recursion)")


def _root(node: ast.expr) -> str:
    """Return the name at the bottom of a chain of fields and indices; empty for anything else."""
    while isinstance(node, ast.Attribute | ast.Subscript):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def _stores(function: ast.FunctionDef) -> Iterator[ast.Name]:
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
