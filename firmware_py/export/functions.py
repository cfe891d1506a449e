"""Prints a kernel as a C function: declarations, loops, branches, and its docstring and comments."""

import ast
import textwrap
from typing import ClassVar

from firmware_py.export import hints
from firmware_py.export.errors import ExportError, FollowUpError, refusal
from firmware_py.export.expressions import Expressions, Value, describe
from firmware_py.export.hints import CONSTRUCTS, HOLE, instead
from firmware_py.export.locals import find_locals, leaves
from firmware_py.export.ranges import Interval
from firmware_py.export.syntax import BOOL, BROKEN, F32, I32, I64, VOID, Constant, Signature, ValueType

C_TYPES = {
    "f32": "float", "f64": "double", "i32": "int32_t", "i64": "int64_t", "bool": "bool", "void": "void",
}  # fmt: skip
ZEROS = {F32: "0.0f", I32: "0", BOOL: "false"}
WIDTH = 110


class FunctionPrinter:
    """Prints one kernel; afterwards `constants` are those that it uses."""

    EXPRESSIONS: ClassVar[type[Expressions]] = Expressions
    LOCALS_ANYWHERE: ClassVar[bool] = False

    def __init__(self, kernel: Signature) -> None:
        self.kernel = kernel
        self._print = self.EXPRESSIONS(kernel)
        self._locals, self._loops = find_locals(kernel, self.LOCALS_ANYWHERE)
        self._print.names |= dict.fromkeys(kernel.lost, BROKEN)
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

    def check(self) -> None:
        """Print the body: what cannot be printed is refused."""
        self._block(self._body, 1)
        with self.kernel.scope.refusals.note():
            if self.kernel.result not in (VOID, BROKEN) and not _returns(self._body):
                wanted = describe(self.kernel.result)
                reason = f"may end without a result: write return with a value of {wanted} at its end"
                raise self._print.refuse(self.kernel.node, reason)
        for name in self.kernel.arguments:
            if name not in self._print.read and not self.kernel.scope.own:
                raise self._print.refuse(self.kernel.node, f"argument {name} is not used")
            if name not in self._print.read:
                self._declared.insert(0, f"    (void){name};")

    def text(self) -> str:
        """Return the function's definition."""
        self.check()
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
            known = self._known_value(node)
            with self.kernel.scope.refusals.note():
                self._statement(node, depth)
            if not isinstance(node, ast.If | ast.For | ast.While):
                self._print.ranges.forget(node)
            if isinstance(node, ast.Assign | ast.AugAssign):
                self._print.ranges.assign(_target(node), known)

    def _known_value(self, node: ast.stmt) -> Interval | None:
        """Return the bounds of what a statement assigns."""
        match node:
            case ast.Assign():
                return self._print.ranges.of(node.value)
            case ast.AugAssign():
                return self._print.ranges.of(ast.BinOp(node.target, node.op, node.value))
        return None

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
                self._assign_place(node, place, value)
                self._write(node, depth, f"{place.text} = {value.text};")
            case ast.AugAssign(target=ast.Name() | ast.Subscript() | ast.Attribute() as target):
                combined = ast.copy_location(ast.BinOp(target, node.op, node.value), node)
                place, value = self._print.value(target), self._print.value(combined)
                self._assign_place(node, place, value)
                self._write(node, depth, f"{place.text} = {value.text};")
            case ast.Expr(value=ast.Call()):
                self._write(node, depth, f"{self._print.value(node.value, alone=True).text};")
            case ast.Expr(value=ast.Name(id=name)) if name == HOLE:
                raise FollowUpError(name)
            case ast.Break():
                self._write(node, depth, "break;")
            case ast.Continue():
                self._write(node, depth, "continue;")
            case ast.Pass():
                self._write(node, depth, ";")
            case ast.Return():
                self._return(node, depth)
            case ast.If():
                self._if(node, depth, "")
            case ast.For():
                self._for(node, depth)
            case _:
                reason = f"{hints.word(node)}{instead(CONSTRUCTS, type(node).__name__)}"
                raise refusal(self.kernel.path, node, f"{reason} (in {self.kernel.node.name})")

    def _assign_local(self, node: ast.Assign, target: ast.Name, depth: int) -> None:
        name = target.id
        if name not in self._locals:  # its first use was refused
            self._print.names.setdefault(name, BROKEN)
            self._print.value(node.value, alone=True)
            raise FollowUpError(name)
        try:
            value = self._print.value(node.value, alone=True)
            if value.kind.base not in C_TYPES or value.kind == VOID or value.kind.rank > 1:
                hint = "write a field or an element of it" if value.kind != VOID else "write the call alone"
                raise self._print.refuse(node, f"local {name} of type {describe(value.kind)}: {hint}")
            if name not in self._print.names and value.kind.rank and self._locals[name].assignments > 1:
                reason = f"{name} stands for more than one array: write another name for each"
                raise self._print.refuse(node, reason)
        except ExportError:
            self._print.names.setdefault(name, BROKEN)
            raise
        if name not in self._print.names:
            self._write(node, depth, f"{self._declaration(node, name, value)} = {value.text};")
        elif self._print.names[name] == value.kind:
            self._write(node, depth, f"{name} = {value.text};")
        elif self._print.names[name] != BROKEN:
            hint = hints.converted(node.value, value.kind, self._print.names[name]) or ": write another name"
            raise self._print.refuse(node, f"{name} changes its type to {describe(value.kind)}{hint}")

    def _declaration(self, node: ast.Assign, name: str, value: Value) -> str:
        """Return the left side of a local's first assignment; one that other blocks read is declared at the top."""
        local = self._locals[name]
        text = declare(name, value.kind, name in self.kernel.writes)
        self._print.names[name] = value.kind
        if local.home == local.block:
            return f"const {text}" if local.assignments == 1 and not value.kind.rank else text
        if value.kind.rank:
            raise self._print.refuse(
                node, f"{name} stands for an array in a block only: write the array's name"
            )
        self._declared.append(f"    {text} = {ZEROS[value.kind]};")  # no compiler sees a path without a value
        return name

    def _assign_place(self, node: ast.Assign | ast.AugAssign, place: Value, value: Value) -> None:
        """Refuse the assignment of a value that an element, field or local cannot hold."""
        if place.kind == value.kind and not place.kind.rank:
            return
        if place.kind.rank:
            hint = ": write a loop over range(..) for the elements"
        else:
            hint = hints.converted(node.value, value.kind, place.kind) or ": write a number"
        raise self._print.refuse(node, f"{describe(place.kind)} = {describe(value.kind)}{hint}")

    def _return(self, node: ast.Return, depth: int) -> None:
        wanted = self.kernel.result
        if node.value is None:
            if wanted != VOID:
                reason = f"return without {describe(wanted)}: write return with a value of {describe(wanted)}"
                raise self._print.refuse(node, reason)
            self._write(node, depth, "return;")
            return
        value = self._print.value(node.value, alone=True)
        if wanted == BROKEN:
            raise FollowUpError("result")
        if value.kind != wanted or wanted == VOID:
            form = f"-> {describe(value.kind)}" if value.kind in ZEROS else "one of its numbers"
            form = f"return alone, or {form}" if wanted == VOID else form
            hint = hints.converted(node.value, value.kind, wanted) or f": write {form}"
            raise self._print.refuse(node, f"returns {describe(value.kind)}, not {describe(wanted)}{hint}")
        self._write(node, depth, f"return {value.text};")

    def _if(self, node: ast.If, depth: int, before: str) -> None:
        ranges = self._print.ranges
        with self.kernel.scope.refusals.note():
            test = self._print.scalar(node.test, BOOL, "the condition")
            self._write(node, depth, f"{before}if ({test.text}) {{")
        known = dict(ranges.known)
        ranges.narrow(node.test, True)
        self._block(node.body, depth + 1)
        behind, ranges.known = ranges.known, known
        ranges.narrow(node.test, False)
        indent = "    " * depth
        if len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If):
            self._comments(node.orelse[0].lineno, depth + 1)
            self._if(node.orelse[0], depth, "} else ")
        else:
            if node.orelse:
                self._lines.append(f"{indent}}} else {{{self._else_comment(node)}")
                self._block(node.orelse, depth + 1)
            self._lines.append(f"{indent}}}")
        if leaves(node.orelse):
            ranges.known = behind
        elif not leaves(node.body):
            ranges.join(behind)

    def _else_comment(self, node: ast.If) -> str:
        last = node.body[-1].end_lineno or 0
        for line in range(last + 1, node.orelse[0].lineno):
            if line in self.kernel.scope.trailing:
                return f"  // {self.kernel.scope.trailing[line]}"
        return ""

    def _for(self, node: ast.For, depth: int) -> None:
        name = node.target.id if isinstance(node.target, ast.Name) else HOLE
        limits = node.iter.args if isinstance(node.iter, ast.Call) else []
        names, ranges = self._print.names, self._print.ranges
        outer, kind, reach = names.get(name), BROKEN, None
        with self.kernel.scope.refusals.note():
            self._head(node, depth)
            kind, reach = self._print.INTEGER, ranges.loop(limits)
        ranges.forget(node)
        known = dict(ranges.known)
        if reach:
            ranges.known[name] = reach
        names[name] = kind
        self._block(node.body, depth + 1)
        del names[name]
        if outer:
            names[name] = outer
        self._print.ended.add(name)
        ranges.known = known
        self._lines.append(f"{'    ' * depth}}}")

    def _head(self, node: ast.For, depth: int) -> None:
        """Print the line that begins a loop."""
        match node:
            case ast.For(
                target=ast.Name(id=name),
                iter=ast.Call(func=ast.Name(id="range"), args=limits, keywords=[]),
                orelse=[],
            ) if 1 <= len(limits) <= 3:
                pass
            case _:
                if node.orelse:
                    raise self._print.refuse(node.orelse[0], f"else of a loop{instead(CONSTRUCTS, 'else')}")
                raise self._print.refuse(node, f"a loop runs over range(..): write {self._counted(node)}")
        if name in self._print.names:
            raise self._print.refuse(node, f"loop variable {name} is in use: write another name")
        integer, ranges = self._print.INTEGER, self._print.ranges
        start = (
            self._print.scalar(limits[0], integer, "the start of a range").text if len(limits) > 1 else "0"
        )
        step = ranges.step(limits)
        if len(limits) == 3 and not (step and ranges.loop(limits) and all(map(self._fixed, limits))):
            first, last, by = map(ast.unparse, limits)
            many, sign = (f"{first} - {last}", "-") if step == -1 else ("n", f"+ {by} *")
            hint = f"write for k in range({many.removesuffix(' - 0')}): and {name} = {first} {sign} k inside"
            raise self._print.refuse(node, f"the numbers of a range with a step are constants: {hint}")
        # Evaluated once, and last.
        limit, bound = "", limits[min(len(limits) - 1, 1)]
        end = self._print.scalar(bound, integer, "the end of a range", alone=True).text
        if not self._fixed(bound):  # Python evaluates the end of a range once
            limit, end = f", {name}_end = {end}", f"{name}_end"
        sign = "<" if step > 0 else ">"
        change = "++" if step == 1 else f" += {step}"
        c_type = C_TYPES[integer.base]
        self._write(
            node, depth, f"for ({c_type} {name} = {start}{limit}; {name} {sign} {end}; {name}{change}) {{"
        )

    def _counted(self, node: ast.For) -> str:
        """Return a loop over a range that replaces another one."""
        element = ast.unparse(node.target)
        match node.iter:
            case ast.Call(func=ast.Name(id="reversed"), args=[ast.Call(args=[end])]):
                return f"for {element} in range({ast.unparse(end)} - 1, -1, -1)"
            case ast.Call(func=ast.Name(id="enumerate"), args=[ast.Name() | ast.Attribute() as array]):
                shape, name = self._print.value(array).kind.shape, ast.unparse(array)
                return f"for k in range({shape[0] if shape else 'n'}): and {name}[k]"
            case ast.Tuple(elts=values) | ast.List(elts=values):
                listed = f"constant({', '.join(map(ast.unparse, values))})"
                return f"for k in range({len(values)}): and TABLE[k], with TABLE = {listed} at the top of the file"
            case ast.Name() | ast.Attribute():
                shape = self._print.value(node.iter).kind.shape
                name = ast.unparse(node.iter)
                return f"for k in range({shape[0] if shape else 'n'}): and {name}[k] for {element}"
        return "for k in range(n): and the elements by their index k"

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


def _target(node: ast.Assign | ast.AugAssign) -> ast.expr:
    return node.targets[0] if isinstance(node, ast.Assign) else node.target


def _returns(body: list[ast.stmt]) -> bool:
    """Return whether a block always ends in a return."""
    last = body[-1] if body else None
    if isinstance(last, ast.If):
        return bool(last.orelse) and _returns(last.body) and _returns(last.orelse)
    return isinstance(last, ast.Return)
