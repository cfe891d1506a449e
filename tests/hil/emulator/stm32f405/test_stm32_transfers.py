"""DMA and the lines that it serves by their registers, as RM0090 has them (chapters 10, 27 and 30)."""

import numpy as np
import pytest

pytest.importorskip("unicorn")

from hil.emulator.stm32f405.chip import CCM, RAM
from support.stm32_bench import Bench

DMAS = (0x4002_6000, 0x4002_6400)
DMA_IRQS = ((11, 12, 13, 14, 15, 16, 17, 47), (56, 57, 58, 59, 60, 68, 69, 70))
COMPLETE_BITS = (5, 11, 21, 27)  # of four streams in a register of flags
ENABLED, ERROR_IE, COMPLETE_IE, TO_PERIPHERAL, CIRCULAR, INCREMENT = 1, 4, 16, 64, 256, 1024
CR, NDTR, PAR, M0AR = 0x00, 0x04, 0x08, 0x0C
# Address, interrupt, whether its clock is APB2's, 84 MHz, or APB1's, 42 MHz.
USARTS = {
    1: (0x4001_1000, 37, True), 2: (0x4000_4400, 38, False), 3: (0x4000_4800, 39, False),
    4: (0x4000_4C00, 52, False), 5: (0x4000_5000, 53, False), 6: (0x4001_1400, 71, True),
}  # fmt: skip
USART6 = USARTS[6][0]
SR, DR, BRR, CR1, CR3 = 0x00, 0x04, 0x08, 0x0C, 0x14
ORE, RXNE, TC, TXE = 8, 32, 64, 128
RECEIVING, SENDING, BY_DMA = 1 << 13 | 4, 1 << 13 | 8, 1 << 6
BYTE_US = 10
I2C1 = 0x4000_5400
BUFFER = RAM + 0x2000


@pytest.fixture
def bench() -> Bench:
    return Bench()


def stream_of(dma: int, number: int) -> int:
    return DMAS[dma] + 0x10 + 0x18 * number


def receive_by_dma(bench: Bench, size: int, control: int, stream: int = stream_of(1, 1)) -> None:
    bench[stream + NDTR], bench[stream + PAR], bench[stream + M0AR] = size, USART6 + DR, BUFFER
    bench[stream + CR] = ENABLED | control
    bench[USART6 + BRR], bench[USART6 + CR1], bench[USART6 + CR3] = 84, RECEIVING, BY_DMA


# DMA


def test_a_circular_transfer_begins_again_where_it_began_and_interrupts_each_round(bench: Bench) -> None:
    stream = stream_of(1, 1)
    receive_by_dma(bench, 4, CIRCULAR | INCREMENT | COMPLETE_IE)
    for fed, left, memory in ((b"abc", 1, b"abc\0"), (b"d", 4, b"abcd"), (b"efg", 1, b"efgd")):
        bench.chip.feed(6, fed)
        bench.wait(BYTE_US * len(fed) + 1)
        assert (bench[stream + NDTR], bench.chip.read(BUFFER, 4)) == (left, memory)
    assert bench[stream + CR] & ENABLED
    assert bench[DMAS[1]] >> 11 & 1
    assert bench.is_pending(57)
    bench[DMAS[1] + 8] = 1 << 11
    assert bench[DMAS[1]] == 0
    bench.chip.feed(6, b"hij")
    bench.wait(BYTE_US * 3 + 1)
    assert (bench[stream + NDTR], bench.chip.read(BUFFER, 8)) == (2, b"ijgh\0\0\0\0")
    assert bench[DMAS[1]] >> 11 & 1


def test_a_transfer_that_is_not_circular_ends(bench: Bench) -> None:
    stream = stream_of(1, 1)
    receive_by_dma(bench, 2, INCREMENT)
    bench.chip.feed(6, b"abc")
    bench.wait(BYTE_US * 3 + 1)
    assert (bench[stream + CR] & ENABLED, bench[stream + NDTR]) == (0, 0)
    assert bench.chip.read(BUFFER, 3) == b"ab\0"
    assert bench[USART6 + SR] & RXNE
    assert bench[USART6 + DR] == ord("c")
    assert not bench.is_pending(57), "without TCIE"


def test_without_increment_all_bytes_go_to_one_place(bench: Bench) -> None:
    receive_by_dma(bench, 3, 0)
    bench.chip.feed(6, b"abc")
    bench.wait(BYTE_US * 3 + 1)
    assert bench.chip.read(BUFFER, 3) == b"c\0\0"


