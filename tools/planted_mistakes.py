"""Plant the mistakes of `planted_mistakes.toml` one at a time in a copy of the working tree; report which tests catch them.

    python tools/planted_mistakes.py [--only PATTERN] [--jobs N]

The table lists, by file and by the tests that should fail, rows of a text that occurs once in the file and the wrong text
that replaces it; a row may name other tests. `hangs = true` marks a mistake that makes a loop endless: only then does a
hanging run count as caught. A mistake must compile: a file in Python is compiled, a file in C is built by the function
that `build` names for its folder (`module:function`). A test named with `::` may be a long one. Exit code 0: at least 95
% are caught in every room, 1: fewer, 2: the table or the tests are invalid, and nothing was tested.
"""

import argparse
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")

ROOT = Path(__file__).parent.parent
SHARE_CAUGHT = 0.95
LIMIT_S = 300  # generous: results must not depend on the machine's load
PASSED, FAILED, NOT_COLLECTED = 0, 1, 2  # exit codes of pytest; a failed import counts as caught
ENVIRONMENT = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}  # two mistakes within a second share a time stamp


class TableError(Exception):
    """A row that cannot be planted, or tests that fail without a mistake."""


@dataclass(frozen=True, slots=True)
class Mistake:
    """One row of the table."""

    path: str
    old: str
    new: str
    tests: tuple[str, ...]
    hangs: bool = False
    build: str = ""  # for a file in C

    @property
    def room(self) -> str:
        """The file's room: the first two levels of its folder."""
        return "/".join(Path(self.path).parts[:-1][:2]) or "."

    def __str__(self) -> str:
        return f"{self.path}: {' '.join(self.old.split())} -> {' '.join(self.new.split())}"


def read(table: Path) -> list[Mistake]:
    """Return the rows of a table."""
    rows, files = [], tomllib.loads(table.read_text(encoding="utf-8"))
    builds = files.pop("build", {})
    for path, groups in files.items():
        build = builds.get(Path(path).parent.as_posix(), "")
        for tests, mistakes in groups.items():
            for old, wrong in mistakes.items():
                row = wrong if isinstance(wrong, dict) else {"new": wrong}
                chosen = tuple(row.get("tests", tests).split())
                rows.append(Mistake(path, old, row["new"], chosen, row.get("hangs", False), build))
    return rows


def planted(mistake: Mistake, root: Path) -> str:
    """Return the source of the file with the mistake in it; raises `TableError`."""
    path = root / mistake.path
    if not path.is_file():
        raise TableError(f"{mistake.path}: no such file")
    source = path.read_text(encoding="utf-8")
    if (count := source.count(mistake.old)) != 1:
        raise TableError(f"{mistake.path}: {mistake.old!r} occurs {count} times, not once")
    wrong = source.replace(mistake.old, mistake.new)
    if path.suffix == ".py":
        try:
            compile(wrong, mistake.path, "exec")
        except SyntaxError as error:
            raise TableError(f"{mistake.path}: {mistake.new!r} is no Python: {error.msg}") from error
    elif not mistake.build:
        raise TableError(f"{mistake.path}: `build` names no function for its folder")
    for test in mistake.tests:
        if not (root / test.partition("::")[0]).is_file():
            raise TableError(f"{mistake.path}: no such tests: {test}")
    return wrong


def copy_of(root: Path, folder: Path) -> Path:
    """Copy all files that git does not ignore into a folder."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    for name in listed.split("\0"):
        if (root / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, folder / name)
    return folder


def run_tests(copy: Path, tests: Sequence[str], limit_s: float | None = None) -> int:
    """Run tests in a copy until one fails and return pytest's exit code; raises `subprocess.TimeoutExpired`."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    if all("::" in test for test in tests):
        command += ["-m", "not realtime"]
    return subprocess.run(
        command, cwd=copy, env=ENVIRONMENT, capture_output=True, timeout=limit_s, check=False
    ).returncode


def check_clean(copy: Path, mistakes: Sequence[Mistake]) -> None:
    """Raise `TableError` unless a copy imports its own files and passes the table's tests; compile what they need."""
    for package in sorted({Path(mistake.path).parts[0].removesuffix(".py") for mistake in mistakes}):
        command = [sys.executable, "-c", f"import {package}; print({package}.__file__)"]
        place = subprocess.check_output(command, cwd=copy, env=ENVIRONMENT, text=True).strip()
        assert Path(place).is_relative_to(copy), f"{package} comes from {place}"
    tests = sorted({test for mistake in mistakes for test in mistake.tests})
    for some in ([test for test in tests if "::" in test], [test for test in tests if "::" not in test]):
        if some and (code := run_tests(copy, some)):
            raise TableError(f"without any mistake pytest ends with {code}: {' '.join(some)}")


