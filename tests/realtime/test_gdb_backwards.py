"""Time that runs backwards under GDB: the commands of docs/howto/debug.md, and what remains of a flight's processes."""

import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from support import stm32_firmware
from support.paths import ROOT
from support.serving import FLOATY

GDB = "gdb-multiarch"
PAGE = (ROOT / "docs" / "howto" / "debug.md").read_text(encoding="utf-8")
PLANTED_TICK = 4600  # 1.5 s of the laboratory's time


@pytest.fixture(autouse=True)
def installed() -> None:
    if shutil.which(GDB) is None:
        pytest.skip(f"{GDB} is not installed: apt-get install {GDB}")


def planted(how: str) -> Path:
    return stm32_firmware.build("gcc", ("-g", f"-DPLANTED={how}", f"-DPLANTED_TICK={PLANTED_TICK}"))


@contextmanager
def waiting(*command: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a command; yield its process and the address at which it waits for GDB."""
    process = subprocess.Popen([*FLOATY, *command], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = next(line for line in process.stdout if line.startswith("waiting for "))
        yield process, line.rpartition(" ")[2].rstrip("'\n")
    finally:
        process.kill()
        process.communicate()


def gdb(address: str, elf: Path, *commands: str) -> subprocess.Popen[str]:
    every = ("set confirm off", "set remotetimeout 60", f"target remote {address}", *commands)
    words = [word for command in every for word in ("-ex", command)]
    return subprocess.Popen(
        (GDB, "-nx", "-batch", *words, str(elf)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def commands_after(words: str) -> list[str]:
    block = PAGE.partition(f"**{words}")[2].partition("```text\n")[2].partition("```")[0]
    return [line.removeprefix("(gdb) ") for line in block.splitlines()]


@pytest.mark.parametrize(
    ("words", "how", "expected"),
    [
        ("A call of a null pointer", "NULL_CALL", r"#0 .* go_wrong .*\n(.*\n)*#1 .* report "),
        ("A wild write", "WILD_WRITE", r"New value = .*<nothing>\n(.*\n)*#0  store \(.*\n#1 .* go_wrong "),
        ("An endless loop", "HANG", r"go_wrong .*\n.*hang\(\);\n#0 .* go_wrong .*\n#1 .* report "),
    ],
)
def test_the_page_s_commands_find_what_was_planted(
    tmp_path: Path, words: str, how: str, expected: str
) -> None:
    elf, flown = planted(how), tmp_path / "flown"
    command = [*FLOATY, "fly", "hover", "--duration", "1", "--board", str(elf), "--out", str(flown)]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, timeout=120).returncode == 1
    commands = commands_after(words)
    assert 0 < len(commands) <= 5
    at = ("--at", "1.6", "--before", "0.6", "--port", "0")
    with waiting("debug", str(flown), *at) as (flight, address):
        printed, _ = gdb(address, elf, *commands, "detach").communicate(timeout=120)
        ended, _ = flight.communicate(timeout=120)
    assert re.search(expected, printed), printed
    assert "the same flight" in ended, ended
    assert flight.returncode == 1
    first, second = (
        json.loads((path / "result.json").read_text()) for path in (flown, tmp_path / "flown-debug")
    )
    assert first["hash"] == second["hash"]


def processes_of(folder: Path) -> list[int]:
    """Return the processes whose command line names a folder."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            if (
                os.fsencode(folder) in (place / "cmdline").read_bytes()
                and b"Z" not in (place / "stat").read_bytes()
            ):
                found.append(int(place.name))
        except OSError:
            continue
    return found


@pytest.mark.parametrize("how", ["kill", "ctrl-c", "detach", "gdb is killed"])
def test_no_process_outlives_the_flight(tmp_path: Path, how: str) -> None:
    elf, out = stm32_firmware.build("gcc"), tmp_path / "flown"
    command = ("fly", "hover", "--duration", "0.5", "--board", str(elf), "--gdb", "0", "--out", str(out))
    back = ("break send_line", "continue 30", "reverse-continue")
    end = (
        ("detach",)
        if how == "detach"
        else ("delete", "watch nobody", "shell touch " + str(tmp_path / "there"), "continue")
    )
    with waiting(*command) as (flight, address):
        debugger = gdb(address, elf, *back, *end)
        if how == "detach":
            debugger.communicate(timeout=60)
        else:
            while not (tmp_path / "there").exists():
                assert debugger.poll() is None
            assert len(processes_of(out)) >= 3  # the first, the flying one, a checkpoint
            if how == "gdb is killed":
                debugger.kill()
            else:
                flight.send_signal(signal.SIGKILL if how == "kill" else signal.SIGINT)
        flight.communicate(timeout=60)  # its end, and that of all who have its standard output
        debugger.kill()
        debugger.communicate()
    assert flight.returncode == {"kill": -signal.SIGKILL, "ctrl-c": 130}.get(how, 1)
    assert processes_of(out) == []


def test_what_is_counted_goes_back_with_time(tmp_path: Path) -> None:
    elf = stm32_firmware.build("gcc")
    there_and_back = (
        "break send_line", "continue 30", "reverse-stepi", "reverse-step", "next", "reverse-continue",
        "continue", "delete", "detach",
    )  # fmt: skip

    def fly(name: str) -> list[str]:
        counted = ("--coverage", str(tmp_path / name), "--profile-cpu", str(tmp_path / name))
        return [
            "fly",
            "hover",
            "--duration",
            "0.5",
            "--board",
            str(elf),
            "--out",
            str(tmp_path / f"{name}-run"),
            *counted,
        ]

    subprocess.run([*FLOATY, *fly("forward")], cwd=ROOT, capture_output=True, timeout=120)
    with waiting(*fly("back"), "--gdb", "0") as (flight, address):
        printed, _ = gdb(address, elf, *there_and_back).communicate(timeout=120)
        flight.communicate(timeout=120)
    assert printed.count("hit Breakpoint") > 1, printed
    for ending in (".info", ".folded", ".txt"):
        first, second = ((tmp_path / f"{name}{ending}").read_text() for name in ("forward", "back"))
        assert first == second
