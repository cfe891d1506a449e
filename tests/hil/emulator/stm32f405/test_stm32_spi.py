"""SPI and the devices behind it by their registers, as RM0090 has them (chapter 28)."""

import numpy as np
import pytest

pytest.importorskip("unicorn")

from hil.emulator.stm32f405.chip import RAM
from support.stm32_bench import Bench

# Address, interrupt, whether its clock is APB2's, 84 MHz, or APB1's, 42 MHz.
SPIS = {1: (0x4001_3000, 35, True), 2: (0x4000_3800, 36, False), 3: (0x4000_3C00, 51, False)}
SPI1, DMA2, GPIOB = SPIS[1][0], 0x4002_6400, 0x4002_0400
CR1, CR2, SR, DR = 0x00, 0x04, 0x08, 0x0C
MASTER, ENABLED, BY_64 = 1 << 2, 1 << 6, 5 << 3
RXNE, TXE, OVR, BSY = 1, 2, 64, 128
BY_DMA, RXNEIE, TXEIE = 1 | 2, 1 << 6, 1 << 7
BYTE_US = 7  # 8 bits of 84 MHz / 64
SELECT = ("B", 4)
WRITE = 0x80
BUFFER = RAM + 0x2000


class Selected(Bench):
    """A bench with 128 registers 0, 1, 2, ... on SPI 1, selected by PB4."""

    def __init__(self) -> None:
        super().__init__()
        self.registers = np.arange(128, dtype=np.uint8)
        self.told: list[int] = []
        self.device = self.chip.add_selected(1, SELECT, self.registers)
        self.chip.on_write(self.device, lambda: self.told.append(self.chip.first_byte(self.device)))
        self[GPIOB + 0x18] = 1 << 4
        self[GPIOB] = 1 << 8  # an output
        self[SPI1 + CR1] = MASTER | BY_64 | ENABLED

    def select(self, low: bool) -> None:
        self[GPIOB + 0x18] = 1 << (20 if low else 4)

    def exchange(self, data: bytes) -> bytes:
        received = []
        for byte in data:
            self[SPI1 + DR] = byte
            self.wait(BYTE_US)
            received.append(self[SPI1 + DR])
        return bytes(received)

    def transfer(self, data: bytes) -> bytes:
        self.select(True)
        received = self.exchange(data)
        self.select(False)
        self.chip.tell_devices()
        return received


@pytest.fixture
def bench() -> Selected:
    return Selected()


@pytest.mark.parametrize("number", SPIS)
def test_each_controller_has_its_clock_and_its_interrupt(number: int) -> None:
    bench, (base, irq, fast) = Bench(), SPIS[number]
    bench[base + CR1] = MASTER | ENABLED | (4 << 3 if fast else 3 << 3)  # 2.625 MHz
    bench[base + CR2] = RXNEIE
    bench[base + DR] = 1
    assert bench[base + SR] == TXE | BSY
    bench.wait(3)
    assert bench[base + SR] & RXNE == 0
    assert not any(bench.is_pending(one) for _, one, _ in SPIS.values())
    bench.wait(1)
    assert bench[base + SR] == TXE | RXNE
    assert [one for _, one, _ in SPIS.values() if bench.is_pending(one)] == [irq]
    assert bench[base + DR] == 0xFF, "nobody is selected"
    assert bench[base + SR] == TXE


@pytest.mark.long
def test_a_read_counts_on_from_its_address_and_a_write_too(bench: Selected) -> None:
    assert bench.transfer(bytes((0x16, 0, 0, 0)))[1:] == bytes((0x16, 0x17, 0x18))
    bench.transfer(bytes((0x20 | WRITE, 7, 8)))
    assert bench.registers[0x20:0x23].tolist() == [7, 8, 0x22]
    assert bench.told == [0x16, 0x20 | WRITE]


def test_an_unselected_device_is_inactive(bench: Selected) -> None:
    assert bench.exchange(bytes((0x20 | WRITE, 7))) == b"\xff\xff"
    assert bench.registers[0x20] == 0x20
    bench.chip.tell_devices()
    assert bench.told == []


