"""The parts around the chip by the registers of their data sheets."""

import struct
from types import SimpleNamespace
from weakref import ref

import numpy as np
import pytest

pytest.importorskip("unicorn")

from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.parts import Parts
from hil.emulator.crazyflie.radio_line import RadioLine
from support.deck_bench import DeckBench
from support.stm32_bench import Bench

SYSCFG, EXTI, PORT_C, USART6, GPIOA_IDR = 0x4001_3800, 0x4001_3C00, 2, 0x4001_1400, 0x4002_0010


def test_a_sample_is_in_the_bmi088s_registers_when_its_interrupt_comes() -> None:
    bench = Bench()
    parts = Parts(bench.chip, np.zeros(8192, np.uint8))
    bench[SYSCFG + 0x14] = PORT_C << 8  # EXTI14
    bench[EXTI], bench[EXTI + 8] = 1 << 14, 1 << 14  # IMR, RTSR
    assert not bench[EXTI + 0x14]
    for _ in range(2):  # each comes with an edge of its own
        parts.sample((1, -2, 300, -4, 500, -6))
        assert bench[EXTI + 0x14] == 1 << 14
        bench[EXTI + 0x14] = 1 << 14
    assert struct.unpack_from("<3h", parts.gyro, 0x02) == (1, -2, 300)
    assert struct.unpack_from("<3h", parts.accel, 0x12) == (-4, 500, -6)
    assert (parts.gyro[0x00], parts.accel[0x00], parts.accel[0x03] >> 7) == (
        0x0F,
        0x1E,
        1,
    )  # identities, ready
    assert not parts.accel[0x18:].any()


def test_at_power_on_all_lines_are_pulled_up_but_those_of_a_ready_sample_and_a_busy_radio_chip() -> None:
    bench = Bench()
    Parts(bench.chip, np.zeros(8192, np.uint8))
    levels = {port: bench[GPIOA_IDR + 0x400 * index] for index, port in enumerate("ABCDE")}
    assert levels == dict.fromkeys("ABCDE", 0xFFFF) | {"A": 0xFFEF, "C": 0xBFFF}


def test_an_eeprom_has_its_size_and_memory_of_devices_lives_as_long_as_the_chip() -> None:
    chip = Bench().chip
    for size in (8191, 8193):
        with pytest.raises(ValueError, match=f"^an EEPROM of {size} bytes: it has 8192$"):
            Parts(chip, np.zeros(size, np.uint8))
    memory, rpm = np.zeros(8, np.uint8), np.zeros(1)
    kept = ref(memory), ref(rpm)
    chip.add_device(2, 0x51, memory)
    chip.add_esc(1, 0, rpm, 12)
    del memory, rpm
    assert all(one() is not None for one in kept)


def send(bench: DeckBench, data: bytes) -> None:
    """Let the microcontroller write to its radio chip."""
    bench[USART6 + 8], bench[USART6 + 0xC] = 84, 1 << 13 | 1 << 3  # BRR, UE and TE
    for byte in data:
        bench[USART6 + 4] = byte
        bench.wait(20)


def test_the_radio_chip_is_busy_while_its_queue_is_full() -> None:
    bench, sent, room = DeckBench(), [], []
    outside = SimpleNamespace(
        debug_write=print,
        radio_send=lambda data: bool(room and [sent.append(data)]),
        radio_command=lambda *_: None,
    )
    radio = RadioLine(bench.chip, bench.processor, bench.decks, outside, polls=False)  # type: ignore[arg-type]
    for data in (b"", b"\x30hello"):  # an empty frame is no packet
        send(bench, syslink.encode(syslink.RAW, data))
        radio.sent()
    assert (bench[GPIOA_IDR] >> 4 & 1, sent) == (1, [])
    room.append(True)
    radio.received(syslink.EMPTY)
    assert (bench[GPIOA_IDR] >> 4 & 1, sent) == (0, [b"\x30hello"])


def test_a_frame_that_a_reset_cut_off_costs_no_later_one() -> None:
    bench, lines = DeckBench(), []
    outside = SimpleNamespace(
        debug_write=lines.append, radio_send=lambda data: True, radio_command=lambda kind, data: None
    )
    radio = RadioLine(bench.chip, bench.processor, bench.decks, outside, polls=False)  # type: ignore[arg-type]
    long, frame = syslink.encode(syslink.RAW, bytes(26)), syslink.encode(syslink.RAW, b"\0hello\n")
    for data in (long[:8], frame):
        send(bench, data)
        radio.sent()
        bench.chip.reset(0x1400_0000)
        radio.reset(bench.chip.now_us)
    assert lines == ["hello"]


def test_battery_and_signal_are_reported_once_the_processor_has_asked() -> None:
    fed: list[bytes] = []
    every, frames = {}, [[(syslink.BATTERY_REPORTS, b"")]]
    chip = SimpleNamespace(
        now_us=7, feed=lambda usart, data: fed.append(data), pin=lambda *_: None, sent=lambda usart: b"".join(
            syslink.encode(*frame) for frame in (frames.pop() if frames else ())
        ),
    )  # fmt: skip
    outside = SimpleNamespace(read_battery_mv=lambda: 3900, radio_command=lambda *_: None)
    line = RadioLine(chip, SimpleNamespace(every=every.setdefault), None, outside, polls=False)  # type: ignore[arg-type]
    (report,) = every.values()

    def reported() -> list[tuple[int, bytes]]:
        fed.clear()
        report(0)
        return list(syslink.Decoder().decode_frames(b"".join(fed)))

    assert reported() == []
    line.sent()
    volts = (syslink.BATTERY, struct.pack("<Bfff", 0, 3.9, 0.0, 25.0))
    assert reported() == [volts, (syslink.SIGNAL, b"\0")], "nothing was heard yet"
    line.received(syslink.EMPTY)
    assert reported() == [volts, (syslink.SIGNAL, b"\x28")]