def test_items_are_set_until_the_first_has_moved(bench: Bench) -> None:
    stream = stream_of(1, 1)
    receive_by_dma(bench, 3, INCREMENT)
    bench[stream + NDTR] = 0x1_0005
    assert bench[stream + NDTR] == 5
    bench.chip.feed(6, b"a")
    bench.wait(BYTE_US + 1)
    bench[stream + NDTR] = 9
    assert bench[stream + NDTR] == 4
    bench[stream + CR] = 0
    bench[stream + NDTR] = 0
    bench[stream + CR] = ENABLED
    assert bench[stream + CR] == 0, "nothing to move"


@pytest.mark.long
@pytest.mark.parametrize("dma", [0, 1])
@pytest.mark.parametrize("number", range(8))
def test_each_stream_has_its_flag_and_its_interrupt(bench: Bench, dma: int, number: int) -> None:
    receive_by_dma(bench, 1, COMPLETE_IE, stream_of(dma, number))
    other = stream_of(dma, (number + 1) % 8)  # complete, too: it is switched off before its end
    bench[other + NDTR], bench[other + PAR], bench[other + CR] = 1, 0x4000_0000, ENABLED
    bench[other + CR] = 0
    bench.chip.feed(6, b"a")
    bench.wait(BYTE_US + 1)
    places = {DMAS[dma] + at // 4 * 4: 0 for at in (number, (number + 1) % 8)}
    for at in (number, (number + 1) % 8):
        places[DMAS[dma] + at // 4 * 4] |= 1 << COMPLETE_BITS[at % 4]
    assert {place: bench[place] for place in places} == places
    assert [irq for irqs in DMA_IRQS for irq in irqs if bench.is_pending(irq)] == [DMA_IRQS[dma][number]]
    mine = DMAS[dma] + number // 4 * 4
    bench[mine + 8] = 1 << COMPLETE_BITS[number % 4]
    assert bench[mine] == places[mine] & ~(1 << COMPLETE_BITS[number % 4]), "the other one's stays"


def test_a_stream_that_was_never_enabled_completes_nothing(bench: Bench) -> None:
    bench[stream_of(1, 1) + CR] = INCREMENT
    assert bench[DMAS[1]] == 0


@pytest.mark.parametrize(("control", "pending"), [(ERROR_IE, True), (COMPLETE_IE, False)])
def test_a_transfer_into_nothing_ends_with_an_error(bench: Bench, control: int, pending: bool) -> None:
    receive_by_dma(bench, 2, control)
    bench[stream_of(1, 1) + CR] = 0
    bench[DMAS[1] + 8] = 1 << 11
    bench[stream_of(1, 1) + M0AR] = 0x1000_0000  # the core-coupled memory is out of its reach
    bench[stream_of(1, 1) + CR] = ENABLED | control
    bench.chip.feed(6, b"a")
    bench.wait(BYTE_US + 1)
    assert bench[stream_of(1, 1) + CR] & ENABLED == 0
    assert bench[DMAS[1]] == 1 << 9
    assert bench.is_pending(57) is pending


# USART


@pytest.mark.long
@pytest.mark.parametrize("number", USARTS)
def test_each_usart_has_its_clock_and_its_interrupt(bench: Bench, number: int) -> None:
    base, irq, fast = USARTS[number]
    bench[base + SR], bench[base + BRR] = 0, 84 if fast else 42
    bench[base + CR1] = SENDING | TC  # TCIE has TC's place
    bench[base + DR] = ord("x")
    bench.wait(BYTE_US - 1)
    assert bench[base + SR] & TC == 0
    assert not [one for _, one, _ in USARTS.values() if bench.is_pending(one)]
    bench.wait(2)
    assert bench[base + SR] & TC
    assert [one for _, one, _ in USARTS.values() if bench.is_pending(one)] == [irq]
    assert bench.chip.sent(number) == b"x"


def test_sending_is_complete_when_the_last_byte_has_left(bench: Bench) -> None:
    bench[USART6 + BRR], bench[USART6 + CR1] = 84, SENDING
    bench[USART6 + DR] = ord("a")
    assert bench[USART6 + SR] & (TXE | TC) == TXE, "the register is free again: a is in the shifter"
    bench[USART6 + DR] = ord("b")
    assert bench[USART6 + SR] & (TXE | TC) == 0
    bench.wait(BYTE_US + 1)
    assert bench[USART6 + SR] & (TXE | TC) == TXE
    bench.wait(BYTE_US)
    assert bench[USART6 + SR] & (TXE | TC) == TXE | TC
    assert bench.chip.sent(6) == b"ab"


def test_writing_the_status_clears_only_what_software_may_clear(bench: Bench) -> None:
    bench[USART6 + BRR], bench[USART6 + CR1] = 84, RECEIVING | SENDING
    bench.chip.feed(6, b"ab")
    bench.wait(2 * BYTE_US + 1)
    assert bench[USART6 + SR] == TXE | TC | RXNE | ORE
    assert bench.chip.state.usart[5].overruns == 1
    bench[USART6 + SR] = ~TC & 0xFFFF_FFFF
    assert bench[USART6 + SR] == TXE | RXNE | ORE
    bench[USART6 + SR] = 0
    assert bench[USART6 + SR] == TXE | ORE
    assert (bench[USART6 + DR], bench[USART6 + SR]) == (ord("a"), TXE), "the second byte is lost"


@pytest.mark.parametrize("control", [0, 4, 1 << 13])
def test_a_receiver_that_is_off_takes_nothing(bench: Bench, control: int) -> None:
    bench[USART6 + BRR], bench[USART6 + CR1] = 84, control
    bench.chip.feed(6, b"ab")
    bench.wait(3 * BYTE_US)
    assert bench[USART6 + SR] == TXE | TC


@pytest.mark.long
def test_a_line_holds_4096_bytes_in_each_direction(bench: Bench) -> None:
    sent = np.random.default_rng(1).bytes(4100)
    bench[USART6 + BRR], bench[USART6 + CR1] = 8, RECEIVING | SENDING
    for byte in sent:
        bench[USART6 + DR] = byte
        bench.wait(1)
    assert bench.chip.sent(6) == sent[:4096]
    assert bench.chip.sent(6) == b""
    bench[USART6 + BRR] = 9
    assert bench.chip.feed(6, sent) == 4096
    arrived = []
    for _ in range(4500):
        bench.wait(1)
        if bench[USART6 + SR] & RXNE:
            arrived.append(bench[USART6 + DR])
        if len(arrived) == 10:
            assert bench.chip.feed(6, sent[4096:] + sent) == 10
            arrived.append(-1)
    assert bytes(one for one in arrived if one >= 0) == sent[:4096] + (sent[4096:] + sent)[:10]


# I2C


def address(bench: Bench, device: int) -> None:
    bench[I2C1] = 1 << 10 | 1 << 8 | 1  # ACK, START
    bench.until(I2C1 + 0x14, 1)
    bench[I2C1 + 0x10] = device


@pytest.mark.parametrize(
    ("clock", "bit_us"), [(210, 10.0), (0x8000 | 35, 2.5), (0xC000 | 4, 100 / 42)], ids=["standard", "fast", "16/9"]
)  # fmt: skip
def test_a_bit_lasts_as_the_clock_register_sets(bench: Bench, clock: int, bit_us: float) -> None:
    bench.chip.add_device(1, 0x50, np.zeros(256, np.uint8))
    bench[I2C1 + 0x1C], bench[I2C1] = clock, 1
    address(bench, 0x50 << 1)
    bench.wait(int(9 * bit_us) - 1)
    assert bench[I2C1 + 0x14] & 2 == 0
    bench.wait(3)
    assert bench[I2C1 + 0x14] & 2


def test_without_last_the_byte_behind_dma_is_acknowledged_and_read(bench: Bench) -> None:
    bench.chip.add_device(1, 0x50, np.arange(256, dtype=np.uint8))
    stream = stream_of(0, 0)
    bench[I2C1 + 0x1C], bench[I2C1 + 4] = 35, 1 << 11
    bench[stream + NDTR], bench[stream + PAR], bench[stream + M0AR] = 3, I2C1 + 0x10, BUFFER
    bench[stream + CR] = ENABLED | INCREMENT
    address(bench, 0x50 << 1 | 1)
    bench.until(I2C1 + 0x14, 2)
    bench[I2C1 + 0x18]
    bench.wait(200)
    assert bench.chip.read(BUFFER, 4) == b"\0\1\2\0"
    assert (bench[I2C1 + 0x14], bench[I2C1 + 0x10]) == (1 << 6 | 4, 3)


def test_a_missing_acknowledgement_is_cleared_by_writing_0_and_nothing_else_is(bench: Bench) -> None:
    bench[I2C1 + 0x1C], bench[I2C1] = 35, 1
    address(bench, 0x41 << 1)
    bench.wait(100)
    bench[I2C1] = 1 << 8 | 1  # a start: SB
    bench.until(I2C1 + 0x14, 1)
    assert bench[I2C1 + 0x14] == 1 << 10 | 1
    bench[I2C1 + 0x14] = 0
    assert bench[I2C1 + 0x14] == 1


def test_bytes_by_registers_raise_and_clear_the_flags_of_rm0090(bench: Bench) -> None:
    """A write and a read, figures 241 to 244: a full shift register is BTF until the data register is used."""
    memory = np.arange(256, dtype=np.uint8)
    bench.chip.add_device(1, 0x50, memory)
    bench[I2C1 + 0x1C], bench[I2C1] = 35, 1
    sr1, data, byte_us = I2C1 + 0x14, I2C1 + 0x10, 16
    sb, found, btf, rxne, txe = 1, 2, 4, 1 << 6, 1 << 7
    address(bench, 0x50 << 1)
    bench.until(sr1, found)
    assert bench[I2C1 + 0x18] == 7  # master, busy, transmitter
    flags = [bench[sr1]]
    for byte in (5, 99, 98):  # the place, then two bytes
        bench[data] = byte
        flags.append(bench[sr1])
        bench.wait(byte_us)
        flags.append(bench[sr1])
    assert flags == [txe, *[txe, txe | btf] * 3]
    bench[data], bench[data] = 97, 96  # one in each register
    assert bench[sr1] == 0
    bench.until(sr1, txe)
    assert bench[sr1] == txe
    bench.until(sr1, btf)
    assert memory[5:9].tolist() == [99, 98, 97, 96]
    bench[I2C1] = 1 << 10 | 1 << 8 | 1  # start again, to read with acknowledgement
    bench.until(sr1, sb)
    bench[data] = 0x50 << 1 | 1
    bench.until(sr1, found)
    assert bench[I2C1 + 0x18] == 3
    read, flags = [], []
    for _ in range(2):
        bench.wait(3 * byte_us)  # the second byte waits in the shift register
        flags.append(bench[sr1])
        read.append(bench[data])
        flags.append(bench[sr1])
    bench[I2C1] = 1 << 9 | 1
    assert (read, flags) == ([9, 10], [rxne | btf, rxne] * 2)


def test_dma_cannot_reach_the_core_coupled_memory(bench: Bench) -> None:
    stream = stream_of(1, 1)
    receive_by_dma(bench, 4, INCREMENT)
    bench[stream + M0AR] = CCM
    bench.chip.feed(6, b"a")
    bench.wait(BYTE_US + 1)
    assert not bench[stream + CR] & ENABLED
    assert bench[DMAS[1]] == 1 << 9  # TEIF1
    assert bench.chip.read(CCM, 1) == b"\0"


@pytest.mark.long
@pytest.mark.parametrize("number", [1, 2, 3])
def test_transfers_on_i2c_move_the_bytes_of_a_model(number: int) -> None:
    """Writes and reads by registers or DMA, behind a stop or a repeated start; a pointer goes on behind what was used."""
    base, bench, rng = 0x4000_5400 + 0x400 * (number - 1), Bench(), np.random.default_rng(number)
    sr1, data = base + 0x14, base + 0x10
    # Address: bytes of an address in it, whether each byte has its own, its memory.
    kinds = {0x50: (1, False, 256), 0x51: (2, False, 700), 0x29: (1, True, 64)}
    memories = {at: rng.integers(0, 256, size, np.uint8) for at, (_, _, size) in kinds.items()}
    models, pointers = {at: memory.tolist() for at, memory in memories.items()}, dict.fromkeys(kinds, 0)
    for at, (length, pairs, _) in kinds.items():
        bench.chip.add_device(number, at, memories[at], length, pairs)
    bench[base + 0x1C], bench[base] = 0x8000 | 4, 1
    stopped = True
    for _ in range(120):
        at, reads = int(rng.choice((*kinds, 0x10))), bool(rng.random() < 0.5)
        bench[base] = 1 << 10 | 1 << 8 | 1  # ACK, START
        bench.until(sr1, 1)
        assert bench[sr1] == 1
        assert bench[base + 0x18] == 3
        bench[data] = at << 1 | reads
        bench.wait(10)
        if at not in kinds:
            assert bench[sr1] == 1 << 10
            bench[sr1] = 0
        elif reads:
            (length, _, size), by_dma = kinds[at], bool(rng.random() < 0.5)
            count = int(rng.choice((1, 2, 3, 300 if by_dma and at == 0x51 else 7)))
            expected = [models[at][(pointers[at] + one) % size] for one in range(count)]
            pointers[at] += count
            if by_dma:
                stream = stream_of(0, 3)
                bench[DMAS[0] + 8] = 1 << 27
                bench[stream + NDTR], bench[stream + PAR], bench[stream + M0AR] = count, data, BUFFER
                bench[base + 4], bench[stream + CR] = 1 << 12 | 1 << 11, ENABLED | INCREMENT
                bench[base + 0x18]
                bench.wait(3 * count + 20)
                bench[base + 4] = 0
                assert list(bench.chip.read(BUFFER, count)) == expected
            else:
                found = []
                bench[base] = (count > 1) << 10 | 1
                bench[base + 0x18]
                while len(found) < count:
                    bench.until(sr1, 1 << 6)
                    found.append(bench[data])
                    bench[base] = (len(found) < count - 1) << 10 | 1
                assert found == expected
        else:
            length, pairs, size = kinds[at]
            place, written = int(rng.integers(0, size)), rng.integers(0, 256, rng.integers(0, 5)).tolist()
            sent = list(place.to_bytes(length, "big"))
            for one, byte in enumerate(written):
                sent += [(place + 5 * one) % size] * (pairs and one > 0) + [byte]
                models[at][(place + (5 if pairs else 1) * one) % size] = byte
            pointers[at] = (
                (place + 5 * max(len(written) - 1, 0)) % size + bool(written)
                if pairs
                else place + len(written)
            )
            bench[base + 0x18]
            for byte in sent:
                bench.until(sr1, 1 << 7)
                bench[data] = byte
            bench.until(sr1, 4)
        stopped = bool(rng.random() < 0.6)
        if stopped:
            bench[base] = 1 << 9 | 1
            bench.wait(2)
            assert (bench[base], bench[sr1], bench[base + 0x18]) == (1, 0, 0)
        assert {one: memory.tolist() for one, memory in memories.items()} == models


def test_a_start_waits_for_the_stop_in_progress(bench: Bench) -> None:
    bench.chip.add_device(1, 0x50, np.zeros(256, np.uint8))
    bench[I2C1 + 0x1C], bench[I2C1] = 210, 1
    address(bench, 0x50 << 1)
    bench.until(I2C1 + 0x14, 2)
    bench[I2C1] = 1 << 9 | 1
    bench[I2C1] = 1 << 8 | 1
    assert bench[I2C1] == 1 << 9 | 1 << 8 | 1
    bench.wait(15)
    assert (bench[I2C1], bench[I2C1 + 0x14]) == (1 << 8 | 1, 0)
    bench.wait(20)
    assert (bench[I2C1], bench[I2C1 + 0x14]) == (1, 1)


@pytest.mark.parametrize("reset", [False, True])
def test_a_controller_that_is_switched_off_or_reset_forgets_its_transfer(bench: Bench, reset: bool) -> None:
    bench.chip.add_device(1, 0x50, np.zeros(256, np.uint8))
    bench[I2C1 + 0x1C], bench[I2C1 + 0x08], bench[I2C1] = 35, 0x5A, 1
    address(bench, 0x41 << 1)
    bench.wait(100)
    address(bench, 0x50 << 1 | 1)
    bench.until(I2C1 + 0x14, 2)
    bench[I2C1 + 0x18]
    bench.wait(100)
    assert bench[I2C1 + 0x14] == 1 << 10 | 1 << 6 | 4  # AF, RXNE, BTF
    bench[I2C1] = 1 << 15 if reset else 0
    expected = [1 << 15, 0, 0, 0, 0, 0, 0, 0, 0] if reset else [0, 0, 0x5A, 0, 0, 0, 35, 0, 0]
    for _ in range(2):
        assert [bench[I2C1 + 4 * one] for one in range(10) if one != 4] == expected  # all but the data
        bench.wait(100)
