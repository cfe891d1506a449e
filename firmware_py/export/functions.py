"""Prints a kernel as a C function: declarations, loops, branches, and its docstring and comments."""

import ast
import textwrap
from typing import ClassVar

from firmware_py.export.expressions import Expressions, describe
from firmware_py.export.hints import CONSTRUCTS, instead
from firmware_py.export.locals import find_locals
from firmware_py.export.syntax import BOOL, I32, I64, VOID, Constant, Signature, ValueType

C_TYPES = {
    "f32": "float", "f64": "double", "i32": "int32_t", "i64": "int64_t", "bool": "bool", "void": "void",
}  # fmt: skip
WIDTH = 110


class FunctionPrinter:
    """Prints one kernel; afterwards `constants` are those that it uses."""

    EXPRESSIONS: ClassVar[type[Expressions]] = Expressions
    LOCALS_ANYWHERE: ClassVar[bool] = False

    def __init__(self, kernel: Signature) -> None:
        self.kernel = kernel
        self._print = self.EXPRESSIONS(kernel)
        self._locals, self._loops = find_locals(kernel, self.LOCALS_ANYWHERE)
        self._declared: list[str] = []  # at the top, without a value
        self._lines: list[str] = []
        self._commented = kernel.node.body[0].end_lineno or 0  # comments up to this line are printed
        self._body = kernel.node.body[1:] if ast.get_docstring(kernel.node) else kernel.node.body
        if not (kernel.scope.own or ast.get_docstring(kernel.node)):
            raise self._print.refuse(kernel.node, "no docstring")

    @property
    def constants(self) -> list[Constant]:
        """Return the constants that the printed function uses."""
        return self._print.constants

    def text(self) -> str:
        """Return the function's definition."""
        self._block(self._body, 1)
        if self.kernel.result != VOID and not _returns(self._body):
            raise self._print.refuse(self.kernel.node, "may end without a result")
        for name in self.kernel.arguments:
            if name not in self._print.read:
                raise self._print.refuse(self.kernel.node, f"argument {name} is not used")
        comment = block_comment(ast.get_docstring(self.kernel.node) or "")
        return f"{comment}{self.signature()} {{\n" + "\n".join((*self._declared, *self._lines)) + "\n}\n"

    def signature(self) -> str:
        """Return the declaration without its semicolon; known after the callers have been printed."""
        kernel = self.kernel
        listed = [declare(name, kind, name in kernel.writes) for name, kind in kernel.arguments.items()]
        lines = [f"{'' if kernel.public else 'static '}{C_TYPES[kernel.result.base]} {kernel.c_name}("]
        for position, argument in enumerate(listed or ["void"]):
            piece = argument + (", " if position + 1 < len(listed) else ")")
            if len(lines[-1] + piece) > WIDTH:
                lines[-1] = lines[-1].rstrip()
                lines.append("        ")
            lines[-1] += piece
        return "\n".join(lines)

    def _block(self, body: list[ast.stmt], depth: int) -> None:
        for node in body:
            self._comments(node.lineno, depth)
            self._statement(node, depth)

    def _comments(self, line: int, depth: int) -> None:
        standing = self.kernel.scope.standing
        for number in range(self._commented + 1, line):
            if number in standing:
                self._lines.append(f"{'    ' * depth}// {standing[number]}")
        self._commented = max(self._commented, line - 1)

    def _write(self, node: ast.stmt, depth: int, text: str) -> None:
        """Print a line with the comment behind its statement, folded if it is long."""
        simple = not isinstance(node, ast.If | ast.For | ast.While)
        scope = self.kernel.scope
        comment = scope.comment(node) if simple else scope.trailing.get(node.lineno, "")
        self._fold(depth, text)
        if comment:
            self._lines[-1] += f"  // {comment}"

    def _fold(self, depth: int, text: str) -> None:
        indent = "    " * depth
        folded = textwrap.wrap(text, WIDTH - len(indent), subsequent_indent="    ", break_long_words=False)
        self._lines += [indent + line for line in folded]

    def _statement(self, node: ast.stmt, depth: int) -> None:
        match node:
            case ast.Assign(targets=[ast.Name() as target]):
                self._assign_local(node, target, depth)
            case ast.Assign(targets=[ast.Subscript() | ast.Attribute() as target]):
                place, value = self._print.value(target), self._print.value(node.value, alone=True)
                if place.kind != value.kind or place.kind.rank:
                    raise self._print.refuse(node, f"{describe(place.kind)} = {describe(value.kind)}")
                self._write(node, depth, f"{place.text} = {value.text};")
            case ast.Expr(value=ast.Call()):
                self._write(node, depth, f"{self._print.value(node.value, alone=True).text};")
            case ast.Return():
                self._return(node, depth)
            case ast.If():
                self._if(node, depth, "")
            case ast.For():
                self._for(node, depth)
            case _:
                name = type(node).__name__
                raise self._print.refuse(node, f"{name} statement{instead(CONSTRUCTS, name)}")

    def _assign_local(self, node: ast.Assign, target: ast.Name, depth: int) -> None:
        name, local = target.id, self._locals[target.id]
        value = self._print.value(node.value, alone=True)
        if value.kind.base not in C_TYPES or value.kind == VOID or value.kind.rank > 1:
            raise self._print.refuse(node, f"local {name} of type {describe(value.kind)}")
        if name not in self._print.names:
            self._print.names[name] = value.kind
            text = declare(name, value.kind, name in self.kernel.writes)
            if value.kind.rank and local.assignments > 1:
                raise self._print.refuse(node, f"{name} stands for more than one array")
            if local.assignments == 1 and not value.kind.rank:
                text = f"const {text}"
            self._write(node, depth, f"{text} = {value.text};")
        elif self._print.names[name] == value.kind:
            self._write(node, depth, f"{name} = {value.text};")
        else:
            raise self._print.refuse(node, f"{name} changes its type to {describe(value.kind)}")

    def _return(self, node: ast.Return, depth: int) -> None:
        wanted = self.kernel.result
        if node.value is None:
            if wanted != VOID:
                raise self._print.refuse(node, f"return without {describe(wanted)}")
            self._write(node, depth, "return;")
            return
        value = self._print.value(node.value, alone=True)
        if value.kind != wanted or wanted == VOID:
            raise self._print.refuse(node, f"returns {describe(value.kind)}, not {describe(wanted)}")
        self._write(node, depth, f"return {value.text};")

    def _if(self, node: ast.If, depth: int, before: str) -> None:
        test = self._print.scalar(node.test, BOOL, "the condition")
        self._write(node, depth, f"{before}if ({test.text}) {{")
        self._block(node.body, depth + 1)
        indent = "    " * depth
        if len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If):
            self._comments(node.orelse[0].lineno, depth + 1)
            self._if(node.orelse[0], depth, "} else ")
            return
        if node.orelse:
            self._lines.append(f"{indent}}} else {{{self._else_comment(node)}")
            self._block(node.orelse, depth + 1)
        self._lines.append(f"{indent}}}")

    def _else_comment(self, node: ast.If) -> str:
        last = node.body[-1].end_lineno or 0
        for line in range(last + 1, node.orelse[0].lineno):
            if line in self.kernel.scope.trailing:
                return f"  // {self.kernel.scope.trailing[line]}"
        return ""

    def _for(self, node: ast.For, depth: int) -> None:
        match node:
            case ast.For(
                target=ast.Name(id=name),
                iter=ast.Call(func=ast.Name(id="range"), args=limits, keywords=[]),
                orelse=[],
            ) if len(limits) in (1, 2):
                pass
            case _:
                if node.orelse:
                    raise self._print.refuse(node.orelse[0], f"else of a loop{instead(CONSTRUCTS, 'else')}")
                raise self._print.refuse(node, "a loop runs over range(end) or range(start, end)")
        if name in self._print.names:
            raise self._print.refuse(node, f"loop variable {name} is in use")
        start = (
            self._print.scalar(limits[0], self._print.INTEGER, "the start of a range").text
            if len(limits) == 2
            else "0"
        )
        # Evaluated once, and last.
        end = self._print.scalar(limits[-1], self._print.INTEGER, "the end of a range", alone=True).text
        limit = ""
        if not self._fixed(limits[-1]):  # Python evaluates the end of a range once
            limit, end = f", {name}_end = {end}", f"{name}_end"
        c_type = C_TYPES[self._print.INTEGER.base]
        self._write(node, depth, f"for ({c_type} {name} = {start}{limit}; {name} < {end}; {name}++) {{")
        reach = self._print.loop(limits[0] if len(limits) == 2 else None, limits[-1])
        if reach:
            self._print.loops[name] = reach
        self._print.names[name] = self._print.INTEGER
        self._block(node.body, depth + 1)
        del self._print.names[name]
        self._print.loops.pop(name, None)
        self._lines.append(f"{'    ' * depth}}}")

    def _fixed(self, node: ast.expr) -> bool:
        """Return whether an expression is made of numbers, constants and loop variables, which loops do not change."""
        for part in ast.walk(node):
            if isinstance(part, ast.Attribute | ast.Subscript | ast.Call):
                return False
            if isinstance(part, ast.Name) and part.id in self._print.names and part.id not in self._loops:
                return False
        return True


