"""Replacements for what the flight core's subset of Python does not have."""

import ast
from collections.abc import Mapping

_MATHS = "from firmware_py.core.maths"
_NONE = "there is none: put it together from + - * / and sqrt, as firmware_py/core/maths.py does"
_LOOP = "a loop over range(..)"
_FIELD = "a field Annotated[F32s, n] of the memory struct, or constant(..) at the top of the file"
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
    **dict.fromkeys(("minimum", "maximum", "min", "max", "sign", "copysign", "where"), "an if"),
    **dict.fromkeys(("dot", "matmul", "inner", "sum", "mean", "cumsum"), _LOOP),
    **dict.fromkeys(("zeros", "ones", "empty", "array", "asarray", "full", "copy"), _FIELD),
    **dict.fromkeys(("power", "pow", "square"), "x * x"),
    **dict.fromkeys(("exp", "log", "tan", "hypot"), _NONE),
    "print": "a field of the memory struct marked Logged(unit)",
}
OUTSIDE = ("numpy", "math")  # modules whose functions have equivalents in the core
GUARDED: Mapping[str, str] = {  # what the user's own logic may not call, by its name in C
    "controller_allocate": "allocate, from firmware_py.core.guard: it does not make a number of NaN"
}
_OWN_LINE = "an assignment on a line of its own"
CONSTRUCTS: Mapping[str, str] = {
    "AugAssign": "x = x + y",
    "AnnAssign": "x = value",
    "IfExp": "an if on lines of its own",
    "Pow": "x * x",
    **dict.fromkeys(("While", "AsyncFor", "MatMult", "Slice"), _LOOP),
    **dict.fromkeys(("ListComp", "SetComp", "DictComp", "GeneratorExp"), _LOOP),
    "Starred": "the arguments one by one",
    **dict.fromkeys(("Tuple", "Assign"), "one assignment for each value"),
    **dict.fromkeys(("List", "Dict", "Set"), _FIELD),
    **dict.fromkeys(("Assert", "Raise", "Try", "TryStar", "Break", "Continue"), "an if"),
    **dict.fromkeys(("With", "AsyncWith"), "its lines without it"),
    **dict.fromkeys(("Global", "Nonlocal", "Yield", "YieldFrom"), "a field of the memory struct"),
    **dict.fromkeys(("Lambda", "FunctionDef", "AsyncFunctionDef"), "a @kernel of its own, above this one"),
    "ClassDef": "a Struct at the top of the file",
    "ImportFrom": "it at the top of the file",
    "JoinedStr": FUNCTIONS["print"],
    "NamedExpr": _OWN_LINE,
    "Match": "if and elif",
    "Pass": "nothing, or return",
    **dict.fromkeys(("Delete", "Await"), "nothing"),
    "Compare": "a < b and b < c",
    "Is": "==",
    "IsNot": "!=",
    **dict.fromkeys(("In", "NotIn"), "== for each value"),
    "else": "its lines behind the loop",
    "f32 and i32": "f32(..) around the integer",
    "f32 for bool": "a comparison, as x != ZERO",
    "keywords": "the arguments in their order, without names",
}
WORDS: Mapping[str, str] = {  # constructs whose usual name differs from Python's
    "ListComp": "list comprehension",
    "SetComp": "set comprehension",
    "DictComp": "dict comprehension",
    "GeneratorExp": "generator expression",
    "Lambda": "lambda",
    "Starred": "* before an argument",
    **dict.fromkeys(("FunctionDef", "AsyncFunctionDef"), "function inside a function"),
    "ClassDef": "class inside a function",
    "ImportFrom": "import inside a function",
    "JoinedStr": "f-string",
    "NamedExpr": "assignment with := ",
    **dict.fromkeys(("Yield", "YieldFrom"), "yield"),
    "Await": "await",
}
# The constructs of a kernel; the printer checks how they are used.
KNOWN = (
    ast.Assign, ast.Expr, ast.Return, ast.If, ast.For,
    ast.Name, ast.Constant, ast.Attribute, ast.Subscript, ast.Slice, ast.Tuple,
    ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.Call,
)  # fmt: skip


def instead(table: Mapping[str, str], name: str) -> str:
    """Return ": write ..." for a name that the table has, else nothing."""
    if name not in table:
        return ""
    return f": {table[name]}" if table[name] is _NONE else f": write {table[name]}"


def first_use(tree: ast.Module | ast.FunctionDef, node: ast.Import | ast.ImportFrom) -> tuple[ast.AST, str]:
    """Return where a module or function first uses what it imports from outside, and what to write there."""
    names = {
        alias.asname or alias.name.partition(".")[0]: "" if isinstance(node, ast.Import) else alias.name
        for alias in node.names
    }
    uses: list[ast.Attribute | ast.Name] = [
        part
        for part in ast.walk(tree)
        if (isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name) and part.value.id in names)
        or (isinstance(part, ast.Name) and names.get(part.id))
    ]
    if not uses:
        return node, f"{ast.unparse(node)} is outside the subset, and not used: leave it out"
    first = min(uses, key=lambda use: (use.lineno, use.col_offset))
    name = first.attr if isinstance(first, ast.Attribute) else names[first.id]
    return first, f"{ast.unparse(first)} is outside the subset{instead(FUNCTIONS, name)}"


def outside_subset(function: ast.FunctionDef) -> tuple[ast.AST, str] | None:
    """Return the first construct of a kernel's body that the subset lacks, and its replacement."""
    parts = [
        part for line in function.body for part in ast.walk(line) if isinstance(part, ast.stmt | ast.expr)
    ]
    unknown = [part for part in parts if not isinstance(part, KNOWN)]
    if not unknown:
        return None
    first = min(unknown, key=lambda part: (part.lineno, part.col_offset))
    if isinstance(first, ast.Import) or (isinstance(first, ast.ImportFrom) and first.module in OUTSIDE):
        return first_use(function, first)
    name = type(first).__name__
    word = WORDS.get(name) or f"{name} {'statement' if isinstance(first, ast.stmt) else 'expression'}"
    return first, f"{word}{instead(CONSTRUCTS, name)}"
