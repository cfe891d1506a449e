"""What is known of whole numbers where a line is reached: the least and the greatest value that an index may have.

Known are numbers, constants, loop variables, remainders, `min` and `max`. In the user's own logic also locals and fields,
from their assignments and from the conditions of `if`.
"""

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from firmware_py.export.literals import constant_literal
from firmware_py.export.syntax import I32, Constant, Module, Signature, ValueType

Interval = tuple[int, int]  # both included
FULL: Interval = (-(2**31), 2**31 - 1)
OPERATORS: Mapping[type[ast.operator], Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
}
OPPOSITE: Mapping[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
}  # fmt: skip
MIRRORED: Mapping[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE, ast.Eq: ast.Eq, ast.NotEq: ast.NotEq,
}  # fmt: skip
CHARGED_END = "charged_end"  # of `firmware_py/core/budget.py`: at most the end of the range


class Ranges:
    """The known values in a kernel; `names` has the types of what is in scope."""

    def __init__(self, module: Module, names: Mapping[str, ValueType], integer: ValueType) -> None:
        self.known: dict[str, Interval] = {}  # by local, or argument.field
        self._module = module
        self._names = names
        self._integer = integer

    def of(self, node: ast.expr) -> Interval | None:
        """Return the least and the greatest value of an expression, None where they are known in flight only."""
        found = self._of(node)
        inside = found is not None and FULL[0] <= found[0] and found[1] <= FULL[1] and found != FULL
        return found if inside else None

    def _of(self, node: ast.expr) -> Interval | None:
        match node:
            case ast.BinOp(op=ast.Mod()):
                divisor = self.of(node.right)
                return (0, divisor[1] - 1) if divisor and divisor[0] > 0 else None
            case ast.Name(id=name) if name not in self._names:
                constant = self._module.names.get(name)
                if not isinstance(constant, Constant) or constant.kind != self._integer:
                    return None
                return int(constant.text), int(constant.text)
            case ast.Name() | ast.Attribute():
                return self.known.get(ast.unparse(node))
            case ast.BinOp(op=ast.Add() | ast.Sub() | ast.Mult() as sign):
                left, right = self.of(node.left), self.of(node.right)
                if left is None or right is None:
                    return None
                ends = [OPERATORS[type(sign)](one, other) for one in left for other in right]
                return min(ends), max(ends)
            case ast.Call(func=ast.Name(id="min" | "max" as name), args=[one, other]) if self._module.own:
                choose = min if name == "min" else max
                first, second = self.of(one) or FULL, self.of(other) or FULL
                return choose(first[0], second[0]), choose(first[1], second[1])
            case ast.Call(func=ast.Name(id="i32"), args=[inner]) if self._module.own:
                return self.of(inner)
            case ast.Call(func=ast.Name(id=name), args=[_, _, end, *_]) if name == CHARGED_END:
                return self.of(end)
        literal = constant_literal(node)
        return (int(literal[1]), int(literal[1])) if literal and literal[0] == I32 else None

    def loop(self, limits: Sequence[ast.expr]) -> Interval | None:
        """Return the least and the greatest value of a loop variable, None where they are known in flight only."""
        start = self.of(limits[0]) if len(limits) > 1 else (0, 0)
        end = self.of(limits[-1] if len(limits) < 3 else limits[1])
        if not start or not end:
            return None
        falling = len(limits) == 3 and self.step(limits) < 0
        least, most = (end[0] + 1, start[1]) if falling else (start[0], end[1] - 1)
        beyond = abs(self.step(limits)) - 1  # the last value of the C's variable is outside the range
        inside = FULL[0] + beyond < least <= most < FULL[1] - beyond
        return (least, most) if inside else None

    def runs(self, limits: Sequence[ast.expr]) -> bool:
        """Return whether a loop over a range is sure to run once."""
        start = self.of(limits[0]) if len(limits) > 1 else (0, 0)
        end = self.of(limits[-1] if len(limits) < 3 else limits[1])
        if not start or not end:
            return False
        return start[0] > end[1] if len(limits) == 3 and self.step(limits) < 0 else start[1] < end[0]

    def step(self, limits: Sequence[ast.expr]) -> int:
        """Return the step of a range, 0 where it is not a constant."""
        step = self.of(limits[2]) if len(limits) == 3 else (1, 1)
        return step[0] if step and step[0] == step[1] else 0

    def assign(self, target: ast.expr, value: Interval | None) -> None:
        """Note what is known of a local or field behind its assignment."""
        if isinstance(target, ast.Attribute):  # two arguments may be the same memory
            for same in [one for one in self.known if one.endswith(f".{target.attr}")]:
                del self.known[same]
        key = self._key(target)
        if key and value:
            self.known[key] = value
        elif key:
            self.known.pop(key, None)

    def narrow(self, test: ast.expr, holds: bool) -> None:
        """Note what follows from a condition that holds, or does not."""
        match test:
            case ast.UnaryOp(op=ast.Not(), operand=inner):
                self.narrow(inner, not holds)
            case ast.BoolOp(op=op, values=parts) if isinstance(op, ast.And) == holds:
                for part in parts:
                    self.narrow(part, holds)
            case ast.Compare(left=left, ops=[sign], comparators=[right]) if type(sign) in OPPOSITE:
                kind = type(sign) if holds else OPPOSITE[type(sign)]
                self._bound(left, kind, self.of(right))
                self._bound(right, MIRRORED[kind], self.of(left))

    def _bound(self, node: ast.expr, sign: type[ast.cmpop], other: Interval | None) -> None:
        key = self._key(node)
        if key is None or other is None:
            return
        low, high = self.known.get(key, FULL)
        if sign in (ast.Lt, ast.LtE, ast.Eq):
            high = min(high, other[1] - (sign is ast.Lt))
        if sign in (ast.Gt, ast.GtE, ast.Eq):
            low = max(low, other[0] + (sign is ast.Gt))
        self.known[key] = low, high

    def forget(self, node: ast.AST) -> None:
        """Forget what a statement or loop may change: names that it assigns, and fields where it writes or calls."""
        for part in ast.walk(node):
            match part:
                case ast.Name(id=name, ctx=ast.Store()):
                    self.known.pop(name, None)
                case ast.Attribute(ctx=ast.Store()):
                    self.assign(part, None)
                case ast.Call(func=ast.Name(id=name)) if isinstance(self._module.names.get(name), Signature):
                    self.known = {key: value for key, value in self.known.items() if "." not in key}

    def join(self, other: Mapping[str, Interval]) -> None:
        """Keep what holds on this path and on another one."""
        self.known = {
            key: (min(low, other[key][0]), max(high, other[key][1]))
            for key, (low, high) in self.known.items()
            if key in other
        }

    def _key(self, node: ast.expr) -> str | None:
        """Return the name under which the bounds of a whole number are kept."""
        kind: Any = None
        match node:
            case ast.Name(id=name):
                kind = self._names.get(name)
            case ast.Attribute(value=ast.Name(id=name), attr=field):
                struct = getattr(self._names.get(name), "struct", None)
                kind = struct.fields[field].kind if struct and field in struct.fields else None
        return ast.unparse(node) if self._module.own and kind == self._integer else None
