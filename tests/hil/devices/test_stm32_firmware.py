"""The tests' own firmware runs on the emulated microcontroller as on the chip: kernel, floats, queue, peripherals."""

from itertools import pairwise

import pytest

from hil.devices.stm32f405.chip import Why
from hil.devices.stm32f405.processor import Processor
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
        while (why := machine.run((ms + 1) * MS)) != Why.TIME:
            assert why in (Why.SERIAL, Why.COMPARE), why
            if why == Why.SERIAL:
                sent += machine.chip.sent(6)
    return sent


@COMPILERS
def test_two_tasks_with_floats_keep_them_while_they_are_switched(compiler: str) -> None:
    machine = FirmwareOnChip(compiler)
    run(machine, 0, 100)
    assert machine.peek("fp_errors") == 0
    assert min(machine.peek_all("fp_rounds", 2)) > 100


@COMPILERS
def test_every_sample_of_a_kilohertz_passes_the_queue(compiler: str) -> None:
    machine = FirmwareOnChip(compiler)
    run(machine, 0, 20)
    before = machine.peek("samples_taken")
    run(machine, 20, 120)
    assert machine.peek("samples_taken") - before == 100
    assert machine.peek("samples_lost") == 0


def test_the_tick_is_a_millisecond() -> None:
    machine = FirmwareOnChip()
    run(machine, 0, 20)
    before = machine.peek("xTickCount")
    run(machine, 20, 220)
    assert machine.peek("xTickCount") - before in (199, 200, 201)


@COMPILERS
def test_the_eeprom_is_written_and_read_back_by_dma(compiler: str) -> None:
    machine = FirmwareOnChip(compiler)
    run(machine, 0, 100)
    assert bytes(machine.eeprom[0x140:0x144]) == bytes.fromhex("f10a771e")
    assert machine.chip.read(machine.image.symbol("eeprom").address, 4) == bytes.fromhex("f10a771e")
    assert machine.peek("i2c_reads") == machine.peek("dma_interrupts") >= 6


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


def test_a_hungry_watchdog_resets() -> None:
    machine = FirmwareOnChip(planted=HUNGRY_WATCHDOG)
    why = Why.TIME
    while why in (Why.TIME, Why.SERIAL, Why.COMPARE) and machine.chip.now_us < 400 * MS:
        why = machine.run(400 * MS)
    assert why & Why.WATCHDOG
    assert 190 * MS < machine.chip.now_us < 215 * MS  # 200 periods of 32 / 32 kHz after the start


def test_a_failed_assertion_keeps_its_snapshot_over_the_reset() -> None:
    machine = FirmwareOnChip(planted=ASSERTION)
    why = Why.TIME
    while why in (Why.TIME, Why.SERIAL, Why.COMPARE) and machine.chip.now_us < 100 * MS:
        why = machine.run(100 * MS)
    assert why & Why.RESET
    assert machine.peek("snapshot") == 0x2F8A_001F


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


def test_a_busy_chip_wants_its_turn_ten_times_a_millisecond() -> None:
    machine = FirmwareOnChip()
    processor = Processor(machine.chip, machine.image, lambda why: None)
    processor.run(20_000)
    turns = 0
    while processor.now_us < 30_000:
        assert not machine.chip.state.asleep  # two of its tasks never wait
        processor.run(processor.next_wake_us)
        turns += 1
    assert turns <= 101
