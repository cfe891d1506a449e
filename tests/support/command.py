"""The command line, called in this process."""

import sys
from pathlib import Path

import pytest

from hil.commands.app import main
from hil.commands.options import COMPILING


def floaty(*arguments: str | Path) -> int:
    """Run `floaty` with arguments and return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["floaty", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
    assert isinstance(left.value.code, int)
    return left.value.code


class Cli:
    """Call it with the arguments of `floaty`: it returns the exit code and keeps what was printed."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.out = self.err = ""

    def __call__(self, *arguments: str | Path) -> int:
        code = floaty(*arguments)
        self.out, self.err = self._capsys.readouterr()
        return code

    def refusal(self, *arguments: str | Path) -> str:
        """Return the one line in which a command refuses bad input, with exit code 2."""
        assert self(*arguments) == 2, self.out + self.err
        refusal = self.err.removeprefix(f"{COMPILING}\n")  # what is refused late may be the first to compile
        assert refusal.startswith("floaty: ")
        assert refusal.count("\n") == 1
        return refusal