def test_a_second_byte_waits_in_the_register_and_a_third_overruns(bench: Selected) -> None:
    bench.select(True)
    bench[SPI1 + DR] = 0x10
    bench[SPI1 + DR] = 0
    assert bench[SPI1 + SR] == BSY
    bench.wait(BYTE_US)
    assert bench[SPI1 + SR] == TXE | RXNE | BSY
    bench.wait(BYTE_US)
    assert bench[SPI1 + SR] == TXE | RXNE | OVR
    assert bench[SPI1 + DR] == 0, "the first one"
    assert bench[SPI1 + SR] == TXE


def test_dma_carries_both_directions_and_both_streams_complete(bench: Selected) -> None:
    bench[SPI1 + CR1] = MASTER | BY_64
    bench.chip.write(BUFFER, bytes((0x30, 0, 0, 0)))
    for stream, direction in ((0, 0), (5, 1 << 6)):
        base = DMA2 + 0x10 + 0x18 * stream
        bench[base + 4], bench[base + 8], bench[base + 12] = 4, SPI1 + DR, BUFFER
        bench[base] = 1 | 16 | 1 << 10 | direction  # enabled, complete interrupt, increment
    bench.select(True)
    bench[SPI1 + CR2] = BY_DMA
    bench[SPI1 + CR1] = MASTER | BY_64 | ENABLED
    bench.wait(4 * BYTE_US)
    assert bench.chip.read(BUFFER, 4) == bytes((0, 0x30, 0x31, 0x32))
    assert (bench[DMA2] >> 5 & 1, bench[DMA2 + 4] >> 11 & 1) == (1, 1)
    assert bench.is_pending(56)
    assert bench.is_pending(68)


def test_bytes_written_before_the_start_leave_at_the_start(bench: Selected) -> None:
    bench[SPI1 + CR1] = MASTER | BY_64
    bench.select(True)
    bench[SPI1 + DR] = 0x11
    bench.wait(3 * BYTE_US)
    assert bench[SPI1 + SR] == 0
    bench[SPI1 + CR1] = MASTER | BY_64 | ENABLED
    bench[SPI1 + CR2] = TXEIE
    assert bench.is_pending(35)
    bench.wait(BYTE_US)
    assert bench[SPI1 + DR] == 0
    assert bench.exchange(b"\0") == b"\x11"
    bench[SPI1 + DR] = bench[SPI1 + DR] = 0  # switched off meanwhile: the second stays
    bench[SPI1 + CR1] = MASTER | BY_64
    bench.wait(3 * BYTE_US)
    assert bench[SPI1 + SR] == RXNE


def test_a_device_on_i2c_gets_writes_only_and_can_move() -> None:
    bench, i2c = Bench(), 0x4000_5400
    told: list[int] = []
    device = bench.chip.add_device(1, 0x29, np.zeros(16, np.uint8))
    bench.chip.on_write(device, lambda: told.append(1))

    def address(byte: int) -> bool:
        bench[i2c] = 1 << 8 | 1
        bench.until(i2c + 0x14, 1)
        bench[i2c + 0x10] = byte
        bench.wait(100)
        answers = bool(bench[i2c + 0x14] & 2)
        bench[i2c + 0x18]  # clears ADDR
        return answers

    bench[i2c + 0x1C], bench[i2c] = 35, 1
    for data, before, times in ((b"\3", 0, 0), (b"\3\7", 0, 1), (b"\3", 1, 1)):
        assert address(0x29 << 1)
        for byte in data:
            bench[i2c + 0x10] = byte
            bench.wait(100)
        bench.chip.tell_devices()
        assert len(told) == before, "its transfer goes on"
        bench[i2c] = 1 << 9 | 1  # stop
        bench.wait(100)
        bench.chip.tell_devices()
        assert len(told) == times
    bench.chip.move_device(device, 0x30)
    assert not address(0x29 << 1)
    assert address(0x30 << 1)
