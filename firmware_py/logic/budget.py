"""The budget of a call of the user's own logic, in cycles of the board's Cortex-M4, and how loops are held to it.

Cycles are counted in the text along its longest path, too few rather than too many: 1 for an operation or an element of an
array, 14 for a division or root of floats, 4 for a step of a loop and for a call. A loop of known length that exceeds the
budget is refused. Before a loop whose length depends on data, a call of `firmware_py/core/budget.py` is inserted into the
text: the same on every target, in the same line.
"""

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from firmware_py.core.budget import CALL_CYCLES
from firmware_py.export.errors import refusal
from firmware_py.export.expressions import Expressions
from firmware_py.export.locals import find_locals
from firmware_py.export.syntax import I32, PACKAGE, SUBSET, Module, Signature, parsed

CLOCK_MHZ = 168
SLOW, STEP, CALL = 14, 4, 4  # cycles
CHARGE = 24  # cycles of the call before a loop
ARGUMENT = "loop_budget"
STRUCT = "LoopBudget"
ALLOWED = f"a call has {CALL_CYCLES} ({CALL_CYCLES // CLOCK_MHZ // 1000} ms of a Cortex-M4): write a part for each tick"
Edit = tuple[tuple[int, int], tuple[int, int], str]  # begin, end, text there; (line, byte of the line)


@dataclass(slots=True)
class Counted:
    """The cycles of a kernel, without those that are charged while it runs, and the edits of its text."""

    kernel: Signature
    cycles: int = 0
    charged: bool = False  # it has loops whose length depends on data, or calls a kernel that has some
    edits: list[Edit] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Budgeted:
    """A user's module as it flies, and the cycles of its charged kernels by their names."""

    text: str
    charged: Mapping[str, int]


def budgeted(text: str, modules: Sequence[Module]) -> Budgeted:
    """Return the last of the modules, whose text this is, with charged loops.

    Its `refusals` have the kernels that exceed the budget in any case.
    """
    counted: dict[str, Counted] = {}
    kernels = [thing for module in modules for thing in module.defined if isinstance(thing, Signature)]
    for kernel in kernels:
        counted[kernel.c_name] = _Counter(kernel, counted).count()
    own = [one for one in counted.values() if one.kernel.scope is modules[-1]]
    charged = {one.kernel.node.name: one.cycles for one in own if one.charged}
    edits = [edit for one in own for edit in one.edits]
    if edits:
        edits.append(_import(text))
    return Budgeted(_edited(text, edits), charged)