def declare(name: str, kind: ValueType, written: bool) -> str:
    """Return the declaration of an argument or local; a pointer's target is const unless written."""
    const = "" if written else "const "
    if kind.base not in C_TYPES:
        return f"{const}Floaty{kind.base} *{name}"
    if kind.rank == 2:
        return f"{const}{C_TYPES[kind.base]} (*{name})[{kind.shape[1]}]"
    if kind.rank == 1:
        return f"{const}{C_TYPES[kind.base]} *{name}"
    return f"{C_TYPES[kind.base]} {name}"


def block_comment(text: str) -> str:
    """Return a text as a C comment block, empty for no text."""
    if not text:
        return ""
    lines: list[str] = []
    for paragraph in text.split("\n\n"):
        lines += ["", *textwrap.wrap(paragraph, WIDTH - 6)] if lines else textwrap.wrap(paragraph, WIDTH - 6)
    body = "\n".join(f" * {line}".rstrip() for line in lines[1:])
    return f"/* {lines[0]}" + (f"\n{body}\n */\n" if body else " */\n")


def constant_definition(constant: Constant) -> str:
    """Return the line that defines a constant."""
    comment = f"  // {constant.comment}" if constant.comment else ""
    if constant.shared:
        return f"#define {constant.c_name} {constant.text}{comment}"
    if constant.kind in (I32, I64):
        return f"enum {{ {constant.c_name} = {constant.text} }};{comment}"
    sizes = "".join(f"[{size}]" for size in constant.kind.shape)
    text = f"static const {C_TYPES[constant.kind.base]} {constant.c_name}{sizes} = {constant.text};"
    return "\n".join(textwrap.wrap(text, WIDTH, subsequent_indent="    ", break_on_hyphens=False)) + comment


def _returns(body: list[ast.stmt]) -> bool:
    """Return whether a block always ends in a return."""
    last = body[-1]
    if isinstance(last, ast.If):
        return bool(last.orelse) and _returns(last.body) and _returns(last.orelse)
    return isinstance(last, ast.Return)
