"""Prints tasks of the subset as C: coroutines that go on where they have given up the processor.

The place where a task goes on and its locals, which are integers, are its frame in the kernel's memory: the C returns at a
`yield from` a call of the scheduler. `frame` is where it goes on, the timeout of its call, the answer, then the locals.
"""

import ast
from typing import ClassVar

from firmware_py.core.subset import AGAIN, FAILED, SWITCH, WAITS
from firmware_py.export.expressions import Expressions, Value
from firmware_py.export.functions import FunctionPrinter
from firmware_py.export.live_printing import LiveExpressions, LivePrinter
from firmware_py.export.live_reading import LiveModule
from firmware_py.export.syntax import I64, Signature

LOCALS = 3  # behind what the frame begins with


def printer_of(kernel: Signature) -> FunctionPrinter:
    """Return the printer of a kernel."""
    assert isinstance(kernel.scope, LiveModule)
    if kernel.scope.core:
        return FunctionPrinter(kernel)
    coroutine = any(isinstance(node, ast.YieldFrom) for node in ast.walk(kernel.node))
    return CoroutinePrinter(kernel) if coroutine else LivePrinter(kernel)


class CoroutineExpressions(LiveExpressions):
    """Prints the expressions of a task."""

    def __init__(self, kernel: Signature) -> None:
        super().__init__(kernel)
        self.places: dict[str, int] = {}  # of the locals in the frame

    def spelled(self, name: str) -> str:
        return f"frame[{self.places[name]}]" if name in self.places else name

    def _name(self, node: ast.Name) -> Value:
        value = super()._name(node)
        return Value(self.spelled(node.id), value.kind) if node.id in self.places else value


class CoroutinePrinter(LivePrinter):
    """Prints one task."""

    EXPRESSIONS: ClassVar[type[Expressions]] = CoroutineExpressions
    _print: CoroutineExpressions

    def text(self) -> str:
        """Return the function's definition."""
        self._resumptions = 0
        memory = next(iter(self.kernel.arguments))
        self.kernel.writes.add(memory)
        struct = self.kernel.arguments[memory].struct
        assert struct is not None
        room = struct.fields["frames"].kind.shape[1] - LOCALS
        if len(self._locals) > room:
            raise self._print.refuse(
                self.kernel.node, f"{len(self._locals)} locals: a task has at most {room}"
            )
        self._print.places = {name: LOCALS + place for place, name in enumerate(self._locals)}
        self._print.names |= dict.fromkeys(self._locals, I64)
        self._declared.append(f"    int64_t *const frame = {memory}->frames[{memory}->current];")
        self._declared.append("    switch (frame[0]) {\n    case 0:;")
        self._body = [*self._body, ast.Return(ast.Constant(-1), lineno=self.kernel.node.end_lineno or 0)]
        text = super().text().removesuffix("}\n")
        return f"{text}    }}\n    return -1;\n}}\n"

    def _plain_statement(self, node: ast.stmt, depth: int) -> None:
        match node:
            case ast.Expr(value=ast.YieldFrom(value=ast.Call() as call)):
                self._await(node, call, depth)
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.YieldFrom(value=ast.Call() as call)):
                self._await(node, call, depth, f"{self._print.spelled(name)} = frame[2] != {FAILED};")
            case ast.For():
                raise self._print.refuse(node, "for in a task: its variable would be lost")
            case _:
                super()._plain_statement(node, depth)

    def _await(self, node: ast.stmt, call: ast.Call, depth: int, result: str = "") -> None:
        """Print a call of the scheduler that may give up the processor."""
        kernel = self._print.module.names.get(ast.unparse(call.func))
        if not isinstance(kernel, Signature):
            raise self._print.refuse(
                node, f"yield from {ast.unparse(call.func)}, which is no call of the scheduler"
            )
        waits = "timeout" in kernel.arguments
        if waits:
            timeout = self._print.scalar(call.args[-1], I64, "a timeout").text
            self._write(node, depth, f"frame[1] = {timeout};")
        self._resumptions += 2
        again, after = self._resumptions - 1, self._resumptions
        printed = self._print.value(call, alone=True).text
        if waits:
            printed = f"{printed[: printed.rindex(',')]}, frame[1])"
        lines = [
            f"frame[0] = {again};",
            f"__attribute__((fallthrough)); case {again}:",
            f"frame[2] = {printed};",
            f"if (frame[2] == {WAITS}) {{ frame[1] = {AGAIN}; return 0; }}",
            f"if (frame[2] < {FAILED}) return frame[2];",
            f"frame[0] = {after};",
            f"if (frame[2] == {SWITCH}) return 0;",
            f"__attribute__((fallthrough)); case {after}:;",
            *([result] if result else []),
        ]
        for line in lines:
            self._fold(depth, line)
