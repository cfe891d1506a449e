"""Replacements for what the flight core's subset of Python does not have, in the words of its users."""

import ast
import difflib
from collections.abc import Iterable, Mapping

from firmware_py.core import guard, maths, structs, subset
from firmware_py.export.syntax import BOOL, F32, I32, ValueType

HOLE = "?"  # a name that stands for a refused expression
_MATHS = "from firmware_py.core.maths"
_NONE = "there is none: put it together from + - * / and sqrt, as firmware_py/core/maths.py does"
_LOOP = "a loop over range(..)"
_FIELD = "a field Annotated[F32s, n] of the memory struct, or constant(..) at the top of the file"
_ROUND = "i32(x), which cuts off towards zero; add f32(0.5) before for the nearest of numbers above zero"
_COUNTED = "for k in range(n): and the elements by their index k"
FUNCTIONS: Mapping[str, str] = {  # of numpy and math, and of Python itself
    **dict.fromkeys(("abs", "absolute", "fabs"), "abs(x)"),
    "sqrt": "sqrt(x), from firmware_py.core.subset",
    "sin": f"sin(x), {_MATHS}",
    "cos": f"cos(x), {_MATHS}",
    **dict.fromkeys(("arctan2", "atan2"), f"atan2(y, x), {_MATHS}"),
    **dict.fromkeys(("arctan", "atan"), f"atan2(x, ONE), {_MATHS}"),
    **dict.fromkeys(("arcsin", "asin"), f"asin(x), {_MATHS}"),
    "tanh": f"tanh(x), {_MATHS}",
    "clip": f"clamp(x, low, high), {_MATHS}",
    "pi": f"PI, {_MATHS}",
    **dict.fromkeys(("isfinite", "isnan", "isinf"), f"finite(x), {_MATHS}"),
    **dict.fromkeys(("float32", "float64", "float"), "f32(x)"),
    **dict.fromkeys(("int32", "int64", "int"), "i32(x)"),
    **dict.fromkeys(("minimum", "min"), "min(a, b) of two numbers of one type"),
    **dict.fromkeys(("maximum", "max"), "max(a, b) of two numbers of one type"),
    **dict.fromkeys(("sign", "copysign", "where"), "an if"),
    **dict.fromkeys(("dot", "matmul", "inner", "sum", "mean", "cumsum", "any", "all"), _LOOP),
    **dict.fromkeys(("zeros", "ones", "empty", "array", "asarray", "full", "copy", "list", "tuple"), _FIELD),
    **dict.fromkeys(("power", "pow", "square"), "x * x"),
    **dict.fromkeys(("exp", "log", "tan", "hypot", "arccos", "acos"), _NONE),
    **dict.fromkeys(("round", "floor", "ceil", "trunc", "rint"), _ROUND),
    **dict.fromkeys(("enumerate", "zip", "reversed", "sorted"), _COUNTED),
    "len": "its size as a number",
    "range": "it in a for only",
    **dict.fromkeys(("isinstance", "type", "getattr", "setattr", "hasattr"), "the field's name itself"),
    "print": "a field of the memory struct marked Logged(unit)",
}
GUARDED: Mapping[str, str] = {  # what the user's own logic may not call, by its name in C
    "controller_allocate": "allocate, from firmware_py.core.guard: it does not make a number of NaN"
}
_OWN_LINE = "an assignment on a line of its own"
CONSTRUCTS: Mapping[str, str] = {
    "AnnAssign": "x = value, without the type",
    "IfExp": "an if on lines of its own",
    **dict.fromkeys(("While", "AsyncFor", "MatMult", "Slice"), _LOOP),
    **dict.fromkeys(("ListComp", "SetComp", "DictComp", "GeneratorExp"), _LOOP),
    "Starred": "the arguments one by one",
    **dict.fromkeys(("Tuple", "Assign"), "one assignment for each value"),
    **dict.fromkeys(("List", "Dict", "Set"), _FIELD),
    **dict.fromkeys(("Assert", "Raise", "Try", "TryStar"), "an if"),
    **dict.fromkeys(("With", "AsyncWith"), "its lines without it"),
    **dict.fromkeys(("Global", "Nonlocal", "Yield", "YieldFrom"), "a field of the memory struct"),
    **dict.fromkeys(("Lambda", "FunctionDef", "AsyncFunctionDef"), "a @kernel of its own, above this one"),
    "ClassDef": "a Struct at the top of the file",
    **dict.fromkeys(("Import", "ImportFrom"), "it at the top of the file"),
    "JoinedStr": FUNCTIONS["print"],
    "NamedExpr": _OWN_LINE,
    "Match": "if and elif",
    **dict.fromkeys(("Delete", "Await", "Expr"), "nothing"),
    "else": "its lines behind the loop",
    "keywords": "the arguments in their order, without names",
}
WORDS: Mapping[str, str] = {  # what users call the parts of Python's syntax
    "AnnAssign": "type of a local",
    "Assert": "assert",
    "Assign": "several values in one assignment",
    "AsyncFor": "async for",
    "AsyncWith": "async with",
    "Await": "await",
    "ClassDef": "class inside a function",
    "Delete": "del",
    "Dict": "dict {..}",
    "DictComp": "dict comprehension",
    "Expr": "value that is not used",
    **dict.fromkeys(("FunctionDef", "AsyncFunctionDef"), "function inside a function"),
    "GeneratorExp": "generator expression",
    "Global": "global",
    "IfExp": "a if .. else b",
    **dict.fromkeys(("Import", "ImportFrom"), "import inside a function"),
    "JoinedStr": "f-string",
    "Lambda": "lambda",
    "List": "list [..]",
    "ListComp": "list comprehension",
    "Match": "match",
    "NamedExpr": "assignment with :=",
    "Nonlocal": "nonlocal",
    "Raise": "raise",
    "Set": "set {..}",
    "SetComp": "set comprehension",
    "Starred": "* before an argument",
    **dict.fromkeys(("Try", "TryStar"), "try"),
    "Tuple": "tuple (.., ..)",
    "TypeAlias": "type",
    "While": "while",
    "With": "with",
    **dict.fromkeys(("Yield", "YieldFrom"), "yield"),
    "For": "for",
    "If": "if",
    "AugAssign": "assignment",
}
SIGNS: Mapping[str, str] = {
    "Add": "+", "Sub": "-", "Mult": "*", "Div": "/", "FloorDiv": "//", "Mod": "%", "Pow": "**", "MatMult": "@",
    "LShift": "<<", "RShift": ">>", "BitOr": "|", "BitAnd": "&", "BitXor": "^",
    "Invert": "~", "Not": "not", "USub": "-", "UAdd": "+",
}  # fmt: skip
# The constructs of a kernel; the printer checks how they are used.
KNOWN = (
    ast.Assign, ast.AugAssign, ast.Expr, ast.Return, ast.If, ast.For, ast.Break, ast.Continue, ast.Pass,
    ast.Name, ast.Constant, ast.Attribute, ast.Subscript, ast.Slice, ast.Tuple,
    ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.Call,
)  # fmt: skip
TYPES: Mapping[str, str] = {  # of fields, arguments and results
    "int": "i32",
    "float": "f32",
    "bool": "i32, with 0 or 1",
    "f64": "f32",
    "i64": "i32",
    "Annotated": "Annotated[F32s, n] with its size",
    **dict.fromkeys(
        ("F32s", "list", "tuple", "NDArray", "ndarray", "F64s"), "Annotated[F32s, n] with its size"
    ),
    **dict.fromkeys(("I32s", "I64s"), "Annotated[I32s, n] with its size"),
}
ENUMS = ("enum", "Enum", "IntEnum", "IntFlag", "Flag")
HOMES: Mapping[str, str] = {
    name: module.__name__
    for module in (guard, structs, maths, subset)
    for name in vars(module)
    if not name.startswith("_") and name not in ("np", "Any", "Annotated")
}
CONSTANT_FORM = "f32(number), a 32-bit integer and constant(numbers)"


