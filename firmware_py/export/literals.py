"""Numbers and constant arrays of the core's source as C literals with exact values."""

import ast
from collections.abc import Sequence

import numpy as np

from firmware_py.export.errors import refusal
from firmware_py.export.syntax import F32, I32, ValueType


def constant_literal(node: ast.expr) -> tuple[ValueType, str] | None:
    """Return type and C literal of `f32(number)`, `i32(integer)` or an integer; None for anything else."""
    match node:
        case ast.Call(func=ast.Name(id="f32"), args=[argument], keywords=[]):
            value = _float(_number(argument))
            return None if value is None else (F32, float_literal(value))
        case ast.Call(func=ast.Name(id="i32"), args=[argument], keywords=[]):
            node = argument
    number = _number(node)
    if isinstance(number, int) and -(2**31) < number < 2**31:
        return I32, str(number)
    return None


def array_literal(path: str, node: ast.Call, name: str, rows: Sequence[ast.expr]) -> tuple[ValueType, str]:
    """Return type and C literal of `constant(number, ..)` or `constant((number, ..), ..)`, one tuple for each row.

    Raises `ExportError` with the line of a number that is not finite, or of a row of another length.
    """
    matrix = bool(rows) and all(isinstance(row, ast.Tuple) for row in rows)
    lines = [row.elts if isinstance(row, ast.Tuple) and matrix else [row] for row in rows]
    for line, row in zip(lines, rows, strict=True):
        if len(line) != len(lines[0]):
            raise refusal(
                path,
                row,
                f"{name}: a row of {len(line)} numbers; the first has {len(lines[0])}: write as many",
            )
    if not lines or not lines[0]:
        raise refusal(path, node, f"{name}: an array without numbers: write constant(0.5, 1.0)")
    texts = [[_float_element(path, name, element) for element in line] for line in lines]
    if not matrix:
        return ValueType("f32", 1, (len(lines),)), f"{{{', '.join(line[0] for line in texts)}}}"
    text = ", ".join(f"{{{', '.join(line)}}}" for line in texts)
    return ValueType("f32", 2, (len(lines), len(lines[0]))), f"{{{text}}}"


def _float_element(path: str, name: str, node: ast.expr) -> str:
    number = _number(node)
    value = _float(number)
    if value is None:
        what = "is no number" if number is None else "is no finite float32"
        raise refusal(path, node, f"{name}: {ast.unparse(node)} {what}: write one there")
    return float_literal(value)


def float_literal(value: float | np.float32) -> str:
    """Return the shortest decimal that every correct compiler reads as exactly this float32."""
    text = str(np.float32(value))
    return f"{text if '.' in text or 'e' in text else text + '.0'}f"


def literal(value: np.float32 | np.int32) -> str:
    """Return the C literal of a number."""
    return float_literal(value) if isinstance(value, np.float32) else str(value)


def _float(number: float | None) -> np.float32 | None:
    """Return a number as float32, None if it is not finite."""
    if number is None:
        return None
    with np.errstate(over="ignore"):
        value = np.float32(number)
    return value if np.isfinite(value) else None


def _number(node: ast.expr) -> int | float | None:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
            return -value
    return None
