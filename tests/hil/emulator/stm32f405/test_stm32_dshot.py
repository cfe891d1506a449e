"""Timers that DMA feeds, and ESCs at their outputs: RM0090 (chapters 10, 17, 18) and the description of DSHOT."""

from struct import pack, unpack

import numpy as np
import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.emulator.stm32f405.chip import RAM, SOFTWARE, StopReason
from hil.errors import LabError
from support.dshot import frame_of, period_us
from support.stm32_bench import Bench

CR1, DIER, EGR, CCMR1, CCER, CNT, PSC, ARR, CCR1 = 0x00, 0x0C, 0x14, 0x18, 0x20, 0x24, 0x28, 0x2C, 0x34
# Address, and cycles of a core clock per tick, by index.
TIMERS = {0: (0x4001_0000, 1), 1: (0x4000_0000, 2), 2: (0x4000_0400, 2), 3: (0x4000_0800, 2),
          4: (0x4000_0C00, 2), 7: (0x4001_0400, 1)}  # fmt: skip
STREAM = 0x4002_6010 + 0x18 * 6  # DMA1
TO_TIMER, TO_MEMORY = 1 << 10 | 1 << 6 | 1, 1 << 10 | 1
WORDS, HALF_WORDS = 2 << 13 | 2 << 11, 1 << 13 | 1 << 11
BUFFER = RAM + 0x2000
PERIOD = 280  # ticks: 300 kHz at 84 MHz
ZERO, ONE = 105, 210
WAIT_US = 16 * PERIOD // 84 + 7
BIT = 0.8 * PERIOD


