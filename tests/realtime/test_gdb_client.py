"""GDB itself, Debian's `gdb-multiarch`, at the server of `--gdb`."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.emulator.stm32f405.gdb import GdbServer
from hil.emulator.stm32f405.image import Image
from support import stm32_firmware
from support.paths import ROOT
from support.serving import FLOATY
from support.stm32_machine import FirmwareOnChip

GDB = "gdb-multiarch"
ASSERTION = 3  # of `enum planted`


@pytest.fixture(autouse=True)
def installed() -> None:
    if shutil.which(GDB) is None:
        pytest.skip(f"{GDB} is not installed: apt-get install {GDB}")


def debugged(run: Callable[[GdbServer], object], image: Image, *commands: str) -> list[str]:
    """Return what GDB prints when it gives these commands and leaves; `run` runs a machine for it meanwhile."""
    server = GdbServer(0)
    everything = ("set confirm off", f"target remote 127.0.0.1:{server.port}", *commands, "detach")
    words = [word for command in everything for word in ("-ex", command)]
    gdb = subprocess.Popen(
        (GDB, "-nx", "-batch", *words, str(image.path)),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        run(server)
        printed, _ = gdb.communicate(timeout=30)
    finally:
        gdb.kill()
        server.close()
    return printed.splitlines()


@pytest.mark.parametrize("compiler", ["clang", "gcc"])
def test_gdb_stops_at_a_breakpoint_and_names_the_callers(compiler: str) -> None:
    machine = FirmwareOnChip(compiler, planted=ASSERTION)
    printed = debugged(
        partial(machine.run_debugged, end_us=30_000), machine.image,
        "break assertFail", "continue", "backtrace 2", "print $pc == (long)assertFail & ~1", "info breakpoints",
    )  # fmt: skip
    text = "\n".join(printed)
    assert "Breakpoint 1, assertFail (" in text
    assert any(line.startswith("#0  assertFail (") and "firmware.c:" in line for line in printed)
    assert any(
        line.startswith("#1 ") and "go_wrong (how=" in line and "firmware.c:" in line for line in printed
    )
    assert "breakpoint already hit 1 time" in text


def test_gdb_reads_and_changes_registers_and_memory() -> None:
    machine = FirmwareOnChip()
    printed = debugged(
        machine.run_debugged, machine.image, "set var $d5 = -2.5", "print $d5", "print $s10", "set var $basepri = 0x50",
        "print/x $basepri", "set var $r9 = 0xcafe", "print/x $r9", "set var xTickCount = 4711", "print xTickCount",
        "set var tasks[2].pcTaskName[1] = 'q'", "print tasks[2].pcTaskName", "x/1i $pc",
    )  # fmt: skip
    values = [line.partition(" = ")[2] for line in printed if line.startswith("$")]
    assert values[0] == "-2.5"
    assert values[2:5] == ["0x50", "0xcafe", "4711"]
    assert values[5] == r'"\000q\000\000\000\000\000"'
    assert machine.chip.register("d5") == 0xC004_0000_0000_0000
    assert machine.chip.register("basepri") == 0x50
    assert any("Reset_Handler" in line and ":" in line for line in printed[-4:])


def test_gdb_steps_one_instruction_and_one_line() -> None:
    machine = FirmwareOnChip()
    commands = ("print/x $pc", "stepi", "print/x $pc", "next", "print/x $pc")
    printed = debugged(machine.run_debugged, machine.image, *commands)
    before, behind, line = (int(text.partition(" = ")[2], 16) for text in printed if text.startswith("$"))
    assert before == machine.image.reset
    assert behind - before in (2, 4)
    assert line > behind


def test_gdb_sees_through_an_interrupt_into_the_task_below_it() -> None:
    machine = FirmwareOnChip("gcc")
    printed = debugged(
        partial(machine.run_debugged, end_us=30_000), machine.image,
        "break USART6_Handler", "break DMA1_Stream0_Handler", "continue", "backtrace",
        "print i2c_reads", "print/x $psp > 0x20000000", "delete", "print $basepri",
    )  # fmt: skip
    frames = [line.split(" ", 1)[1].strip() for line in printed if line.startswith("#")]
    assert frames[0].startswith("DMA1_Stream0_Handler ()")
    assert frames[1] == "<signal handler called>"
    assert any("report ()" in frame or "spin" in frame or "rest ()" in frame for frame in frames[2:])
    assert machine.peek("i2c_reads") >= 1


def test_gdb_shows_tasks_and_stops_at_a_write() -> None:
    machine = FirmwareOnChip("gcc")
    printed = "\n".join(
        debugged(
            partial(machine.run_debugged, end_us=30_000), machine.image,
            "break send_line", "continue", "info threads", "thread apply all backtrace",
            "delete", "watch xTickCount", "continue", "backtrace 1", "delete",
        )
    )  # fmt: skip
    for name in ("REPORT, running", "FILTER, blocked", "FROZEN, suspended", "SPIN-0, ready"):
        assert f"({name}, priority " in printed
    assert re.search(r"receive \(\) at .*firmware.c:\d+|filter \(\) at .*firmware.c:\d+", printed), printed
    assert re.search(r"Hardware watchpoint 2: xTickCount\s+Old value = \d+\s+New value = \d+", printed), (
        printed
    )
    assert re.search(r"#0  .*tick \(\)", printed), printed


def test_breakpoints_do_not_change_the_hash_of_a_flight(tmp_path: Path) -> None:
    elf = str(stm32_firmware.build())
    command = [*FLOATY, "fly", "hover", "--duration", "0.2", "--board", elf, "--out"]
    alone = subprocess.run(
        [*command, str(tmp_path / "alone")], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert alone.returncode in (0, 1), alone.stderr
    flight = subprocess.Popen(
        [*command, str(tmp_path / "debugged"), "--gdb", "0"], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert flight.stdout is not None
        words = next(line for line in flight.stdout if line.startswith("waiting for "))
        where = words.rpartition(" ")[2].rstrip("'\n")
        commands = ("set remotetimeout 60", f"target remote {where}", "break assertFail", "break send_line", "continue",
                    "stepi", "next", "print xTickCount", "continue", "backtrace", "detach")  # fmt: skip
        options = [word for text in commands for word in ("-ex", text)]
        gdb = subprocess.run(
            (GDB, "-nx", "-batch", *options, elf), capture_output=True, text=True, timeout=120
        )
        assert "Breakpoint 2, send_line" in gdb.stdout, gdb.stdout + gdb.stderr
        flight.communicate(timeout=300)
    finally:
        flight.kill()
    assert flight.returncode == alone.returncode
    first, second = (
        json.loads((tmp_path / name / "result.json").read_text()) for name in ("alone", "debugged")
    )
    assert first["hash"] == second["hash"]
