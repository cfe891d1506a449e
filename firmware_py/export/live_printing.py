"""Prints the laboratory's kernels as C: what they may do beyond the core's subset.

They compute in `double`, with integers of 64 bits, and call `math`, `min` and `max`; an integer next to a float becomes a
float, as in Python, and `float` meets `double` through `f32(..)` and `f64(..)` only. Locals may get their first value in any
block, and a tuple on the left takes one on the right. There are `while`, `break`, and operators that assign.

An exception in Python ends the C functions, too: a function that may `call` Python returns an integer, and checks for an
exception after each such statement.
"""

import ast
import builtins
import math
from types import ModuleType
from typing import Any, ClassVar

from firmware_py.core import subset
from firmware_py.core.subset import f32, f64, i32
from firmware_py.export.expressions import OR, UNARY, Expressions, Value, describe
from firmware_py.export.functions import C_TYPES, FunctionPrinter, declare
from firmware_py.export.live_reading import CALL, LiveModule, double_literal
from firmware_py.export.syntax import BOOL, F32, F64, I32, I64, Signature, ValueType

CHOICE = 1
# Exact or correctly rounded: name in C, kinds of the arguments, of the result.
FUNCTIONS: dict[Any, tuple[str, tuple[ValueType, ...], ValueType]] = {
    math.sqrt: ("__builtin_sqrt", (F64,), F64),
    math.copysign: ("__builtin_copysign", (F64, F64), F64),
    math.ldexp: ("ldexp_of", (F64, I64), F64),
    math.floor: ("floor_of", (F64,), I64),
    abs: ("__builtin_fabs", (F64,), F64),
    min: ("min_of", (F64, F64), F64),
    max: ("max_of", (F64, F64), F64),
}
# `floor_of` has a value where Python has none, so that no number is undefined behaviour.
HELPERS = """\
__attribute__((unused)) static inline double min_of(double a, double b) { return b < a ? b : a; }

__attribute__((unused)) static inline double max_of(double a, double b) { return b > a ? b : a; }

__attribute__((unused)) static inline int64_t floor_of(double x) {
    if (!(x >= -9.2e18 && x <= 9.2e18)) return INT64_MIN;
    const int64_t whole = (int64_t)x;
    return whole - ((double)whole > x ? 1 : 0);
}

__attribute__((unused)) static inline int64_t call_of(int64_t function) {
    void *const answer = PyObject_CallNoArgs((void *)(intptr_t)function);
    if (!answer) return -1;
    const int64_t number = answer == (void *)&_Py_NoneStruct ? 0 : PyLong_AsLongLong(answer);
    Py_DecRef(answer);
    return number;
}

__attribute__((unused)) static inline double ldexp_of(double x, int64_t doublings) {
    return __builtin_ldexp(x, (int)doublings);
}
"""


