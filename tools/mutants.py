"""Plant small mistakes in a room, one at a time, and list those that no test of the fast tier catches.

    make mutants ROOM=hil/world [SAMPLE=20]

ROOM is a folder or a file in Python or C. universalmutator plants the mistakes of `mutants.rules` in copies of the working
tree. Each meets the tests of the same path below `tests/`, and one that survives meets those of `make test`. `runs/mutants/`
keeps the results: a mistake that was caught is not planted again until its file changes, so a run that was ended continues.
Exit code 0: all were caught, 1: some survived, 2: nothing was planted, or a test fails without a mistake.
"""

import argparse
import difflib
import hashlib
import os
import queue
import random
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RULES = Path(__file__).resolve().with_name("mutants.rules")
TOOLS = Path(sys.executable).parent
LIMIT_S = 900  # of the tests of one mistake, on a busy machine: an endless loop is caught by it


class File:
    """The mistakes of one source file, and what became of them."""

    def __init__(self, path: Path, root: Path, sample: int) -> None:
        self.name = path.relative_to(root).as_posix()
        self.right = path.read_text(encoding="utf-8").splitlines(keepends=True)
        digest = hashlib.sha256(path.read_bytes() + RULES.read_bytes()).hexdigest()[:12]
        self.folder = root / "runs" / "mutants" / self.name / digest
        if not self.folder.exists():
            making = self.folder.with_name("making")
            shutil.rmtree(making, ignore_errors=True)
            making.mkdir(parents=True)
            unchecked = ["--noCheck"] if path.suffix == ".c" else []
            command = [TOOLS / "mutate", path, "--only", RULES, "--mutantDir", making, *unchecked]
            subprocess.run(command, cwd=making, check=True, stdout=subprocess.DEVNULL)
            making.rename(self.folder)
        mutants = sorted(found.name for found in self.folder.glob(f"{path.stem}.mutant*"))
        self.chosen = random.Random(self.name).sample(mutants, min(sample or len(mutants), len(mutants)))

    def listed(self, fate: str) -> list[str]:
        """Return those of the chosen mistakes that are known as `killed` or `notkilled`."""
        known = (self.folder / f"all.{fate}.txt").read_text().split()
        return [name for name in self.chosen if name in known]

    def judge(self, copy: Path, tests: str) -> None:
        """Run tests with every mistake that is not known to be caught."""
        (self.folder / "all.killed.txt").touch()
        (self.folder / "all.notkilled.txt").write_text("")  # the tests may be better now
        (self.folder / "chosen.txt").write_text("\n".join(self.chosen))
        command = [TOOLS / "analyze_mutants", self.name, tests, "--mutantDir", self.folder, "--resume"]
        command += ["--fromFile", self.folder / "chosen.txt", "--prefix", self.folder / "all"]
        command += ["--timeout", str(LIMIT_S)]
        with subprocess.Popen(list(map(str, command)), cwd=copy, stdout=subprocess.PIPE, text=True) as ran:
            for line in ran.stdout or ():
                if "NOT KILLED" in line or "KILLED IN" in line:
                    caught, survived = len(self.listed("killed")), len(self.listed("notkilled"))
                    print(
                        f"{self.name}: {caught} caught, {survived} survived of {len(self.chosen)}", flush=True
                    )

    def difference(self, mutant: str) -> str:
        """Return the lines that a mistake changes."""
        wrong = (self.folder / mutant).read_text(encoding="utf-8").splitlines(keepends=True)
        lines = list(difflib.unified_diff(self.right, wrong, n=0))[2:]
        return "".join(lines).rstrip()


def files(room: Path, root: Path, sample: int) -> list[File]:
    """Plant the mistakes of a room."""
    paths = [room] if room.is_file() else sorted(room.rglob("*"))
    return [
        File(path, root, sample) for path in paths if path.suffix in (".py", ".c") and path.stat().st_size
    ]


def tests_of(name: str, root: Path) -> str:
    """Return the nearest tests of the same path below `tests/`."""
    place = root / "tests" / name
    near = next(path for path in (place.with_name(f"test_{place.stem}.py"), *place.parents) if path.exists())
    return str(near.relative_to(root))


def copy_of(root: Path, folder: Path) -> Path:
    """Copy all files that git does not ignore into a folder."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.check_output(command, cwd=root, text=True).split("\0"):
        if (root / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, folder / name)
    return folder


class CleanError(Exception):
    """Tests fail without a mistake."""


def judge_all(planted: Sequence[File], root: Path, jobs: int) -> None:
    """Judge files side by side, each in a copy; raises `CleanError`."""
    pytest = f"{shlex.quote(sys.executable)} -m pytest -x -q -p no:cacheprovider"
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(jobs) as pool:
        copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for number in range(jobs):
            copies.put(copy_of(root, Path(folder).resolve() / str(number)))
        for tests in sorted({tests_of(file.name, root) for file in planted}):
            command = f"{pytest} -n {jobs} {shlex.quote(tests)}"
            if subprocess.run(command, shell=True, cwd=Path(folder).resolve() / "0", check=False).returncode:
                raise CleanError(f"{tests}: a test fails without a mistake")

        def judge(file: File) -> None:
            copy = copies.get()
            file.judge(copy, f"{pytest} -n 0 {shlex.quote(tests_of(file.name, root))} && {pytest} -n 0")
            copies.put(copy)

        list(pool.map(judge, planted))


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("room", metavar="ROOM")
    parser.add_argument(
        "--sample", metavar="N", type=int, default=0, help="at most so many mistakes in a file"
    )
    parser.add_argument("--jobs", metavar="N", type=int, default=os.cpu_count() or 1, help="files at a time")
    options = parser.parse_args(arguments)
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    room = root / options.room
    planted = files(room, root, options.sample)
    if not planted:
        print(f"{options.room}: no file in Python or C", file=sys.stderr)
        return 2
    try:
        judge_all(planted, root, options.jobs)
    except CleanError as error:
        print(error, file=sys.stderr)
        return 2
    survived = 0
    for file in planted:
        for mutant in file.listed("notkilled"):
            survived += 1
            print(f"\n{file.name} survived\n{file.difference(mutant)}")
    total = sum(len(file.chosen) for file in planted)
    print(f"\n{options.room}: {total - survived} of {total} caught")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
