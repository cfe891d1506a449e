"""The examples of a page of the documentation, run as a reader would: files are written, commands called, code executed."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from support.command import floaty

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"# ([\w./-]+\.\w+)\n")  # a first line that names the file in which the block belongs


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return the examples in their order: (language, text)."""
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def run_examples(page: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the page's examples in the current folder, one after the other; returns the names that they leave behind."""
    names: dict[str, Any] = {}
    monkeypatch.syspath_prepend(str(Path.cwd()))
    for language, text in blocks(page):
        if named := FILE.match(text):
            path = Path(named[1])
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        elif language == "python":
            exec(compile(text, page, "exec"), names)
        elif language == "console":
            for command in re.findall(r"^\$ floaty (.*)$", text, re.MULTILINE):
                assert floaty(monkeypatch, *shlex.split(command)) == 0, command
    return names