class Wire(Bench):
    """An ESC with a motor of 12 poles at an output, by default TIM2_CH2."""

    def __init__(self, timer: int = 1, channel: int = 1) -> None:
        super().__init__()
        (self.timer, self.cycles), self.channel = TIMERS[timer], channel
        self.rpm = np.zeros(1)
        self.chip.add_esc(timer, channel, self.rpm, 12)
        self.esc, self.throttles = self.chip.state.esc[0], self.chip.state.compare[timer]

    @property
    def throttle(self) -> int:
        return int(self.throttles[self.channel])

    def _move(self, memory: bytes, count: int, control: int) -> None:
        self[STREAM] = self[self.timer + DIER] = 0
        self.chip.write(BUFFER, memory)
        self[STREAM + 4], self[STREAM + 8] = count, self.timer + CCR1 + 4 * self.channel
        self[STREAM + 0xC], self[STREAM] = BUFFER, control
        self[self.timer + DIER] = 1 << 9 + self.channel

    def send(self, frame: int, inverted: bool = False, bits: int = 16, size: int = WORDS) -> StopReason:
        pulses = [ONE if frame >> 15 - bit & 1 else ZERO for bit in range(bits)] + [0]
        self[self.timer + CR1] = self[self.timer + CNT] = self[self.timer + CCR1 + 4 * self.channel] = 0
        self[self.timer + ARR] = PERIOD - 1
        self[self.timer + CCMR1 + self.channel // 2 * 4] = 0x6868  # PWM, preloaded
        self[self.timer + CCER] = (3 if inverted else 1) << 4 * self.channel
        self._move(
            pack(f"<17{'I' if size == WORDS else 'H'}", *pulses, *[0] * (16 - bits)),
            bits + 1,
            TO_TIMER | size,
        )
        self[self.timer + CR1] = 1
        return self.wait(WAIT_US)

    def capture(self, edges: int = 11, selected: int = 0x0101) -> list[int]:
        """Return the counts at the edges of the next 100 us, by default both kinds (1: rising, 3: falling)."""
        self[self.timer + CR1] = self[self.timer + CNT] = 0
        self[self.timer + ARR] = 10_000
        self[self.timer + CCMR1 + self.channel // 2 * 4] = selected
        self[self.timer + CCER] = edges << 4 * self.channel
        self._move(bytes(100), 25, TO_MEMORY | WORDS)
        self[self.timer + CR1] = 1
        self.wait(100)
        return list(unpack("<25I", self.chip.read(BUFFER, 100))[: 25 - self[STREAM + 4]])


@pytest.fixture
def wire() -> Wire:
    return Wire()


def test_a_frame_of_sixteen_pulses_is_a_throttle(wire: Wire) -> None:
    assert frame_of(1046) == 0b1000_0010_1100_0110  # the description's example
    wire.send(frame_of(0))
    assert wire.send(frame_of(1046)) & StopReason.COMPARE
    assert wire.throttle == 1046
    assert not wire.send(frame_of(1046)) & StopReason.COMPARE, "the same again"
    wire.send(frame_of(2047, request=1))
    assert wire.throttle == 2047


@pytest.mark.long
@pytest.mark.parametrize("bit", range(16))
def test_a_frame_with_a_wrong_bit_is_ignored(wire: Wire, bit: int) -> None:
    wire.send(frame_of(0))
    wire.send(frame_of(1046))
    wire.send(frame_of(700) ^ 1 << bit)
    assert (wire.throttle, wire.esc.refused) == (1046, 1)


@pytest.mark.parametrize("bits", [8, 15])
def test_a_part_of_a_frame_is_ignored_and_the_next_frame_is_whole(wire: Wire, bits: int) -> None:
    wire.send(frame_of(0))
    wire.send(frame_of(1046), bits=bits)
    assert (wire.throttle, wire.esc.refused) == (0, 0)
    wire.send(frame_of(1046))
    assert wire.throttle == 1046


@pytest.mark.parametrize(("inverted", "checksum", "taken"), [
    (True, True, 700), (True, False, 0), (False, True, 0), (False, False, 700),
])  # fmt: skip
def test_levels_and_checksum_are_inverted_together(
    wire: Wire, inverted: bool, checksum: bool, taken: int
) -> None:
    wire.send(frame_of(0, inverted), inverted)
    wire.send(frame_of(700, checksum), inverted)
    assert wire.throttle == taken


def test_commands_stop_the_motor(wire: Wire) -> None:
    for throttle, taken in ((0, 0), (48, 48), (47, 0), (2000, 2000), (1, 0)):
        wire.send(frame_of(throttle))
        assert wire.throttle == taken


def test_no_motor_starts_before_it_was_told_to_stand(wire: Wire) -> None:
    wire.send(frame_of(700))
    assert wire.throttle == 0
    wire.send(frame_of(0))
    wire.send(frame_of(700))
    assert wire.throttle == 700


def test_a_silent_wire_stops_the_motor_which_then_waits_for_a_stop(wire: Wire) -> None:
    wire.send(frame_of(0))
    wire.send(frame_of(700))
    assert not wire.wait(150_000) & StopReason.COMPARE
    assert wire.throttle == 700
    assert wire.wait(20_000) & StopReason.COMPARE
    assert wire.throttle == 0
    wire.send(frame_of(700))
    assert wire.throttle == 0


def test_a_reset_of_the_chip_is_silence_for_the_esc(wire: Wire) -> None:
    wire.send(frame_of(0))
    wire.send(frame_of(700))
    wire.chip.reset(SOFTWARE)
    assert not wire.wait(150_000) & StopReason.COMPARE
    assert wire.wait(20_000) & StopReason.COMPARE
    assert wire.throttle == 0


@pytest.mark.long
@pytest.mark.parametrize("size", [WORDS, HALF_WORDS], ids=["words", "half words"])
@pytest.mark.parametrize("channel", range(4))
@pytest.mark.parametrize("timer", TIMERS)
def test_each_channel_has_its_request_and_its_register(timer: int, channel: int, size: int) -> None:
    wire = Wire(timer, channel)
    wire.send(frame_of(0), size=size)
    wire.send(frame_of(700), size=size)
    assert [wire.throttles[at] for at in range(4)] == [700 if at == channel else 0 for at in range(4)]


def test_a_word_moves_once_a_period_and_only_while_its_request_is_enabled(wire: Wire) -> None:
    wire.send(0, bits=1)
    wire._move(bytes(64), 16, TO_TIMER | WORDS)
    wire.wait(7 * PERIOD // 84)
    assert wire[STREAM + 4] in (9, 10)
    for selected in (0x0101, 0x0202, 0x0303):  # an input, of whichever pin, asks for no word
        wire[wire.timer + CCMR1], left = selected, wire[STREAM + 4]
        wire.wait(5 * PERIOD // 84)
        assert wire[STREAM + 4] == left
    wire[wire.timer + CCMR1] = 0x6868
    wire[wire.timer + DIER], left = 0, wire[STREAM + 4]
    wire.wait(100)
    assert wire[STREAM + 4] == left


def test_without_an_esc_the_words_are_compare_counts() -> None:
    wire = Wire(1, 1)
    wire.channel = 3
    assert wire.send(frame_of(0)) & StopReason.COMPARE
    wire._move(pack("<2I", 77, 99), 2, TO_TIMER | WORDS)
    wire.wait(20)
    assert (wire.throttle, wire[wire.timer + CCR1 + 12]) == (99, 99)


def test_an_inverted_frame_is_answered_with_the_motors_period(wire: Wire) -> None:
    """Nine bits of it, as fine as they can be, also where an exponent ends."""
    ends = [512.0 * 2**exponent - part for exponent in range(7) for part in (0.25, 0.0)]
    for us in (*ends, *np.random.default_rng(2).uniform(100, 60_000, 40)):
        wire.rpm[0] = 60e6 / (us * 6)  # 6 pairs of poles
        wire.send(frame_of(0, True), True)
        edges = wire.capture()
        assert 20 < edges[0] / 84 + 7 < 40, "30 us behind the frame"
        coarse = 2 ** max(int(us + 1e-6).bit_length() - 9, 0)
        assert period_us(edges, BIT) == int(us + 1e-6) // coarse * coarse


@pytest.mark.parametrize("rpm", [0.0, 100.0])
def test_a_standing_motor_has_the_longest_period(wire: Wire, rpm: float) -> None:
    wire.rpm[0] = rpm
    wire.send(frame_of(0, True), True)
    assert period_us(wire.capture(), BIT) == 511 << 7


def test_edges_are_captured_by_their_kind(wire: Wire) -> None:
    wire.rpm[0] = 2300.0
    found = {}
    for kind in (11, 1, 3):
        wire.send(frame_of(0, True), True)
        found[kind] = wire.capture(kind)
    assert found[11][0::2] == pytest.approx(found[3], abs=5), "the first one falls"
    assert found[11][1::2] == pytest.approx(found[1], abs=5)
    wire.send(frame_of(0, True), True)
    assert wire.capture(selected=0x0202) == [], "the pin of another channel"


def test_a_plain_or_refused_frame_is_not_answered(wire: Wire) -> None:
    wire.send(frame_of(0))
    assert wire.capture() == []
    wire.send(frame_of(0, True) ^ 1, True)
    assert wire.capture() == []


def test_there_is_room_for_four() -> None:
    wire = Wire()
    for channel in (0, 2, 3):
        wire.chip.add_esc(1, channel, wire.rpm, 12)
    with pytest.raises(LabError, match="more ESCs"):
        wire.chip.add_esc(2, 0, wire.rpm, 12)