class _Counter:
    """Counts one kernel; those that it calls have been counted."""

    def __init__(self, kernel: Signature, counted: Mapping[str, Counted]) -> None:
        self._found = Counted(kernel)
        self._others = counted
        self._own = kernel.scope.own
        self._print = Expressions(kernel)
        self._print.names |= dict.fromkeys(find_locals(kernel)[0], I32)

    def count(self) -> Counted:
        """Return the cycles and edits."""
        found, node = self._found, self._found.kernel.node
        found.cycles = self._checked(self._block(node.body), node, node.name)
        if found.charged:
            begin = (node.lineno, node.col_offset)
            found.edits.append((begin, begin, f"{ARGUMENT}: {STRUCT}{', ' if node.args.args else ''}"))
        return found

    def _checked(self, cycles: int, node: ast.AST, what: str) -> int:
        """Return cycles that a call has; 0 after the refusal of others."""
        if self._own and cycles > CALL_CYCLES:
            with self._found.kernel.scope.refusals.note():
                reason = f"{what} takes at least {cycles} cycles: {ALLOWED}"
                raise refusal(self._found.kernel.path, node, reason)
            return 0
        return cycles

    def _block(self, body: list[ast.stmt]) -> int:
        return sum(map(self._statement, body))

    def _statement(self, node: ast.stmt) -> int:
        match node:
            case ast.If():
                return self._cost(node.test) + 1 + max(self._block(node.body), self._block(node.orelse))
            case ast.For(target=ast.Name(id=name), iter=ast.Call(args=limits)):
                return self._loop(node, name, limits)
            case ast.Expr(value=ast.Call() as call) | ast.Return(value=ast.Call() as call):
                return self._cost(call, alone=True)
            case ast.Assign(value=ast.Call() as call):
                return self._cost(call, alone=True) + sum(map(self._cost, node.targets))
        return self._cost(node)

    def _loop(self, node: ast.For, name: str, limits: list[ast.expr]) -> int:
        ranges = self._print.ranges
        reach = ranges.loop(limits)
        if reach:
            ranges.known[name] = reach
        self._print.names[name] = I32
        step = self._block(node.body) + STEP
        ranges.known.pop(name, None)
        del self._print.names[name]
        header = sum(map(self._cost, limits))
        if reach:
            cycles = ((reach[1] - reach[0]) // abs(ranges.step(limits)) + 1) * step  # `break` may save some
            return header + self._checked(cycles, node, f"for {name} in {ast.unparse(node.iter)}")
        if not self._own:
            return header + step  # its length is bounded by the core's own limits
        self._found.charged = True
        begin, end = ast.unparse(limits[0]) if len(limits) == 2 else "0", ast.unparse(limits[-1])
        charged = f"range({begin}, charged_end({ARGUMENT}, {begin}, {end}, {step}, {node.lineno}))"
        self._found.edits.append((_begin(node.iter), _end(node.iter), charged))
        return header + CHARGE

    def _cost(self, node: ast.AST, alone: bool = False) -> int:
        """Return the cycles of a statement or expression without blocks; `alone`: a call that is all of it."""
        cycles = 0
        for part in ast.walk(node):
            match part:
                case ast.BinOp(op=ast.Div()) | ast.AugAssign(op=ast.Div()):
                    cycles += SLOW
                case ast.Call(func=ast.Name(id=name)):
                    cycles += self._call(part, name, alone and part is node)
                case (
                    ast.BinOp()
                    | ast.AugAssign()
                    | ast.Compare()
                    | ast.BoolOp()
                    | ast.UnaryOp()
                    | ast.Subscript()
                ):
                    cycles += 1
        return cycles

    def _call(self, node: ast.Call, name: str, alone: bool) -> int:
        kernel = self._found.kernel.scope.names.get(name)
        if not isinstance(kernel, Signature):
            return SLOW if name == "sqrt" else 1
        callee = self._others[kernel.c_name]
        if callee.charged:
            if not alone:
                reason = f"{name} has a loop whose length depends on data: write x = {name}(..) on a line of its own"
                with self._found.kernel.scope.refusals.note():
                    raise refusal(self._found.kernel.path, node, reason)
            self._found.charged = True
            begin = _end(node.func)
            self._found.edits.append((begin, begin, f"{ARGUMENT}{', ' if node.args else ''}"))
        return CALL + callee.cycles


def _begin(node: ast.expr) -> tuple[int, int]:
    return node.lineno, node.col_offset


def _end(node: ast.expr | ast.stmt) -> tuple[int, int]:
    return node.end_lineno or node.lineno, node.end_col_offset or 0


def _import(text: str) -> Edit:
    """Return the import that the edits need, behind that of the subset."""
    found = [node for node in parsed(text).body if isinstance(node, ast.ImportFrom) and node.module == SUBSET]
    return _end(found[0]), _end(found[0]), f"; from {PACKAGE}.budget import {STRUCT}, charged_end"


def _edited(text: str, edits: Sequence[Edit]) -> str:
    """Return a text with changes in places that do not overlap; every line keeps its number."""
    data = text.encode()
    starts = [0]
    for line in data.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    places = [
        (starts[begin[0] - 1] + begin[1], starts[end[0] - 1] + end[1], new) for begin, end, new in edits
    ]
    for begin, end, new in sorted(places, reverse=True):
        if begin == end and not new.startswith(";"):  # an argument, behind the parenthesis
            begin = end = data.index(b"(", begin) + 1
        lost = data[begin:end].count(b"\n")
        inside = new[:-1] + "\n" * lost + new[-1:]
        data = data[:begin] + inside.encode() + data[end:]
    return data.decode()