class LiveExpressions(Expressions):
    """Prints the expressions of a kernel of the laboratory."""

    INTEGER, NUMBERS = I64, (F64, F32, I64)

    def __init__(self, kernel: Signature) -> None:
        super().__init__(kernel)
        assert isinstance(kernel.scope, LiveModule)
        self._globals = kernel.scope.live
        self.rounds_down = True
        self.raised = False  # by the statement that is being printed

    def spelled(self, name: str) -> str:
        """Return a local as C writes it."""
        return name

    def place(self, node: ast.expr) -> Value:
        """Return an array's element or a field as it is in memory."""
        return super().value(node)

    def value(self, node: ast.expr, alone: bool = False) -> Value:
        """Return a printed expression; integers from memory become as wide as all others."""
        if isinstance(node, ast.IfExp):
            return self._choice(node)
        value = super().value(node, alone)
        return Value(f"(int64_t){value.within(UNARY)}", I64, UNARY) if value.kind == I32 else value

    def as_float(self, value: Value) -> Value:
        """Return a value as a float where it is an integer."""
        return Value(f"(double){value.within(UNARY)}", F64, UNARY) if value.kind == I64 else value

    def fit(self, node: ast.AST, value: Value, kind: ValueType) -> str:
        """Return the text of a value for a place or local of a kind."""
        if kind == F64:
            value = self.as_float(value)
        elif kind == I32 and value.kind == I64:
            narrow = value.text.startswith("(int32_t)")
            value = Value(value.text if narrow else f"(int32_t){value.within(UNARY)}", I32, UNARY)
        if value.kind != kind or kind.rank:
            raise self.refuse(node, f"{describe(kind)} = {describe(value.kind)}")
        return value.text

    def _meant(self, node: ast.expr) -> Any:
        """Return what a name means in the module; None for a local one, and for anything else."""
        match node:
            case ast.Name(id=name) if name not in self.names:
                return self._globals.get(name, getattr(builtins, name, None))
            case ast.Attribute(value=inner, attr=name):
                module = self._meant(inner)
                return getattr(module, name, None) if isinstance(module, ModuleType) else None
        return None

    def _choice(self, node: ast.IfExp) -> Value:
        test = self.scalar(node.test, BOOL, "the condition")
        yes, no = self._alike(self.value(node.body), self.value(node.orelse))
        if yes.kind != no.kind or yes.kind.rank:
            raise self.refuse(node, f"{describe(yes.kind)} or {describe(no.kind)}")
        return Value(f"{test.within(OR)} ? {yes.within(OR)} : {no.within(OR)}", yes.kind, CHOICE)

    def _literal(self, node: ast.Constant) -> Value:
        if isinstance(node.value, float):
            return Value(double_literal(node.value), F64)
        return super()._literal(node)

    def _field(self, node: ast.Attribute) -> Value:
        meant = self._meant(node)
        if isinstance(meant, float):
            return Value(double_literal(meant), F64)
        return super()._field(node)

    def _alike(self, left: Value, right: Value) -> tuple[Value, Value]:
        if {left.kind, right.kind} == {F64, I64}:
            return self.as_float(left), self.as_float(right)
        return left, right

    def _call(self, node: ast.Call, alone: bool) -> Value:
        meant = self._meant(node.func)
        if node.keywords or meant is None:
            raise self.refuse(node, f"call {ast.unparse(node)}")
        if meant is subset.call and len(node.args) == 1:
            function = self.scalar(node.args[0], I64, "what is called")
            return self._raising(node, alone, Value(f"{CALL}({function.text})", I64))
        if meant is subset.step and len(node.args) == 1:
            return self.value(node.args[0], alone)
        if meant in (f64, f32, int, i32, bool) and len(node.args) == 1:
            return self._converted(node, meant)
        if meant in FUNCTIONS and len(node.args) == len(FUNCTIONS[meant][1]):
            name, kinds, result = FUNCTIONS[meant]
            pairs = zip(node.args, kinds, strict=True)
            texts = [self.fit(argument, self.value(argument), kind) for argument, kind in pairs]
            return Value(f"{name}({', '.join(texts)})", result)
        name = ast.unparse(node.func)
        value = self._kernel(node, name, alone)
        kernel = self.module.names[name]
        assert isinstance(kernel, Signature)
        return self._raising(node, alone, value) if CALL in kernel.calls else value

    def _raising(self, node: ast.Call, alone: bool, value: Value) -> Value:
        """Return a call that may raise; its statement is followed by a check."""
        if not alone:
            raise self.refuse(node, "a call of Python inside an expression: give it a statement")
        self.raised = True
        return value

    def _converted(self, node: ast.Call, target: Any) -> Value:
        value = self.value(node.args[0])
        if target is f64 and value.kind in (F64, I64):
            return self.as_float(value)
        if (target, value.kind) in ((bool, BOOL), (f32, F32)):
            return value
        if (target, value.kind) in ((f64, F32), (f32, F64)):
            c_type, kind = ("double", F64) if target is f64 else ("float", F32)
            return Value(f"({c_type}){value.within(UNARY)}", kind, UNARY)
        if target in (int, i32) and value.kind in (F64, I64, BOOL):
            c_type = "int32_t" if target is i32 else "int64_t"
            return Value(f"({c_type}){value.within(UNARY)}", I64, UNARY)
        raise self.refuse(node, f"{ast.unparse(node)} of {describe(value.kind)}")

    def _argument(self, node: ast.expr, kernel: Signature, wanted: str) -> str:
        if kernel.arguments[wanted] == F64:
            return self.fit(node, self.value(node), F64)
        return super()._argument(node, kernel, wanted)


