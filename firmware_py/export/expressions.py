"""Types and prints the expressions of a kernel; whatever is not in the subset is refused.

An expression keeps its order of evaluation: C's precedences of the operators used are Python's, and parentheses go where
the tree needs them. A call that writes through an argument is alone in its statement, because C leaves the order of
calls inside an expression open.
"""

import ast
import operator
from dataclasses import dataclass
from typing import ClassVar

from firmware_py.export.errors import ExportError, refusal
from firmware_py.export.hints import CONSTRUCTS, FUNCTIONS, instead
from firmware_py.export.literals import constant_literal
from firmware_py.export.syntax import BOOL, F32, I32, Constant, Module, Signature, ValueType

PRIMARY, UNARY, PRODUCT, SUM, COMPARISON, AND, OR = 9, 8, 7, 6, 5, 3, 2

FLOAT_OPERATORS = {
    ast.Add: ("+", SUM),
    ast.Sub: ("-", SUM),
    ast.Mult: ("*", PRODUCT),
    ast.Div: ("/", PRODUCT),
}
INTEGER_OPERATORS = {
    ast.Add: ("+", SUM),
    ast.Sub: ("-", SUM),
    ast.Mult: ("*", PRODUCT),
    ast.FloorDiv: ("/", PRODUCT),  # the same for non-negative numbers
    ast.Mod: ("%", PRODUCT),
}
COMPARISONS = {ast.Eq: "==", ast.NotEq: "!=", ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}
CASTS = {"f32": F32, "i32": I32, "bool": BOOL}
FLOAT_FUNCTIONS = {"abs": "__builtin_fabsf", "sqrt": "__builtin_sqrtf"}


@dataclass(frozen=True, slots=True)
class Value:
    """A printed expression with its type; `strength`: how tightly its outermost operator binds."""

    text: str
    kind: ValueType
    strength: int = PRIMARY

    def within(self, strength: int) -> str:
        """Return the text for a place that needs at least this strength."""
        return self.text if self.strength >= strength else f"({self.text})"


