"""Takes out of a user's function what the subset lacks, so that all refusals of a file come at once."""

import ast
from collections.abc import Sequence
from typing import cast

from firmware_py.export import hints


def uses(tree: ast.Module | ast.FunctionDef, node: ast.Import | ast.ImportFrom) -> list[tuple[ast.AST, str]]:
    """Return where a module or function uses what it imports from outside, and what to write there."""
    names = {
        alias.asname or alias.name.partition(".")[0]: "" if isinstance(node, ast.Import) else alias.name
        for alias in node.names
    }
    found: list[tuple[ast.AST, str]] = []
    for part in ast.walk(tree):
        match part:
            case ast.Attribute(value=ast.Name(id=module), attr=name) if module in names:
                pass
            case ast.Name(id=used) if names.get(used):
                name = names[used]
            case _:
                continue
        home = f"{name}, from {hints.HOMES[name]}" if name in hints.HOMES else "it without this module"
        hint = hints.instead(hints.FUNCTIONS, name) or f": write {home}"
        found.append((part, f"{ast.unparse(part)} is outside the subset{hint}"))
    return found or [(node, f"{ast.unparse(node)} is outside the subset, and not used: leave it out")]


class Sieve(ast.NodeTransformer):
    """Takes out of a function what the subset lacks, so that the rest can be checked, too.

    Afterwards `found` has each such place with the reason, and `lost` the names that are defined there.
    """

    def __init__(self, function: ast.FunctionDef) -> None:
        self.found: list[tuple[ast.AST, str]] = []
        self.lost: set[str] = set()
        self._function = function
        whole = ast.FunctionDef(function.name, function.args, list(function.body), [], function.returns)
        function.body = [one for line in whole.body for one in self._lines(line)]
        self.found.sort(key=lambda one: (getattr(one[0], "lineno", 0), getattr(one[0], "col_offset", 0)))

    def _lines(self, node: ast.stmt) -> list[ast.stmt]:
        made = self.visit(node)
        return made if isinstance(made, list) else [cast(ast.stmt, made)]

    def visit(self, node: ast.AST) -> ast.AST | list[ast.stmt]:
        """Return a node of the subset; a hole, or the lines inside, in place of another one."""
        if not isinstance(node, ast.stmt | ast.expr) or isinstance(node, hints.KNOWN):
            targets = [node.target] if isinstance(node, ast.For) else getattr(node, "targets", [])
            if len(targets) > 1 or any(isinstance(target, ast.Tuple) for target in targets):
                self._lose(targets)
            made: ast.AST = self.generic_visit(node)
            return made
        name = type(node).__name__
        if isinstance(node, ast.Import) or (isinstance(node, ast.ImportFrom) and not _of_core(node)):
            self.found += uses(self._function, node)
        else:
            self.found.append(
                (node, f"{hints.word(node)}{hints.instead(hints.CONSTRUCTS, name) or ': leave it out'}")
            )
        self._lose([node])
        hole = ast.copy_location(ast.Name(hints.HOLE, ast.Load()), node)
        if isinstance(node, ast.expr):
            return hole
        inner = node.body if isinstance(node, ast.While | ast.With | ast.Try) else []
        return [
            ast.copy_location(ast.Expr(hole), node),
            *(one for line in inner for one in self._lines(line)),
        ]

    def _lose(self, nodes: Sequence[ast.AST]) -> None:
        """Note the names that are defined in what the printer cannot print."""
        for part in (part for node in nodes for part in ast.walk(node)):
            match part:
                case ast.Name(id=lost, ctx=ast.Store()):
                    self.lost.add(lost)
                case ast.FunctionDef(name=lost) | ast.ClassDef(name=lost):
                    self.lost.add(lost)
                case ast.alias():
                    self.lost.add(part.asname or part.name.partition(".")[0])


def _of_core(node: ast.ImportFrom) -> bool:
    return bool(node.module and node.module.startswith("firmware_py.core"))
