"""What ran of an image: compared with gcov of the same sources, with the firmware's own counters, and added over flights."""

import gzip
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import capstone
import pytest
from capstone import arm

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from firmware_py.export.elf import Symbol
from hil.api import fly
from hil.board import image_firmware
from hil.emulator.stm32f405 import coverage
from hil.emulator.stm32f405.chip import StopReason
from hil.emulator.stm32f405.coverage import FileCoverage, ImageLines
from hil.emulator.stm32f405.debug_info import LineRow
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError
from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.coverage import read_executed
from hil.laboratory.request import Request
from support import stm32_firmware
from support.stm32_bench import Bench
from support.stm32_firmware import SOURCES
from support.stm32_machine import FirmwareOnChip

MEASURED = 8  # the scenario
PLANTED = {"DIVISION": 8, "HANG": 9, "OVERFLOW": 10, "UNDEFINED": 2}


class Recorded(FirmwareOnChip):
    """The tests' firmware, its blocks counted from power-on."""

    def __init__(self, compiler: str, *flags: str, **variables: int) -> None:
        super().__init__(compiler, ("-g", *flags), **variables)
        self.chip.record()

    def run_to(self, us: int) -> None:
        while self.chip.now_us < us and not self.run(us) & (StopReason.RESET | StopReason.LOCKUP):
            pass

    def file(self, name: str, us: int) -> FileCoverage:
        self.run_to(us)
        files = ImageLines(self.image).coverage(self.chip.passages)
        return next(one for one in files if Path(one.path).name == name)


def entered(file: FileCoverage) -> dict[str, int]:
    return {one.name: one.count for one in file.functions}


def line_of(text: str) -> int:
    lines = (SOURCES / "firmware.c").read_text(encoding="utf-8").splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


def conditional_jumps(image: Image) -> Iterator[tuple[int, int]]:
    """Yield what capstone says of an image's functions: address and size of each jump or call on a condition."""
    reader = capstone.Cs(capstone.CS_ARCH_ARM, capstone.CS_MODE_THUMB | capstone.CS_MODE_MCLASS)
    reader.detail = True
    jumps = {arm.ARM_GRP_JUMP, arm.ARM_GRP_CALL, arm.ARM_GRP_BRANCH_RELATIVE}
    ends = sorted({one.address for one in image.functions if one.address >= image.base})
    for begin, end in pairwise([*ends, image.base + len(image.code)]):
        data = {2 * at + image.base for at in image.constants} & set(range(begin, end))
        for first, last in pairwise([begin, *sorted(data), end]):
            first += 2 * (first in data)
            for one in reader.disasm(image.code[first - image.base : last - image.base], first):
                on_condition = one.cc not in (arm.ARM_CC_AL, arm.ARM_CC_INVALID)
                to_pc = arm.ARM_REG_PC in one.regs_access()[1]
                if one.id in (arm.ARM_INS_CBZ, arm.ARM_INS_CBNZ) or (
                    on_condition and (jumps & {*one.groups} or to_pc)
                ):
                    yield one.address, one.size


@pytest.mark.parametrize("compiler", ["clang", "gcc"])
def test_conditional_jumps_are_those_that_capstone_reads(compiler: str) -> None:
    image = Image(stm32_firmware.build(compiler))
    found = [*coverage._branches(image)]
    assert len(found) > 50
    assert found == [*conditional_jumps(image)]


