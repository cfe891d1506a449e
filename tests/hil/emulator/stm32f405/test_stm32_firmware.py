"""The tests' own firmware runs on the emulated microcontroller as on the chip: kernel, floats, queue, peripherals."""

from itertools import pairwise

import numpy as np
import pytest

from hil.emulator.stm32f405.chip import StopReason
from support.dshot import period_us
from support.stm32_machine import FirmwareOnChip

MS = 1000
ASSERTION, HUNGRY_WATCHDOG = 3, 4
COMPILERS = pytest.mark.parametrize("compiler", ["clang", pytest.param("gcc", marks=pytest.mark.long)])


def run(machine: FirmwareOnChip, begin_ms: int, end_ms: int, gyro: bool = True) -> bytes:
    """Run, the gyro's pin pulsing each millisecond; returns what was sent."""
    sent = b""
    for ms in range(begin_ms, end_ms):
        if gyro:
            machine.chip.pin("C", 14, True)
            machine.chip.pin("C", 14, False)
        while (why := machine.run((ms + 1) * MS)) != StopReason.TIME:
            assert why in (StopReason.SERIAL, StopReason.COMPARE), why
            if why == StopReason.SERIAL:
                sent += machine.chip.sent(6)
    return sent


@pytest.mark.long
@COMPILERS
def test_two_tasks_with_floats_keep_them_while_they_are_switched(compiler: str) -> None:
    machine = FirmwareOnChip(compiler)
    run(machine, 0, 100)
    assert machine.peek("fp_errors") == 0
    assert min(machine.peek_all("fp_rounds", 2)) > 100


@pytest.mark.long
@COMPILERS
def test_every_sample_of_a_kilohertz_passes_the_queue(compiler: str) -> None:
    machine = FirmwareOnChip(compiler)
    run(machine, 0, 20)
    before = machine.peek("samples_taken")
    run(machine, 20, 120)
    assert machine.peek("samples_taken") - before == 100
    assert machine.peek("samples_lost") == 0


@pytest.mark.long
@COMPILERS
def test_the_eeprom_is_written_and_read_back_by_dma(compiler: str) -> None:
    machine = FirmwareOnChip(compiler)
    run(machine, 0, 100)
    assert bytes(machine.eeprom[0x140:0x144]) == bytes.fromhex("f10a771e")
    assert machine.chip.read(machine.image.symbol("eeprom").address, 4) == bytes.fromhex("f10a771e")
    assert machine.peek("i2c_reads") == machine.peek("dma_interrupts") >= 6


@pytest.mark.long
def test_lines_leave_the_usart_by_dma_and_bytes_arrive_by_interrupt() -> None:
    machine = FirmwareOnChip()
    sent = run(machine, 0, 60)
    machine.chip.feed(6, b"hello")
    sent += run(machine, 60, 100)
    lines = sent.splitlines()
    assert len(lines) == machine.peek("lines_sent") >= 6
    ticks = [int(line.removeprefix(b"tick "), 16) for line in lines]
    assert all(10 <= later - earlier <= 13 for earlier, later in pairwise(ticks))
    assert (machine.peek("bytes_received"), machine.peek("last_received")) == (5, ord("o"))


@COMPILERS
def test_dshot_by_dma_moves_an_esc_and_its_answer_is_captured(compiler: str) -> None:
    machine, rpm = FirmwareOnChip(compiler), np.array([2400.0])
    machine.chip.add_esc(1, 1, rpm, 12)
    run(machine, 0, 60)
    machine.poke("throttle", 1046)
    run(machine, 60, 100)
    assert (machine.chip.state.compare[1][1], machine.chip.state.esc[0].refused) == (1046, 0)
    edges = machine.peek_all("edges", machine.peek("edge_count"))
    assert period_us(edges, 0.8 * 281) == pytest.approx(60e6 / (2400 * 6), rel=0.005)