class LivePrinter(FunctionPrinter):
    """Prints one kernel of the laboratory."""

    EXPRESSIONS: ClassVar[type[Expressions]] = LiveExpressions
    LOCALS_ANYWHERE = True
    _print: LiveExpressions

    def _statement(self, node: ast.stmt, depth: int) -> None:
        self._plain_statement(node, depth)
        if self._print.raised:
            self._print.raised = False
            if self.kernel.result != I64:
                raise self._print.refuse(node, "a call of Python: the function must return an integer")
            if not isinstance(node, ast.Return):
                self._fold(depth, "if (PyErr_Occurred()) return -1;")

    def _plain_statement(self, node: ast.stmt, depth: int) -> None:
        match node:
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values)):
                if len(targets) != len(values):
                    raise self._print.refuse(node, f"{len(targets)} places for {len(values)} values")
                *earlier, last = self._all_at_once(node, targets, values)
                for text in earlier:
                    self._fold(depth, text)
                self._write(node, depth, last)
            case ast.Assign(targets=[target]) | ast.AnnAssign(target=target, value=ast.expr()):
                assert node.value is not None
                value = self._print.value(node.value, alone=True)
                self._write(node, depth, self._put(node, target, value))
            case ast.AugAssign(target=target):
                combined = ast.copy_location(ast.BinOp(target, node.op, node.value), node)
                self._write(node, depth, self._put(node, target, self._print.value(combined)))
            case ast.While(orelse=[]):
                test = self._print.scalar(node.test, BOOL, "the condition")
                self._write(node, depth, f"while ({test.text}) {{")
                self._block(node.body, depth + 1)
                self._lines.append(f"{'    ' * depth}}}")
            case _:
                super()._statement(node, depth)

    def _all_at_once(self, node: ast.stmt, targets: list[ast.expr], values: list[ast.expr]) -> list[str]:
        """Return the assignments of a tuple: Python computes every value before it assigns the first."""
        printed = [self._print.value(value) for value in values]
        before = []
        if any(_may_read(value, targets[:index]) for index, value in enumerate(values)):
            for index, value in enumerate(printed):
                name = f"value_{node.lineno}_{index}"
                before.append(f"const {declare(name, value.kind, True)} = {value.text};")
                printed[index] = Value(name, value.kind)
        pairs = zip(targets, printed, strict=True)
        return before + [self._put(node, target, value) for target, value in pairs]

    def _put(self, node: ast.stmt, target: ast.expr, value: Value) -> str:
        """Return the assignment of a value to a local, an element or a field."""
        if not isinstance(target, ast.Name):
            place = self._print.place(target)
            return f"{place.text} = {self._print.fit(node, value, place.kind)};"
        name, local = target.id, self._locals[target.id]
        if name in self._print.names:
            return f"{self._print.spelled(name)} = {self._print.fit(node, value, self._print.names[name])};"
        if value.kind.base not in C_TYPES or (value.kind.rank and local.assignments > 1):
            raise self._print.refuse(node, f"local {name} of type {describe(value.kind)}")
        self._print.names[name] = value.kind
        declared = declare(name, value.kind, name in self.kernel.writes)
        if local.home != local.block:
            self._declared.append(f"    {declared};")
            return f"{name} = {value.text};"
        const = "const " if local.assignments == 1 and not value.kind.rank else ""
        return f"{const}{declared} = {value.text};"

    def _for(self, node: ast.For, depth: int) -> None:
        match node:
            case ast.For(target=ast.Name(id=name), iter=ast.Name(), orelse=[]):
                row = self._print.value(node.iter)
                if row.kind.rank != 1 or name in self._print.names:
                    raise self._print.refuse(node, "a loop runs over a range or a constant tuple")
                at, element = f"{name}_at", C_TYPES[row.kind.base]
                head = f"for (int64_t {at} = 0; {at} < {row.kind.shape[0]}; {at}++) {{"
                self._write(node, depth, head)
                self._fold(depth + 1, f"const {element} {name} = {row.text}[{at}];")
                self._print.names[name] = ValueType(row.kind.base)
                self._block(node.body, depth + 1)
                del self._print.names[name]
                self._lines.append(f"{'    ' * depth}}}")
            case _:
                super()._for(node, depth)


def _may_read(value: ast.expr, targets: list[ast.expr]) -> bool:
    """Return whether a value may depend on one of these places."""
    names = {target.id for target in targets if isinstance(target, ast.Name)}
    in_memory = any(not isinstance(target, ast.Name) for target in targets)
    return any(
        (isinstance(part, ast.Name) and part.id in names)
        or (in_memory and isinstance(part, ast.Attribute | ast.Subscript | ast.Call))
        for part in ast.walk(value)
    )