def instead(table: Mapping[str, str], name: str) -> str:
    """Return ": write ..." for a name that the table has, else nothing."""
    if name not in table:
        return ""
    return f": {table[name]}" if table[name] is _NONE else f": write {table[name]}"


def word(node: ast.AST) -> str:
    """Return what users call a construct."""
    return WORDS.get(type(node).__name__, ast.unparse(node).partition("\n")[0])


def nearest(name: str, known: Iterable[str], before: str = "") -> str:
    """Return the repair, ": write ...", with the nearest known name or all of them; `before` is a prefix like "own."."""
    names = [one for one in known if one != name and one.isidentifier()]
    home = HOMES.get(name)
    if home and not before:
        return f": write from {home} import {name} at the top of the file"
    near = difflib.get_close_matches(name, names, 1, 0.6)
    if near:
        return f": write {before}{near[0]}"
    return f": there are {', '.join(names[:12]) or 'none'}" if before else ""


def converted(node: ast.expr, have: ValueType, want: ValueType) -> str:
    """Return ": write ..." for a value of another type than the wanted one, nothing where there is no conversion."""
    text = ast.unparse(node)
    if want == BOOL and have in (F32, I32):
        return f": write {text} != {'0' if have == I32 else 'f32(0.0)'}"
    if {have, want} == {F32, I32}:
        return f": write {'f32' if want == F32 else 'i32'}({text})"
    if isinstance(node, ast.Constant) and have == BOOL:
        return f": write {int(bool(node.value))}" if want == I32 else f": write f32({int(bool(node.value))})"
    return ": write an if that sets a number" if have == BOOL and want in (F32, I32) else ""


def mixed(left: ast.expr, right: ast.expr, kinds: tuple[ValueType, ValueType]) -> str:
    """Return the hint for a float that meets an integer, else nothing."""
    if kinds not in ((F32, I32), (I32, F32)):
        return ""
    return f": write f32({ast.unparse(left if kinds[0] == I32 else right)})"