@pytest.mark.long
def test_a_hungry_watchdog_resets_and_a_failed_assertion_keeps_its_snapshot_over_the_reset() -> None:
    machines = [FirmwareOnChip(planted=planted) for planted in (HUNGRY_WATCHDOG, ASSERTION)]
    for machine, expected in zip(machines, (StopReason.WATCHDOG, StopReason.RESET), strict=True):
        why = StopReason.TIME
        while (
            why in (StopReason.TIME, StopReason.SERIAL, StopReason.COMPARE) and machine.chip.now_us < 400 * MS
        ):
            why = machine.run(400 * MS)
        assert why & expected
    assert 190 * MS < machines[0].chip.now_us < 215 * MS  # 200 periods of 32 / 32 kHz after the start
    assert machines[1].peek("snapshot") == 0x2F8A_001F


def test_a_step_into_an_interrupt_ends_in_front_of_its_handler() -> None:
    machine = FirmwareOnChip()
    chip, handler = machine.chip, machine.image.symbol("EXTI15_10_Handler").address
    run(machine, 0, 20)
    while chip.register("xpsr") & 0x1FF:
        chip.step()
    chip.pin("C", 14, True)
    before = chip.state.exceptions
    while chip.state.exceptions == before:
        chip.step()
    assert (chip.register("pc"), chip.register("xpsr") & 0x1FF) == (handler, 16 + 40)
    instructions = chip.state.instructions
    chip.step()
    assert chip.register("pc") - handler in (2, 4)
    assert chip.state.instructions > instructions


@pytest.mark.long
@pytest.mark.parametrize("taken_us", [0, 400, 900])
def test_processor_load_takes_time_only_from_tasks(taken_us: int) -> None:
    machine = FirmwareOnChip()
    processor, state = machine.processor(), machine.chip.state
    processor.run(20_000)

    def spent() -> tuple[int, int, dict[str, int]]:
        times = dict(zip((task.name for task in processor.tasks), processor.run_times_us(), strict=True))
        return state.instructions, machine.peek("xTickCount"), times

    before = spent()
    processor.run(120_000)
    free = spent()
    processor.occupy("LOAD", lambda: taken_us)
    processor.run(121_000)  # it begins a tick later
    occupied = spent()
    processor.run(221_000)
    after = spent()
    share = (after[0] - occupied[0]) / (free[0] - before[0])
    assert share == pytest.approx(1 - taken_us / 1000, abs=0.01)
    assert after[1] - occupied[1] == free[1] - before[1] == 100
    assert after[2]["LOAD"] - occupied[2]["LOAD"] == 100 * taken_us
    assert sum(after[2].values()) - sum(occupied[2].values()) == pytest.approx(100_000, abs=len(after[2]))
    assert list(after[2]) == [task.name for task in processor.tasks]
    assert len(processor.activations()) == len(processor.tasks)


def test_a_processor_that_is_occupied_whole_serves_interrupts_and_no_task() -> None:
    machine = FirmwareOnChip()
    processor = machine.processor()
    processor.run(20_000)
    processor.occupy("LOAD", lambda: 1000)
    processor.run(22_000)
    before, counted = (
        processor.run_times_us(),
        [machine.peek(name) for name in ("xTickCount", "bytes_received")],
    )
    machine.chip.feed(6, bytes(100))
    processor.run(50_000)
    after = processor.run_times_us()
    assert machine.peek("xTickCount") - counted[0] == 28
    assert machine.peek("bytes_received") - counted[1] == 100
    tasks = [task.name for task in processor.tasks]
    taken = dict(zip(tasks, (b - a for a, b in zip(before, after, strict=True)), strict=True))
    assert taken.pop("LOAD") > 27_500
    assert sum(taken.values()) < 500  # the interrupts


def test_code_that_was_changed_runs_changed_also_where_it_has_run_before() -> None:
    machine = FirmwareOnChip()
    run(machine, 0, 20)
    place = machine.image.symbol("tick").address
    before, code = machine.peek("xTickCount"), machine.chip.read(place, 2)
    for written, more in ((b"\x70\x47", 0), (code, 20)):  # bx lr
        machine.chip.write(place, written)
        run(machine, 20 + more, 40 + more)
        assert machine.peek("xTickCount") == pytest.approx(before + more, abs=1)
    assert before > 10
