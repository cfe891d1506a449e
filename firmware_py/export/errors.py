"""The exceptions of the exporter."""

import ast

from firmware_py.errors import FirmwareError


class ExportError(FirmwareError):
    """Something cannot become C; the text says where and why."""


class CompilerError(ExportError):
    """No C compiler works here, or not with this text."""


def refusal(path: str, node: ast.AST, reason: str) -> ExportError:
    """Return the error for a construct outside the subset, as `file:line: reason`."""
    return ExportError(f"{path}:{getattr(node, 'lineno', 1)}: {reason}")