def counted_by_gcov(folder: Path) -> dict[str, Any]:
    """Return what gcov reports of measured.c on the host."""
    for program in ("gcc", "gcov"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed: coverage is not compared with gcov's")
    shutil.copy(SOURCES / "measured.c", folder)
    (folder / "main.c").write_text("void measured(void);\nint main(void) { measured(); return 0; }\n")
    for command in (
        ("gcc", "-O0", "--coverage", "-o", "run", "measured.c", "main.c"), ("./run",),
        ("gcov", "-b", "-j", "run-measured.gcda"),
    ):  # fmt: skip
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
    with gzip.open(next(folder.glob("*.gcov.json.gz"))) as file:
        found: dict[str, Any] = json.load(file)["files"][0]
    return found


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_functions_lines_and_branches_are_those_of_gcov_on_the_host(compiler: str, tmp_path: Path) -> None:
    host = counted_by_gcov(tmp_path)
    file = Recorded(compiler, "-O0", scenario=MEASURED).file("measured.c", 20_000)
    assert entered(file) == {one["name"]: one["execution_count"] for one in host["functions"]}
    assert len(file.functions) == 11
    lines = {one["line_number"]: one["count"] for one in host["lines"]}
    text = (SOURCES / "measured.c").read_text(encoding="utf-8").splitlines()
    # A label has no instruction here, and an end or a head of a block is no line there.
    assert all(re.match(r" *(case .*|default):", text[line - 1]) for line in set(lines) - set(file.lines))
    both = set(lines) & set(file.lines)
    assert len(both) > 60
    assert {line for line in both if lines[line]} == {line for line in both if file.lines[line]}
    if compiler == "clang":
        return  # its loops have other jumps
    assert {line: file.lines[line] for line in both} == {line: lines[line] for line in both}
    switch = next(number for number, line in enumerate(text, 1) if "switch" in line)
    there = {one["line_number"]: sorted(way["count"] for way in one["branches"]) for one in host["lines"]}
    here: dict[int, list[int]] = {}
    for one in file.branches:
        here.setdefault(one.line, []).extend((one.jumped, one.fell))
    assert {line: sorted(ways) for line, ways in here.items() if line != switch} == {
        line: ways for line, ways in there.items() if ways and line != switch
    }


@pytest.mark.long
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_counts_are_those_that_the_firmware_keeps_itself(compiler: str) -> None:
    firmware = Recorded(compiler)
    for now_us in range(1_000, 300_000, 1_000):
        firmware.run_to(now_us)
        firmware.chip.pin("C", 14, True)  # the gyro's samples
        firmware.chip.pin("C", 14, False)
    file = firmware.file("firmware.c", 300_000)
    counts = entered(file)
    assert counts["tick"] == firmware.peek("xTickCount") > 250
    assert counts["send_line"] == firmware.peek("lines_sent") > 5
    assert counts["DMA1_Stream0_Handler"] == firmware.peek("dma_interrupts") > 0
    rounds = sum(firmware.peek("fp_rounds", index) for index in range(2))
    assert rounds <= counts["check_fp_registers"] <= rounds + 2  # both tasks may be in it
    assert counts["Reset_Handler"] == 1
    assert counts["assertFail"] == counts["hang"] == counts["dig"] == 0


@pytest.mark.parametrize("planted", PLANTED)
def test_a_planted_call_is_the_one_that_ran(planted: str) -> None:
    firmware = Recorded("gcc", "-fno-inline", planted=PLANTED[planted])
    file = firmware.file("firmware.c", 60_000)
    counts, lines = entered(file), file.lines
    assert counts["go_wrong"] > 0
    assert (counts["hang"] > 0) == (planted == "HANG")
    assert (counts["dig"] > 0) == (planted == "OVERFLOW")
    assert (lines[line_of("return 7 / zero")] > 0) == (planted == "DIVISION")
    assert (lines[line_of("udf #7")] > 0) == (planted == "UNDEFINED")
    assert lines[line_of("svc #0")] == lines[line_of("bkpt #0")] == 0
    if planted == "HANG":
        assert abs(lines[line_of("wasted++;")] - firmware.peek("wasted")) <= 1
    if planted == "UNDEFINED":
        assert counts["Stuck_Handler"] > 0
        assert lines[line_of("udf #7")] == 1


def test_coverage_adds_over_flights_keeps_the_hash_and_is_of_one_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(image_firmware, "WARM_UP_US", 20_000)
    out, elf = tmp_path / "cov", stm32_firmware.build()

    def flown(number: int, coverage: Path | None, board: Path = elf, profile: Path | None = None) -> str:
        given = {"coverage": coverage, "profile_cpu": profile}
        options = {name: path for name, path in given.items() if path is not None}
        request = Request.of(
            find_experiment("hover"), duration_s=0.1, board=str(board),
            overrides=("flight.release_us=50000",), **options,
        )  # fmt: skip
        return fly(request, tmp_path / str(number)).hash

    first = flown(1, out)
    once = read_executed(out).counts
    info = (tmp_path / "cov.info").read_text(encoding="utf-8").splitlines()
    assert {flown(2, None, profile=tmp_path / "cpu"), flown(3, tmp_path / "cov.info")} == {first}
    shown = json.loads((tmp_path / "cpu.speedscope.json").read_text(encoding="utf-8"))["profiles"]
    stacks = (tmp_path / "cpu.folded").read_text(encoding="utf-8").splitlines()
    cycles = sum(int(line.rpartition(" ")[2]) for line in stacks)
    assert cycles == sum(weight for one in shown for weight in one["weights"]) > 168 * 120_000
    assert f"{cycles} cycles of 168 MHz" in (tmp_path / "cpu.txt").read_text(encoding="utf-8")
    both = read_executed(out)
    assert both.flights == 2
    assert (both.counts == 2 * once).all()
    lines = [line for line in info if line.startswith("DA:")]
    found, hit = (sum(int(line[3:]) for line in info if line.startswith(total)) for total in ("LF:", "LH:"))
    assert found == len(lines)
    assert hit == sum(not line.endswith(",0") for line in lines) > 100
    source = next(line[3:] for line in info if line.startswith("SF:"))
    assert Path(source).is_file()
    page = (tmp_path / "cov.html").read_text(encoding="utf-8")
    assert f"{100 * hit / found:.1f} %" in page
    assert "2 flights" in page
    assert "return 7 / zero;" in page
    with pytest.raises(LabError, match=r"^--coverage \S+: has the coverage of another image \([^\n]*$"):
        flown(4, out, stm32_firmware.build("gcc"))
    with pytest.raises(LabError, match=r"^--coverage \S+: needs an image as --board, not c$"):
        Request.of(find_experiment("hover"), coverage=out)
    with pytest.raises(LabError, match=r"^--profile-cpu \S+: needs an image as --board, not c$"):
        Request.of(find_experiment("hover"), profile_cpu=out)
    with pytest.raises(
        LabError, match=r"^--profile-cpu \S+: a folder; expected the beginning of a file's name$"
    ):
        flown(4, None, profile=tmp_path)
    (tmp_path / "cov.counts").unlink()
    with pytest.raises(LabError, match=r"cov\.info exists without its cov\.counts: choose another name$"):
        flown(5, out)


def test_the_instruction_in_which_the_chip_sleeps_has_run_and_the_next_one_has_not() -> None:
    bench = Bench(bytes.fromhex("00bf00bf"))
    bench.chip.record()
    for _ in range(2):
        bench.wait(10)
        runs = coverage.runs_of(bench.chip.passages)[4:10]
        assert runs.tolist() == [1, 1, 1, 0, 0, 0]  # two NOPs, WFI, the jump back to it


@pytest.mark.parametrize(("size", "last"), [(4, 11), (8, 12), (64, 12), (0, 12)])
def test_a_function_ends_with_its_size_or_where_the_next_one_begins(size: int, last: int) -> None:
    begin = 0x0800_4000
    rows = [LineRow(begin + 4 * n, begin + 4 * n + 4, "a.c", 11 + n, True) for n in range(4)]
    functions = [Symbol("one", begin, size, True, False), Symbol("two", begin + 8, 8, True, False)]
    image: Any = SimpleNamespace(
        debug=SimpleNamespace(rows=rows), functions=functions, code=bytes(16), base=begin, constants=()
    )
    found = [(name, end) for name, _, end, _ in ImageLines(image)._with_places()]
    assert found == [("one", last), ("two", 14)]