@contextmanager
def mistaken(mistake: Mistake, wrong: str, copy: Path) -> Iterator[None]:
    """Plant a mistake in a copy, and remove it again."""
    path = copy / mistake.path
    right = path.read_bytes()
    path.write_text(wrong, encoding="utf-8")
    try:
        yield
    finally:
        path.write_bytes(right)


def check_build(mistake: Mistake, wrong: str, copy: Path) -> None:
    """Raise `TableError` unless a file in C builds with the mistake in it."""
    if not mistake.build:
        return
    module, _, function = mistake.build.partition(":")
    folder = copy / "runs" / "build" / function  # it keeps the compiler's cache between mistakes
    folder.mkdir(parents=True, exist_ok=True)
    code = f"from pathlib import Path; from {module} import {function}; {function}(Path({str(folder)!r}))"
    environment = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join((str(copy), str(copy / "tests")))}
    with mistaken(mistake, wrong, copy):
        ran = subprocess.run(
            [sys.executable, "-c", code], cwd=copy, env=environment, capture_output=True, text=True
        )
    if ran.returncode:
        why = next((line for line in ran.stderr.splitlines() if "error: " in line), ran.stderr.strip()[-200:])
        raise TableError(f"{mistake.path}: {mistake.new!r} does not build: {why}")


def fate(mistake: Mistake, wrong: str, copy: Path) -> tuple[bool, str, float]:
    """Plant a mistake in a copy and run its tests; return whether it was caught, a word on how, and the time [s]."""
    start_s = time.monotonic()
    with mistaken(mistake, wrong, copy):
        try:
            caught = run_tests(copy, mistake.tests, LIMIT_S) in (FAILED, NOT_COLLECTED)
            word = "caught" if caught else "SURVIVED"
        except subprocess.TimeoutExpired:
            caught, word = mistake.hangs, "hangs" if mistake.hangs else f"no end in {LIMIT_S} s"
    return caught, word, time.monotonic() - start_s


def plant_all(mistakes: Sequence[Mistake], root: Path, jobs: int) -> list[Mistake]:
    """Plant the mistakes and print each result; return the survivors. Raises `TableError` before the first."""
    wrong = [planted(mistake, root) for mistake in mistakes]
    with tempfile.TemporaryDirectory(prefix="planted-") as folder, ThreadPoolExecutor(jobs) as pool:
        clean = copy_of(root, Path(folder).resolve() / "0")
        print(f"{len(mistakes)} mistakes; first the tests without any ...", flush=True)
        check_clean(clean, mistakes)
        copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
        copies.put(clean)
        for number in range(1, jobs):
            copies.put(shutil.copytree(clean, clean.with_name(str(number))))

        def on_a_copy(work: Callable[[Mistake, str, Path], Result], mistake: Mistake, wrong: str) -> Result:
            copy = copies.get()
            try:
                return work(mistake, wrong, copy)
            finally:
                copies.put(copy)

        list(pool.map(partial(on_a_copy, check_build), mistakes, wrong))  # raises if one does not build
        runs = {pool.submit(on_a_copy, fate, *both): both[0] for both in zip(mistakes, wrong, strict=True)}
        survivors = []
        for number, run in enumerate(as_completed(runs), 1):
            caught, word, duration_s = run.result()
            if not caught:
                survivors.append(runs[run])
            print(f"{number:3}/{len(runs)} {word:8} {duration_s:4.0f} s  {runs[run]}", flush=True)
    return survivors


def by_room(mistakes: Sequence[Mistake], survivors: Sequence[Mistake]) -> list[tuple[str, int, int]]:
    """Return every room with its numbers of caught and of all mistakes."""
    planted_in, survived_in = (Counter(mistake.room for mistake in some) for some in (mistakes, survivors))
    return [(room, count - survived_in[room], count) for room, count in sorted(planted_in.items())]


def main(arguments: Sequence[str], root: Path = ROOT, table: Path | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", metavar="PATTERN", default="", help="rows whose `path: old -> new` matches")
    parser.add_argument("--jobs", metavar="N", type=int, default=1, help="copies at work at a time")
    options = parser.parse_args(arguments)
    try:
        rows = read(table or root / "tools" / "planted_mistakes.toml")
        mistakes = [mistake for mistake in rows if re.search(options.only, str(mistake))]
        if not mistakes:
            raise TableError(f"--only {options.only}: none of {len(rows)} rows")
        survivors = plant_all(mistakes, root, options.jobs)
    except TableError as error:
        print(error, file=sys.stderr)
        return 2
    all_rooms = True
    for room, caught, count in by_room(mistakes, survivors):
        print(f"{room:28} {caught:3} of {count:3} caught")
        all_rooms &= caught >= SHARE_CAUGHT * count
    share = 1.0 - len(survivors) / len(mistakes)
    print(f"{len(mistakes) - len(survivors)} of {len(mistakes)} caught, {100 * share:.1f} %", end="")
    print("; survived:" if survivors else "", *survivors, sep="\n  " if survivors else "\n", end="\n")
    return 0 if all_rooms else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
