"""Types and prints the expressions of a kernel; whatever is not in the subset is refused.

An expression keeps its order of evaluation: C's precedences of the operators used are Python's, and parentheses go where
the tree needs them. A call that writes through an argument is alone in its statement, because C leaves the order of
calls inside an expression open.
"""

import ast
from dataclasses import dataclass
from typing import ClassVar

from firmware_py.core import structs as core
from firmware_py.export import hints
from firmware_py.export.errors import ExportError, FollowUpError, refusal
from firmware_py.export.hints import CONSTRUCTS, FUNCTIONS, HOLE, SIGNS, instead
from firmware_py.export.literals import constant_literal
from firmware_py.export.ranges import Ranges
from firmware_py.export.syntax import BOOL, BROKEN, F32, I32, Constant, Module, Signature, ValueType

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
        self.names: dict[str, ValueType] = dict(kernel.arguments) | dict.fromkeys(kernel.lost, BROKEN)
        self.constants: list[Constant] = []  # those that the kernel uses
        self.read: set[str] = set()
        self.ended: set[str] = set()  # variables of loops that have ended
        self.ranges = Ranges(self.module, self.names, self.INTEGER)
        self.rounds_down = self.module.own  # `//` and `%` of negative numbers are Python's

    def refuse(self, node: ast.AST, reason: str) -> ExportError:
        """Return the error for a construct of this kernel; a follow-up where a part of it has been refused."""
        head = node.iter if isinstance(node, ast.For) else node
        reads = [
            part for part in ast.walk(head) if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Load)
        ]
        if node is not self.kernel.node and any(self.is_broken(part.id) for part in reads):
            return FollowUpError(reason)
        return refusal(self.kernel.path, node, f"{reason} (in {self.kernel.node.name})")

    def is_broken(self, name: str) -> bool:
        """Return whether a name's definition has been refused."""
        if name in self.names:
            return self.names[name] == BROKEN
        return name == HOLE or name in self.module.broken

    def scalar(self, node: ast.expr, kind: ValueType, what: str, alone: bool = False) -> Value:
        """Return an expression that has to be of this type."""
        value = self.value(node, alone)
        if value.kind != kind:
            hint = hints.converted(node, value.kind, kind)
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
        raise self.refuse(node, f"{hints.word(node)}{instead(CONSTRUCTS, type(node).__name__)}")

    def _literal(self, node: ast.Constant) -> Value:
        if isinstance(node.value, bool):
            return Value("true" if node.value else "false", BOOL)
        if isinstance(node.value, float):
            reason = f"float literal {node.value} without f32(..): write f32({node.value})"
            raise self.refuse(node, reason)
        literal = constant_literal(node)
        if literal is None:
            hint = "a number of 32 bits" if isinstance(node.value, int) else "a number, as f32(0.5) or 3"
            raise self.refuse(node, f"literal {node.value!r}: write {hint}")
        return Value(literal[1], self.INTEGER)

    def _name(self, node: ast.Name) -> Value:
        if self.is_broken(node.id):
            raise FollowUpError(node.id)
        if node.id in self.names:
            self.read.add(node.id)
            return Value(node.id, self.names[node.id])
        thing = self.module.names.get(node.id)
        if not isinstance(thing, Constant):
            raise self.refuse(node, f"{node.id} is no value here{self._known_name(node.id)}")
        self.constants.append(thing)
        return Value(thing.c_name, thing.kind)

    def _field(self, node: ast.Attribute) -> Value:
        text = ast.unparse(node)
        if not isinstance(node.value, ast.Name):
            raise self.refuse(node, f"{text} is no field of a struct: write argument.field")
        name = node.value.id
        struct = self.names[name].struct if name in self.names else None
        if struct is None and name not in self.names and BROKEN in self.kernel.arguments.values():
            raise FollowUpError(name)
        if struct is None:
            structs = [
                one for one, kind in self.names.items() if kind.struct and node.attr in kind.struct.fields
            ]
            known = structs and name != "self"
            hint = f": write {structs[0]}.{node.attr}" if known else instead(FUNCTIONS, node.attr)
            hint = hint or self._missing_argument(node, name)
            raise self.refuse(node, f"{text}: {name} is no argument with fields{hint}")
        if node.attr in struct.broken:
            raise FollowUpError(text)
        if node.attr not in struct.fields:
            hint = hints.nearest(node.attr, struct.fields, f"{name}.")
            if "now" in struct.fields and node.attr.upper() in vars(core):  # part of the state
                hint = f": write {name}.now[{node.attr.upper()} + k]"
            raise self.refuse(node, f"{text} is no field of a struct{hint}")
        self.read.add(node.value.id)
        return Value(f"{node.value.id}->{node.attr}", struct.fields[node.attr].kind)

    def _element(self, node: ast.Subscript) -> Value:
        array = self.value(node.value)
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if any(isinstance(index, ast.Slice) for index in indices):
            raise self.refuse(node, f"slice{instead(CONSTRUCTS, 'Slice')}")
        rank = array.kind.rank
        if rank and not array.kind.shape and self.module.refusals.found:
            raise FollowUpError(ast.unparse(node))  # the call that shows its size may be refused
        if rank == 0 or len(indices) != rank:
            form = f"write {array_form(node.value, rank)}" if rank else "write it without [..]"
            many = f"{len(indices)} {'index' if len(indices) == 1 else 'indices'}"
            reason = f"{ast.unparse(node)}: {many} on {describe(array.kind)}: {form}"
            raise self.refuse(node, reason)
        text = array.text
        for axis, index in enumerate(indices):
            text += f"[{self.scalar(index, self.INTEGER, 'an index').text}]"
            reached = self.ranges.of(index)
            size = array.kind.shape[axis] if array.kind.shape else 2**31
            if reached is None and self.module.own:
                name = ast.unparse(index)
                reason = f"index {name}: it may be outside 0..{size - 1} in flight: write {name} % {size}"
                raise self.refuse(index, f"{reason}, or min(max({name}, 0), {size - 1})")
            least, most = reached or (0, 0)
            if not 0 <= least <= most < size:
                reach = f"{least}..{most}" if least < most else str(least)
                which = "" if ast.unparse(index) == reach else f", which is {reach}"
                has = f"{describe(array.kind)} of {size} has 0..{size - 1}"
                hint = f"min(max({ast.unparse(index)}, 0), {size - 1})" if least < most else ""
                if -size <= least == most < 0:
                    hint = str(size + least)
                hint = f": write {hint}" if hint else ""
                raise self.refuse(index, f"index {ast.unparse(index)}{which}: {has}{hint}")
        return Value(text, ValueType(array.kind.base))

    def _missing_argument(self, node: ast.Attribute, name: str) -> str:
        """Return the repair, ": write ...", for a field of a name that is not an argument."""
        if name == "self":
            return f": write memory.{node.attr}, a field of the memory struct"
        if name[:1].isupper():
            return f": write {name.upper()}_{node.attr.upper()} = 0 at the top of the file, and its name here"
        return f": write {name} as an argument of {self.kernel.node.name}, with its struct"

    def _known_name(self, name: str) -> str:
        """Return ": write ..." with what a name may mean, else nothing."""
        thing = self.module.names.get(name)
        if isinstance(thing, Signature):
            return f": write {name}({', '.join(thing.arguments)})"
        if name in self.ended:
            return f": its loop has ended: write last = {name} inside, and read last"
        if name in FUNCTIONS:
            return instead(FUNCTIONS, name)
        values = [one for one, known in self.module.names.items() if isinstance(known, Constant)]
        return hints.nearest(name, [*self.names, *values]) or f": write {name} = f32(0.0) before"

    def _binary(self, node: ast.BinOp) -> Value:
        left, right = self._alike(self.value(node.left), self.value(node.right))
        sign = SIGNS[type(node.op).__name__]
        if left.kind != right.kind or left.kind not in self.NUMBERS:
            if type(node.op) in INTEGER_OPERATORS | FLOAT_OPERATORS:
                hint = hints.mixed(node.left, node.right, (left.kind, right.kind))
                hint = hint or unlike(left.kind, right.kind)
            else:
                hint = hints.operator(node, left.kind)
            raise self.refuse(node, f"{sign} of {describe(left.kind)} and {describe(right.kind)}{hint}")
        operators = INTEGER_OPERATORS if left.kind == self.INTEGER else FLOAT_OPERATORS
        if type(node.op) not in operators:
            raise self.refuse(node, f"{sign} of {describe(left.kind)}{hints.operator(node, left.kind)}")
        if self.rounds_down and isinstance(node.op, ast.FloorDiv | ast.Mod):
            return self._rounded_down(node, left, right)
        sign, strength = operators[type(node.op)]
        return Value(f"{left.within(strength)} {sign} {right.within(strength + 1)}", left.kind, strength)

    def _alike(self, left: Value, right: Value) -> tuple[Value, Value]:
        """Return the operands of one operator; nothing is converted silently."""
        return left, right

    def _rounded_down(self, node: ast.BinOp, left: Value, right: Value) -> Value:
        """Return `//` or `%` of any integer as Python computes it: C rounds towards zero."""
        divisor = self.ranges.of(node.right)
        if divisor is None or divisor[0] <= 0:
            reason = f"{ast.unparse(node)}: the divisor must be a constant above 0: write a number there"
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
        text = ast.unparse(node.operand)
        zero = "0" if operand.kind == self.INTEGER else "f32(0.0)"
        hint = {ast.Not: f"{text} == {zero}", ast.UAdd: text, ast.Invert: f"-{text} - 1"}.get(
            type(node.op), "0"
        )
        reason = f"{SIGNS[type(node.op).__name__]} of {describe(operand.kind)}: write {hint}"
        raise self.refuse(node, reason)

    def _comparison(self, node: ast.Compare) -> Value:
        if len(node.ops) != 1 or type(node.ops[0]) not in COMPARISONS:
            raise self.refuse(node, f"comparison {ast.unparse(node)}: write {hints.comparison(node)}")
        left, right = self._alike(self.value(node.left), self.value(node.comparators[0]))
        if left.kind != right.kind or left.kind not in self.NUMBERS:
            hint = hints.mixed(node.left, node.comparators[0], (left.kind, right.kind))
            hint = hint or unlike(left.kind, right.kind)
            reason = f"comparison of {describe(left.kind)} and {describe(right.kind)}{hint}"
            raise self.refuse(node, reason)
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
                hint = (
                    instead(FUNCTIONS, node.func.attr)
                    or f": write {node.func.attr}(..), a @kernel of this file"
                )
            else:
                hint = instead(CONSTRUCTS, "keywords")
            raise self.refuse(node, f"call {ast.unparse(node.func)}(..) is no plain call of a kernel{hint}")
        name = node.func.id
        known = name in ("abs", "bool") or name in self.module.builtins
        if (
            name in ("min", "max")
            and len(node.args) == 2
            and self.module.own
            and name not in self.names | self.module.names
        ):
            return self._least_or_most(node, "<" if name == "min" else ">")
        if name in CASTS and len(node.args) == 1 and known:
            return self._cast(node, CASTS[name], alone)
        if name in FLOAT_FUNCTIONS and len(node.args) == 1 and known:
            return Value(
                f"{FLOAT_FUNCTIONS[name]}({self.scalar(node.args[0], F32, f'the argument of {name}').text})",
                F32,
            )
        if name == "elapsed" and len(node.args) == 2 and name in self.module.builtins:
            later, earlier = (self.scalar(argument, I32, "an instant") for argument in node.args)
            difference = f"(uint32_t){later.within(UNARY)} - (uint32_t){earlier.within(UNARY)}"
            return Value(f"(int32_t)({difference})", I32, UNARY)
        return self._kernel(node, name, alone)

    def _least_or_most(self, node: ast.Call, sign: str) -> Value:
        """Return `min` or `max` of two numbers with Python's choice: the first, unless the second one is beyond."""
        first, second = (self.value(argument) for argument in node.args)
        if first.kind != second.kind or first.kind not in (F32, I32):
            hint = hints.mixed(node.args[0], node.args[1], (first.kind, second.kind))
            reason = f"{ast.unparse(node)} of {describe(first.kind)} and {describe(second.kind)}"
            raise self.refuse(node, f"{reason}{hint or ': write an if'}")
        one, other = first.within(COMPARISON + 1), second.within(COMPARISON + 1)
        return Value(f"({other} {sign} {one} ? {other} : {one})", first.kind)

    def _kernel(self, node: ast.Call, name: str, alone: bool) -> Value:
        """Return the call of a kernel."""
        kernel = self.module.names.get(name)
        if not isinstance(kernel, Signature):
            if name in self.module.builtins and name in (*CASTS, *FLOAT_FUNCTIONS, "elapsed"):
                form = "elapsed(later, earlier)" if name == "elapsed" else f"{name}(x)"
                raise self.refuse(node, f"{name} of {len(node.args)} arguments: write {form}")
            raise self.refuse(node, f"call of {name}, which is no kernel{self._function(node, name)}")
        if kernel.writes and not alone:
            hint = f"write x = {name}(..) on a line of its own, or {name}(..) alone"
            raise self.refuse(node, f"{name} writes through its arguments: {hint}")
        if len(node.args) != len(kernel.arguments):
            listed = f"{name}({', '.join(kernel.arguments)})"
            raise self.refuse(node, f"{name} takes {len(kernel.arguments)} arguments: write {listed}")
        pairs = zip(node.args, kernel.arguments, strict=True)
        texts = [self._argument(argument, kernel, wanted) for argument, wanted in pairs]
        return Value(f"{kernel.c_name}({', '.join(texts)})", kernel.result)

    def _function(self, node: ast.Call, name: str) -> str:
        """Return the repair, ": write ...", for a call of a function that is not a kernel."""
        if name in self.module.broken:
            raise FollowUpError(name)
        if name == "len" and len(node.args) == 1 and (shape := self.value(node.args[0]).kind.shape):
            return f": write {shape[0]}"
        kernels = [one for one, known in self.module.names.items() if isinstance(known, Signature)]
        hint = instead(FUNCTIONS, name) or hints.nearest(name, [*kernels, *self.module.builtins])
        return hint or f": write a @kernel def {name}(..) above"

    def _cast(self, node: ast.Call, target: ValueType, alone: bool) -> Value:
        literal = constant_literal(node)
        if literal is not None:
            return Value(literal[1], literal[0], UNARY if literal[1].startswith("-") else PRIMARY)
        bare = node.args[0].operand if isinstance(node.args[0], ast.UnaryOp) else node.args[0]
        if isinstance(bare, ast.Constant) and constant_literal(node.args[0]) is None:
            bounds = "-3.4e38..3.4e38" if target == F32 else "-2147483648..2147483647"
            reason = f"{ast.unparse(node)} is no finite 32-bit number: write one of {bounds}"
            raise self.refuse(node, reason)
        value = self.value(node.args[0], alone)
        if value.kind == target:
            return value
        if {value.kind, target} != {F32, I32}:
            hint = hints.converted(node.args[0], value.kind, target) or ": write one of its elements"
            raise self.refuse(node, f"{ast.unparse(node.func)}(..) of {describe(value.kind)}{hint}")
        c_type = "float" if target == F32 else "int32_t"
        return Value(f"({c_type}){value.within(UNARY)}", target, UNARY)

    def _argument(self, node: ast.expr, kernel: Signature, wanted: str) -> str:
        """Return an argument of a call; array arguments take their shape from here."""
        value, kind = self.value(node), kernel.arguments[wanted]
        if kind.rank and value.kind.rank and kind.base == value.kind.base:
            if kind.shape[1:] != value.kind.shape[1:] and kind.shape:
                reason = f"{wanted} of {kernel.node.name} gets arrays of different shapes"
                raise self.refuse(node, f"{reason}: write a function for each")
            if not kind.shape:
                kernel.arguments[wanted] = value.kind
            elif value.kind.shape[:1] < kind.shape[:1]:
                kernel.arguments[wanted] = value.kind  # the shortest array bounds the literal indices
        elif kind.base != value.kind.base or kind.rank != value.kind.rank:
            if kind == BROKEN:
                raise FollowUpError(wanted)
            hint = hints.converted(node, value.kind, kind) or f": it takes {describe(kind)}"
            raise self.refuse(node, f"{wanted} of {kernel.node.name} gets {describe(value.kind)}{hint}")
        return value.text


def unlike(left: ValueType, right: ValueType) -> str:
    """Return the hint for operands of which at least one is not a number."""
    if BOOL in (left, right):
        return ": write and, or, not between comparisons"
    return (
        ": write a loop over range(..) for the elements"
        if left.rank or right.rank
        else ": write a field of it"
    )


def array_form(node: ast.expr, rank: int) -> str:
    """Return how an element of an array is written."""
    return f"{ast.unparse(node)}[{', '.join(('row', 'column')[-rank:])}]"


def describe(kind: ValueType) -> str:
    """Return a type in words."""
    if kind.struct is not None:
        return kind.struct.shown or kind.base
    if kind.base == "void":
        return "None"
    return kind.base + ("", " array", " matrix")[kind.rank]
