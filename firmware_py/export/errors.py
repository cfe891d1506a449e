"""The exceptions of the exporter, and the collection of all refusals of a user's file."""

import ast
from collections.abc import Iterator
from contextlib import contextmanager

from firmware_py.errors import FirmwareError


class ExportError(FirmwareError):
    """Something cannot become C; the text says where and why, one line for each refusal."""


class CompilerError(ExportError):
    """No C compiler works here, or not with this text."""


class RefusalError(ExportError):
    """A construct outside the subset, as `file:line: reason`."""

    def __init__(self, path: str, line: int, reason: str) -> None:
        super().__init__(f"{path}:{line}: {reason}")
        self.line = line


class FollowUpError(ExportError):
    """Something needs what was refused elsewhere: nothing new for the user."""


class Refusals:
    """The refusals of one file; those of the core end its translation at once (`collecting=False`)."""

    def __init__(self, collecting: bool = False) -> None:
        self.collecting = collecting
        self.found: list[RefusalError] = []

    @contextmanager
    def note(self) -> Iterator[None]:
        """Note what is refused inside and go on behind it."""
        try:
            yield
        except (RefusalError, FollowUpError) as error:
            if not self.collecting:
                raise
            if isinstance(error, RefusalError):
                self.found.append(error)

    def lines(self) -> list[str]:
        """Return the refusals in the order of their lines, each once."""
        return list(dict.fromkeys(str(one) for one in sorted(self.found, key=lambda one: one.line)))


def refusal(path: str, node: ast.AST, reason: str) -> RefusalError:
    """Return the error for a construct outside the subset, as `file:line: reason`."""
    return RefusalError(path, getattr(node, "lineno", 1), reason)
