"""The examples of a page of the documentation, run as a reader does: files written, commands typed, code executed.

What a `console` block shows below a command is compared with what the command prints: its words and numbers, but not its
frames and widths, nor what the machine's speed and the C compiler make of it. A line `…` stands for any lines, and `…`
within a line for anything. Nothing shown: nothing printed is compared.
"""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"# ([\w./-]+\.\w+)\n")  # a first line that names the file in which the block belongs
FRAME = re.compile(r"^[\s━─═┏┓┗┛┡┩└┘┳┻╇┴┬╋┼]*$")
SPEED = re.compile(r"\d[\d.]*(?= times real time| s from start to end| ?s\b.* ===$)")
COMPILED = re.compile(
    r"\d[\d.]*(?=.* instructions)|(?<=instructions).*"
)  # how long the compiler's code takes
NOTICE = "first run on this machine"  # it stands where nothing is in the caches yet
TIMEOUT_S = 500


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return the examples in their order: (language, text)."""
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def commands_of(block: str) -> list[tuple[str, str]]:
    """Return what stands behind each `$` of a console block, without its comment, and the output below it."""
    parts = re.split(r"^\$ (.*)\n", block, flags=re.MULTILINE)[1:]
    return [
        (re.sub(r"\s+#\s.*$", "", command), output)
        for command, output in zip(parts[::2], parts[1::2], strict=True)
    ]


def shape_of(text: str) -> list[str]:
    """Return the lines of an output without its frames and widths, and without the numbers of this machine."""
    lines = []
    for line in text.splitlines():
        if FRAME.match(line) or line.startswith(NOTICE):
            continue
        line = re.sub("={3,}", "===", line.replace("┃", "│"))
        lines.append(COMPILED.sub("#", SPEED.sub("#", " ".join(line.split()))))
    return lines


def matches(shown: str, printed: str) -> bool:
    lines = [
        r"(?:[^\n]*\n)*?" if line == "…" else ".*".join(map(re.escape, line.split("…"))) + r"\n"
        for line in shape_of(shown)
    ]
    return re.fullmatch("".join(lines), "".join(f"{line}\n" for line in shape_of(printed))) is not None


def run_examples(
    page: Path, monkeypatch: pytest.MonkeyPatch, skip: Callable[[str], str] = lambda command: ""
) -> dict[str, Any]:
    """Run the page's examples in the current folder, one after the other; returns the names that they leave behind.

    `skip` says of a command why it is not run; empty: it is.
    """
    names: dict[str, Any] = {}
    monkeypatch.syspath_prepend(str(Path.cwd()))
    for language, text in blocks(page):
        if named := FILE.match(text):
            path = Path(named[1])
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        elif language == "python" and not text.startswith(" "):  # an indented one is part of something
            exec(compile(text, page, "exec"), names)
        elif language == "console":
            for command, shown in commands_of(text):
                if not skip(command):
                    run_command(command, shown, monkeypatch)
    return names


def run_command(command: str, shown: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run one command in bash and compare what it prints."""
    if command.startswith("cd "):
        monkeypatch.chdir(command.removeprefix("cd ").strip())
        return
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    ran = subprocess.run(
        ["bash", "-c", command],
        env={**os.environ, "PATH": path, "COLUMNS": "160", "TERM": "dumb"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert ran.returncode == 0, f"{command}: exit code {ran.returncode}\n{ran.stdout[-2000:]}"
    assert not shown or matches(shown, ran.stdout), f"{command}: shown\n{shown}\nprinted\n{ran.stdout}"
