"""The border between Python and the compiled machine: one header, which both sides read."""

from pathlib import Path

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.emulator.stm32f405 import chip
from hil.emulator.stm32f405.chip import SOURCES, Chip, StopReason, build_machine, declared
from hil.errors import LabError
from support.stm32_bench import Bench


def constants(prefix: str) -> dict[str, int]:
    """The numbers of machine.h whose names begin so, without that."""
    declarations = declared()
    library = declarations.dlopen(str(build_machine()))
    return {
        name.removeprefix(prefix): getattr(library, name)
        for name in dir(library)
        if name.isupper() and name.startswith(prefix)
    }


def test_python_s_reasons_to_stop_are_the_machine_s() -> None:
    assert {why.name: why.value for why in StopReason if why} == constants("STOP_")


def test_python_s_memories_lie_where_the_machine_has_them() -> None:
    numbers = constants("")
    for name in ("FLASH", "RAM", "CCM"):
        assert (getattr(chip, name), getattr(chip, f"{name}_SIZE")) == (
            numbers[f"{name}_BASE"],
            numbers[f"{name}_SIZE"],
        )
    assert numbers["CLOCK_HZ"] == chip.CYCLES_PER_US * 1_000_000


@pytest.mark.parametrize("base", [chip.FLASH, chip.FLASH + 0x4000])
def test_flash_is_erased_around_the_code_and_memories_are_empty(base: int) -> None:
    code = bytes(range(1, 65))
    made = Chip(code, base, build_machine())
    before, after = base - chip.FLASH, chip.FLASH_SIZE - (base - chip.FLASH) - len(code)
    assert made.read(chip.FLASH, chip.FLASH_SIZE) == b"\xff" * before + code + b"\xff" * after
    assert not made.ram.any()
    assert not made.ccm.any()


ENDS = (
    *(base + size for base, size, _ in chip.WINDOWS), chip.FLASH_SIZE, chip.FLASH + chip.FLASH_SIZE,
    chip.RAM + chip.RAM_SIZE, chip.CCM + chip.CCM_SIZE, chip.SYSTEM + chip.SYSTEM_SIZE,
)  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("end", ENDS)
def test_the_last_word_of_each_memory_is_read_and_written_and_none_behind_it(end: int) -> None:
    made = Bench().chip
    assert len(made.read(end - 4, 4)) == 4
    made.write(end - 4, bytes(4))
    for use in (lambda: made.read(end - 3, 4), lambda: made.write(end - 3, bytes(4))):
        with pytest.raises(LabError, match=r"no memory there$"):
            use()


def test_code_that_a_debugger_writes_runs_from_the_first_half_word_of_flash_on() -> None:
    bench = Bench()
    for code in ("0130 fee7", "0230 fee7"):  # adds r0, #1 or #2; b .
        bench.chip.write(chip.FLASH, bytes.fromhex(code))
        bench.chip.set_register("pc", chip.FLASH | 1)
        assert bench.chip.register("pc") == chip.FLASH
        bench.wait(1)
    assert bench.chip.register("r0") == 3


@pytest.mark.long
@pytest.mark.parametrize(
    ("was", "is_now"),
    [
        ("uint64_t next_due;", ""),
        ("uint32_t unknown[16];", "uint32_t unknown[17];"),
        ("SWITCHES = 4096", "SWITCHES = 4095"),
    ],
)
def test_a_layout_that_is_not_the_compiled_one_is_refused(
    was: str, is_now: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = build_machine()
    header = (SOURCES / "machine.h").read_text()
    assert was in header
    (tmp_path / "machine.h").write_text(header.replace(was, is_now))
    monkeypatch.setattr(chip, "SOURCES", tmp_path)
    monkeypatch.setattr(chip, "declared", declared.__wrapped__)
    with pytest.raises(LabError, match=r"not compiled from the machine\.h"):
        Chip(bytes(8), chip.FLASH, library)


def test_a_number_that_does_not_fit_is_refused_and_not_cut() -> None:
    bench = Bench()
    with pytest.raises(OverflowError):
        bench.chip.run(1 << 64)
    with pytest.raises(OverflowError):
        bench.chip.state.pc = 1 << 32
    with pytest.raises(AttributeError):
        bench.chip.state.nothing = 0
