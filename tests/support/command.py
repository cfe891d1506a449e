"""The command line, called in this process."""

import sys
from pathlib import Path

import pytest

from hil.commands.app import main


def floaty(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    """Run `floaty` with arguments and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["floaty", *map(str, arguments)])
    with pytest.raises(SystemExit) as left:
        main()
    assert isinstance(left.value.code, int)
    return left.value.code