class Expressions:
    """Prints the expressions of one kernel; `names` holds the types of what is in scope."""

    INTEGER = I32
    NUMBERS: ClassVar[tuple[ValueType, ...]] = (F32, I32)

    def __init__(self, kernel: Signature) -> None:
        self.kernel = kernel
        self.module: Module = kernel.scope
        self.names: dict[str, ValueType] = dict(kernel.arguments)
        self.constants: list[Constant] = []  # those that the kernel uses
        self.read: set[str] = set()
        self.loops: dict[str, tuple[int, int]] = {}  # the values of loop variables, where they are known
        self.rounds_down = self.module.own  # `//` and `%` of negative numbers are Python's

    def refuse(self, node: ast.AST, reason: str) -> ExportError:
        """Return the error for a construct of this kernel."""
        return refusal(self.kernel.path, node, f"{reason} (in {self.kernel.node.name})")

    def scalar(self, node: ast.expr, kind: ValueType, what: str, alone: bool = False) -> Value:
        """Return an expression that has to be of this type."""
        value = self.value(node, alone)
        if value.kind != kind:
            hint = instead(CONSTRUCTS, f"{describe(value.kind)} for {describe(kind)}")
            raise self.refuse(node, f"{what} is {describe(value.kind)}, not {describe(kind)}{hint}")
        return value

    def value(self, node: ast.expr, alone: bool = False) -> Value:
        """Return a printed expression; `alone`: it is its whole statement, so that calls may write."""
        match node:
            case ast.Constant():
                return self._literal(node)
            case ast.Name():
                return self._name(node)
            case ast.Attribute():
                return self._field(node)
            case ast.Subscript():
                return self._element(node)
            case ast.BinOp():
                return self._binary(node)
            case ast.UnaryOp():
                return self._unary(node)
            case ast.Compare():
                return self._comparison(node)
            case ast.BoolOp():
                return self._boolean(node)
            case ast.Call():
                return self._call(node, alone)
        name = type(node).__name__
        raise self.refuse(node, f"{name} expression{instead(CONSTRUCTS, name)}")

    def _literal(self, node: ast.Constant) -> Value:
        if isinstance(node.value, bool):
            return Value("true" if node.value else "false", BOOL)
        if isinstance(node.value, float):
            raise self.refuse(node, f"float literal {node.value} without f32(..): a double in Python and C")
        literal = constant_literal(node)
        if literal is None:
            raise self.refuse(node, f"literal {node.value!r}")
        return Value(literal[1], self.INTEGER)

    def _name(self, node: ast.Name) -> Value:
        if node.id in self.names:
            self.read.add(node.id)
            return Value(node.id, self.names[node.id])
        thing = self.module.names.get(node.id)
        if not isinstance(thing, Constant):
            raise self.refuse(node, f"{node.id} is no value here")
        self.constants.append(thing)
        return Value(thing.c_name, thing.kind)

    def _field(self, node: ast.Attribute) -> Value:
        if not isinstance(node.value, ast.Name) or node.value.id not in self.names:
            raise self.refuse(node, f"{ast.unparse(node)} is no field of a struct")
        struct = self.names[node.value.id].struct
        if struct is None or node.attr not in struct.fields:
            raise self.refuse(node, f"{ast.unparse(node)} is no field of a struct")
        self.read.add(node.value.id)
        return Value(f"{node.value.id}->{node.attr}", struct.fields[node.attr].kind)

    def _element(self, node: ast.Subscript) -> Value:
        array = self.value(node.value)
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if any(isinstance(index, ast.Slice) for index in indices):
            raise self.refuse(node, f"slice{instead(CONSTRUCTS, 'Slice')}")
        rank = array.kind.rank
        if rank == 0 or len(indices) != rank:
            raise self.refuse(node, f"{ast.unparse(node)}: {len(indices)} indices on {describe(array.kind)}")
        text = array.text
        for axis, index in enumerate(indices):
            text += f"[{self.scalar(index, self.INTEGER, 'an index').text}]"
            reached = self._reach(index)
            size = array.kind.shape[axis] if array.kind.shape else 2**31
            if reached is None and self.module.own:
                name = ast.unparse(index)
                raise self.refuse(
                    index, f"index {name}: it may be outside 0..{size - 1} in flight: write {name} % {size}"
                )
            least, most = reached or (0, 0)
            if not 0 <= least <= most < size:
                reach = f"{least}..{most}" if least < most else str(least)
                which = "" if ast.unparse(index) == reach else f", which is {reach}"
                text_of_range = (
                    f"index {ast.unparse(index)}{which}: {describe(array.kind)} of {size} has 0..{size - 1}"
                )
                raise self.refuse(index, text_of_range)
        return Value(text, ValueType(array.kind.base))

    def _reach(self, node: ast.expr) -> tuple[int, int] | None:
        """Return the least and the greatest value of an integer, or None where they are known in flight only.

        Known are numbers, constants, loop variables, and remainders of a division by them.
        """
        match node:
            case ast.BinOp(op=ast.Mod()):
                divisor = self._reach(node.right)
                return (0, divisor[1] - 1) if divisor and divisor[0] > 0 else None
            case ast.Name(id=name) if name in self.loops:
                return self.loops[name]
            case ast.Name(id=name) if name not in self.names:
                known = self.module.names.get(name)
                value = (
                    int(known.text) if isinstance(known, Constant) and known.kind == self.INTEGER else None
                )
                return None if value is None else (value, value)
            case ast.BinOp(op=ast.Add() | ast.Sub() | ast.Mult()):
                left, right = self._reach(node.left), self._reach(node.right)
                if left is None or right is None:
                    return None
                operators = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul}
                operate = operators[type(node.op)]
                ends = [operate(one, other) for one in left for other in right]
                return min(ends), max(ends)
        literal = constant_literal(node)
        return (int(literal[1]), int(literal[1])) if literal and literal[0] == I32 else None

    def loop(self, start: ast.expr | None, end: ast.expr) -> tuple[int, int] | None:
        """Return the least and the greatest value of a loop variable, None where they are known in flight only."""
        first, last = self._reach(start) if start else (0, 0), self._reach(end)
        return (first[0], last[1] - 1) if first and last and first[0] < last[1] else None

    def _binary(self, node: ast.BinOp) -> Value:
        left, right = self._alike(self.value(node.left), self.value(node.right))
        name = type(node.op).__name__
        if left.kind != right.kind or left.kind not in self.NUMBERS:
            hint = instead(CONSTRUCTS, name) or mixed(left.kind, right.kind)
            raise self.refuse(node, f"{name} of {describe(left.kind)} and {describe(right.kind)}{hint}")
        operators = INTEGER_OPERATORS if left.kind == self.INTEGER else FLOAT_OPERATORS
        if type(node.op) not in operators:
            raise self.refuse(node, f"{name} of {describe(left.kind)}{instead(CONSTRUCTS, name)}")
        if self.rounds_down and isinstance(node.op, ast.FloorDiv | ast.Mod):
            return self._rounded_down(node, left, right)
        sign, strength = operators[type(node.op)]
        return Value(f"{left.within(strength)} {sign} {right.within(strength + 1)}", left.kind, strength)

    def _alike(self, left: Value, right: Value) -> tuple[Value, Value]:
        """Return the operands of one operator; nothing is converted silently."""
        return left, right

    def _rounded_down(self, node: ast.BinOp, left: Value, right: Value) -> Value:
        """Return `//` or `%` of any integer as Python computes it: C rounds towards zero."""
        divisor = self._reach(node.right)
        if divisor is None or divisor[0] <= 0:
            reason = f"{ast.unparse(node)}: the divisor must be a constant above 0"
            raise self.refuse(node, reason)
        over, by = left.within(PRODUCT), right.within(UNARY)
        if isinstance(node.op, ast.Mod):
            return Value(f"({over} % {by} + {by}) % {by}", self.INTEGER, PRODUCT)
        return Value(f"{over} / {by} - ({over} % {by} < 0)", self.INTEGER, SUM)

    def _unary(self, node: ast.UnaryOp) -> Value:
        operand = self.value(node.operand)
        if isinstance(node.op, ast.Not) and operand.kind == BOOL:
            return Value(f"!{operand.within(PRIMARY)}", BOOL, UNARY)
        if isinstance(node.op, ast.USub) and operand.kind in self.NUMBERS:
            return Value(f"-{operand.within(PRIMARY)}", operand.kind, UNARY)
        raise self.refuse(node, f"{type(node.op).__name__} of {describe(operand.kind)}")

    def _comparison(self, node: ast.Compare) -> Value:
        if len(node.ops) != 1 or type(node.ops[0]) not in COMPARISONS:
            hint = instead(CONSTRUCTS, type(node if len(node.ops) > 1 else node.ops[0]).__name__)
            raise self.refuse(node, f"comparison {ast.unparse(node)}{hint}")
        left, right = self._alike(self.value(node.left), self.value(node.comparators[0]))
        if left.kind != right.kind or left.kind not in self.NUMBERS:
            raise self.refuse(
                node,
                f"comparison of {describe(left.kind)} and {describe(right.kind)}{mixed(left.kind, right.kind)}",
            )
        sign = COMPARISONS[type(node.ops[0])]
        return Value(f"{left.within(COMPARISON + 1)} {sign} {right.within(COMPARISON + 1)}", BOOL, COMPARISON)

    def _boolean(self, node: ast.BoolOp) -> Value:
        strength, sign = (AND, " && ") if isinstance(node.op, ast.And) else (OR, " || ")
        operands = [self.scalar(operand, BOOL, "an operand of and/or") for operand in node.values]
        least = COMPARISON  # `and` inside `or` gets parentheses too: compilers ask for them
        return Value(sign.join(operand.within(least) for operand in operands), BOOL, strength)

    def _call(self, node: ast.Call, alone: bool) -> Value:
        if not isinstance(node.func, ast.Name) or node.keywords:
            if isinstance(node.func, ast.Attribute):
                hint = instead(FUNCTIONS, node.func.attr)
            else:
                hint = instead(CONSTRUCTS, "keywords")
            raise self.refuse(node, f"call {ast.unparse(node.func)}(..) is no plain call of a kernel{hint}")
        name = node.func.id
        known = name in ("abs", "bool") or name in self.module.builtins
        if name in CASTS and len(node.args) == 1 and known:
            return self._cast(node, CASTS[name], alone)
        if name in FLOAT_FUNCTIONS and len(node.args) == 1 and known:
            return Value(f"{FLOAT_FUNCTIONS[name]}({self.scalar(node.args[0], F32, f'{name} of').text})", F32)
        if name == "elapsed" and len(node.args) == 2 and name in self.module.builtins:
            later, earlier = (self.scalar(argument, I32, "an instant") for argument in node.args)
            difference = f"(uint32_t){later.within(UNARY)} - (uint32_t){earlier.within(UNARY)}"
            return Value(f"(int32_t)({difference})", I32, UNARY)
        return self._kernel(node, name, alone)

    def _kernel(self, node: ast.Call, name: str, alone: bool) -> Value:
        """Return the call of a kernel."""
        kernel = self.module.names.get(name)
        if not isinstance(kernel, Signature):
            raise self.refuse(node, f"call of {name}, which is no kernel{instead(FUNCTIONS, name)}")
        if kernel.writes and not alone:
            raise self.refuse(
                node, f"{name} writes through its arguments: its call stands alone in a statement"
            )
        if len(node.args) != len(kernel.arguments):
            raise self.refuse(node, f"{name} takes {len(kernel.arguments)} arguments")
        pairs = zip(node.args, kernel.arguments, strict=True)
        texts = [self._argument(argument, kernel, wanted) for argument, wanted in pairs]
        return Value(f"{kernel.c_name}({', '.join(texts)})", kernel.result)

    def _cast(self, node: ast.Call, target: ValueType, alone: bool) -> Value:
        literal = constant_literal(node)
        if literal is not None:
            return Value(literal[1], literal[0], UNARY if literal[1].startswith("-") else PRIMARY)
        if isinstance(node.args[0], ast.Constant | ast.UnaryOp) and constant_literal(node.args[0]) is None:
            for constant in ast.walk(node.args[0]):
                if isinstance(constant, ast.Constant):
                    raise self.refuse(node, f"{ast.unparse(node)} is no finite 32-bit number")
        value = self.value(node.args[0], alone)
        if value.kind == target:
            return value
        if {value.kind, target} != {F32, I32}:
            raise self.refuse(node, f"{ast.unparse(node.func)}(..) of {describe(value.kind)}")
        c_type = "float" if target == F32 else "int32_t"
        return Value(f"({c_type}){value.within(UNARY)}", target, UNARY)

    def _argument(self, node: ast.expr, kernel: Signature, wanted: str) -> str:
        """Return an argument of a call; array arguments take their shape from here."""
        value, kind = self.value(node), kernel.arguments[wanted]
        if kind.rank and value.kind.rank and kind.base == value.kind.base:
            if kind.shape[1:] != value.kind.shape[1:] and kind.shape:
                raise self.refuse(node, f"{wanted} of {kernel.node.name} gets arrays of different shapes")
            if not kind.shape:
                kernel.arguments[wanted] = value.kind
            elif value.kind.shape[:1] < kind.shape[:1]:
                kernel.arguments[wanted] = value.kind  # the shortest array bounds the literal indices
        elif kind.base != value.kind.base or kind.rank != value.kind.rank:
            raise self.refuse(node, f"{wanted} of {kernel.node.name} gets {describe(value.kind)}")
        return value.text


def mixed(left: ValueType, right: ValueType) -> str:
    """Return the hint for a float that meets an integer, else nothing."""
    return instead(CONSTRUCTS, "f32 and i32") if {left, right} == {F32, I32} else ""


def describe(kind: ValueType) -> str:
    """Return a type in words."""
    return kind.base + ("", " array", " matrix")[kind.rank]