def comparison(node: ast.Compare) -> str:
    """Return the replacement of comparisons in a chain, with `in`, or with `is`."""
    left, parts = node.left, []
    for sign, right in zip(node.ops, node.comparators, strict=True):
        one, other = ast.unparse(left), ast.unparse(right)
        values = (
            [ast.unparse(value) for value in right.elts]
            if isinstance(right, ast.Tuple | ast.List)
            else [other]
        )
        match sign:
            case ast.In():
                parts.append(" or ".join(f"{one} == {value}" for value in values))
            case ast.NotIn():
                parts.append(" and ".join(f"{one} != {value}" for value in values))
            case ast.Is() | ast.IsNot() if other == "None":
                parts.append(f"{one} != 0 or the like: every number has a value")
            case ast.Is() | ast.IsNot():
                parts.append(f"{one} {'==' if isinstance(sign, ast.Is) else '!='} {other}")
            case _:
                parts.append(ast.unparse(ast.Compare(left, [sign], [right])))
        left = right
    return " and ".join(parts)


def operator(node: ast.BinOp, kind: ValueType) -> str:
    """Return the replacement for an operator that numbers of a type do not have."""
    left, right = ast.unparse(node.left), ast.unparse(node.right)
    match node.op:
        case ast.Div():
            return f": write f32({left}) / f32({right}), or {left} // {right}, which rounds down"
        case ast.Pow():
            base = left if isinstance(node.left, ast.Name | ast.Attribute) else "x"
            cube = isinstance(node.right, ast.Constant | ast.Call) and "3" in right
            return f": write {base} * {base}{f' * {base}' if cube else ''}"
        case ast.FloorDiv():
            return f": write i32({left} / {right})"
        case ast.Mod():
            return f": write {left} - {right} * f32(i32({left} / {right}))"
        case ast.LShift() | ast.RShift():
            return f": write {left} {'*' if isinstance(node.op, ast.LShift) else '//'} 2 for each bit"
        case ast.BitAnd() | ast.BitOr() | ast.BitXor() if kind == BOOL:
            return f": write {left} {'and' if isinstance(node.op, ast.BitAnd) else 'or'} {right}"
        case ast.BitAnd():
            return f": write {left} % 2 for the lowest bit, or an i32 field for each flag"
        case ast.BitOr() | ast.BitXor():
            return ": write an i32 field for each flag"
    return instead(CONSTRUCTS, type(node.op).__name__)


def constant(name: str, node: ast.expr) -> str:
    """Return the replacement for the value of a constant at the top of a file."""
    match node:
        case ast.Tuple(elts=parts) | ast.List(elts=parts) if parts:
            listed = ", ".join(ast.unparse(_as_tuple(part)) for part in parts)
            return f": write {name} = constant({listed})"
        case ast.Dict():
            return f": write {name}_A = f32(0.5), one constant for each entry"
        case ast.Constant(value=float() as value):
            return f": write {name} = f32({value})"
        case ast.Constant(value=bool() as value):
            return f": write {name} = {int(value)}"
        case ast.Constant(value=str()):
            return f": write {name} = 0, one number for each text"
        case ast.Call(func=ast.Name(id="float" | "int" as cast), args=[value]):
            return f": write {name} = {'f32' if cast == 'float' else 'i32'}({ast.unparse(value)})"
    return f": write the number itself, as {name} = f32(0.5)"


def _as_tuple(node: ast.expr) -> ast.expr:
    return ast.Tuple(node.elts, ast.Load()) if isinstance(node, ast.List) else node


def enumeration(node: ast.ClassDef) -> str:
    """Return the constants that replace an enumeration."""
    names = [
        target.id
        for line in node.body
        if isinstance(line, ast.Assign)
        for target in line.targets
        if isinstance(target, ast.Name)
    ]
    first = f"{node.name}_{names[0]}".upper() if names else "MODE_A"
    return f": write {first} = 0, one constant for each name"


def not_imported(tree: ast.Module) -> list[ast.Name]:
    """Return the first use of each name of the subset that a file uses and does not import."""
    known = {
        alias.asname or alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    known |= {
        part.id for part in ast.walk(tree) if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)
    }
    known |= {node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    uses = [part for part in ast.walk(tree) if isinstance(part, ast.Name) and part.id not in known]
    found = {part.id: part for part in sorted(uses, key=lambda part: part.lineno, reverse=True)}
    return [part for name, part in found.items() if name == "Annotated" or HOMES.get(name) == subset.__name__]


def imported(node: ast.ImportFrom) -> str:
    """Return what to write instead of an import from this module."""
    if node.module in ENUMS:
        return ": write MODE_A = 0, one constant for each name"
    if node.module == "dataclasses":
        return ": write class Name(Struct), with fields as x: f32"
    if node.module == "__future__":
        return ": leave it out"
    return ": leave it out; a file may import from firmware_py.core and typing only"
