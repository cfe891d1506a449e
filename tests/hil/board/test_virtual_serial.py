"""The serial line: times by hand (10 bits per byte), chunks, bounded buffers, wrong bits by the binomial law, the cable."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.board.config import SerialConfig
from hil.board.uart import VirtualSerial
from hil.emulator.events import EventQueue


class LineWithEnds:
    """A line, and what arrived at both ends: (when, bytes). The board reads at every interrupt unless it is deaf."""

    def __init__(self, seed=1, **config):
        self.events = EventQueue()
        self.line = VirtualSerial(SerialConfig(**config), self.events, np.random.default_rng(seed))
        self.on_board, self.on_ground = [], []
        self.deaf = False
        self.line.connect(self.interrupt, lambda now_us, data: self.on_ground.append((now_us, data)))

    def interrupt(self, now_us):
        if not self.deaf:
            self.on_board.append((now_us, self.line.read()))

    def uplink(self, now_us, data):
        self.events.at(now_us, lambda now_us: self.line.uplink(now_us, data))

    def write(self, now_us, data):
        self.events.at(now_us, lambda now_us: self.line.write(now_us, data))

    def run(self, until_us=1_000_000_000):
        self.events.run(until_us)
        return self


def joined(arrived):
    return b"".join(data for _, data in arrived)


@pytest.mark.parametrize(
    ("baud", "size", "arrival_us"),
    [
        # host 1000; size * 10 bits, then 10 bits of silence; rounded up
        (57_600, 20, 1000 + 3646),  # 21 * 173.61
        (115_200, 20, 1000 + 1823),  # 21 * 86.806
        (921_600, 20, 1000 + 228),  # 21 * 10.851
        (3_000_000, 2, 1000 + 10),
    ],
)
def test_a_short_message_arrives_after_its_bytes_and_one_of_silence(baud, size, arrival_us):
    bench = LineWithEnds(baud=baud)
    bench.uplink(0, b"u" * size)
    bench.write(0, b"d" * size)
    bench.run()
    assert bench.on_board == [(arrival_us, b"u" * size)]
    assert bench.on_ground == [(arrival_us, b"d" * size)]


def test_a_long_message_arrives_in_chunks_of_the_threshold():
    bench = LineWithEnds(baud=1_000_000, host_latency_us=0)
    message = bytes(range(150))
    bench.uplink(500, message)
    bench.run()
    assert bench.on_board == [
        (500 + 640, message[:64]),
        (500 + 1280, message[64:128]),
        (500 + 1510, message[128:]),  # 1500 and the silence
    ]


@pytest.mark.parametrize(
    ("writes", "chunks"),
    [
        # the second one waits for the first until 400
        ([(0, b"a" * 40), (100, b"b" * 40)], [(640, b"a" * 40 + b"b" * 24), (810, b"b" * 16)]),
        ([(0, b"a" * 40), (100, b"b" * 24)], [(640, b"a" * 40 + b"b" * 24)]),  # nothing is left over
        # a gap shorter than a byte does not end a chunk
        ([(0, b"a" * 10), (109, b"b" * 10), (300, b"c")], [(219, b"a" * 10 + b"b" * 10), (320, b"c")]),
    ],
)
def test_messages_without_a_gap_share_chunks(writes, chunks):
    bench = LineWithEnds(baud=1_000_000, host_latency_us=0)
    for at_us, data in writes:
        bench.write(at_us, data)
    bench.run()
    assert bench.on_ground == chunks


@pytest.mark.long
def test_line_load_and_latency_are_counted():
    bench = LineWithEnds(baud=57_600)
    for number in range(1000):
        bench.write(number * 6000, bytes(28))
    counters = bench.run().line.down
    assert counters.busy_us == pytest.approx(28_000 * 10 / 57_600 * 1e6, abs=1)
    assert counters.deliveries == 1000
    assert counters.latency_sum_us == pytest.approx(1000 * (29 * 173.611 + 1000), abs=1000)


@pytest.mark.parametrize(("size", "line_us"), [(20, 210), (64, 640), (100, 640 + 1010)])
def test_the_latency_of_a_chunk_counts_from_its_sender(size, line_us):
    bench = LineWithEnds(baud=1_000_000)
    for sent_us in (3_000, 50_000):
        bench.uplink(sent_us, bytes(size))
        bench.write(sent_us, bytes(size))
    line = bench.run().line
    chunks = len(bench.on_board) // 2
    assert line.up.latency_sum_us == line.down.latency_sum_us == 2 * (line_us + 1000 * chunks)
    assert line.up.deliveries == line.down.deliveries == 2 * chunks


def test_rounding_does_not_add_up():
    bench = LineWithEnds(baud=921_600, host_latency_us=0)
    for number in range(1000):
        bench.write(number, bytes(1))
    bench.run()
    assert bench.on_ground[-1][0] == -(-(1000 + 1) * 10_000_000 // 921_600)


def test_a_full_transmit_buffer_takes_nothing_of_a_message_that_does_not_fit():
    bench = LineWithEnds(baud=1_000_000, transmit_buffer=512)
    line = bench.line
    assert line.write(0, bytes(300))
    assert not line.write(0, bytes(213))
    assert line.write(0, bytes(212))
    assert not line.write(0, bytes(1))
    bench.run(9)
    assert not line.write(9, bytes(1))  # the first byte is on its way until 10
    bench.run(10)
    assert line.write(10, bytes(1))
    assert not line.write(10, bytes(1))
    bench.run()
    assert (line.down.sent_bytes, line.down.dropped_bytes) == (513, 213 + 1 + 1 + 1)


def test_the_host_keeps_one_page_and_drops_the_rest():
    bench = LineWithEnds(baud=9600)
    message = bytes(number % 251 for number in range(5000))
    bench.uplink(0, message)
    bench.run()
    assert joined(bench.on_board) == message[:4096]
    assert bench.line.up.dropped_bytes == 5000 - 4096


def test_a_deaf_board_overruns_and_counts_it():
    bench = LineWithEnds(baud=1_000_000, receive_buffer=128)
    bench.deaf = True
    message = bytes(range(200))
    bench.uplink(0, message)
    bench.run(20_000)
    assert bench.line.overruns == 200 - 128
    assert bench.line.up.delivered_bytes == 128
    assert bench.line.read() == message[:128]
    bench.uplink(20_000, b"again")
    bench.run()
    assert bench.line.read() == b"again"
    assert bench.line.read() == b""


@pytest.mark.parametrize("rate", [1e-4, 1e-2, pytest.param(0.5, marks=pytest.mark.long)])
@pytest.mark.parametrize("direction", ["uplink", "downlink"])
def test_wrong_bits_follow_the_binomial_law_and_are_counted(direction, rate):
    bench = LineWithEnds(**{f"{direction}_bit_error_rate": rate}, baud=3_000_000)
    size, count = 100, 2000
    for number in range(count):
        bench.uplink(number * 1000, b"\x5a" * size)
        bench.write(number * 1000, b"\x5a" * size)
    bench.run()
    bits = {
        "uplink": np.unpackbits(np.frombuffer(joined(bench.on_board), np.uint8) ^ 0x5A),
        "downlink": np.unpackbits(np.frombuffer(joined(bench.on_ground), np.uint8) ^ 0x5A),
    }
    total = 8 * size * count
    wrong = bits.pop(direction)
    assert wrong.size == total
    assert not next(iter(bits.values())).any()  # the other direction
    assert wrong.sum() == pytest.approx(total * rate, abs=4 * np.sqrt(total * rate * (1 - rate)))
    counters = bench.line.up if direction == "uplink" else bench.line.down
    assert counters.wrong_bits == wrong.sum()
    if rate == 1e-2:  # gaps are geometric: no memory from one chunk or byte to the next
        gaps = np.diff(np.flatnonzero(wrong))
        assert np.mean(gaps == 1) == pytest.approx(rate, abs=4 * np.sqrt(rate / gaps.size))
        assert np.mean(gaps) == pytest.approx(1 / rate, rel=4 / np.sqrt(gaps.size))


def test_wrong_bits_begin_and_end_in_flight():
    bench = LineWithEnds(baud=1_000_000, host_latency_us=0)
    bench.line.downlink_bit_error_rate = 1e-12  # the next wrong bit is far away
    bench.write(0, bytes(30))
    bench.run(5_000)
    bench.line.downlink_bit_error_rate = 1.0
    bench.write(5_000, bytes(30))
    bench.run(10_000)
    bench.line.downlink_bit_error_rate = 0.0
    bench.write(10_000, bytes(30))
    bench.run()
    assert [data for _, data in bench.on_ground] == [bytes(30), b"\xff" * 30, bytes(30)]


def test_bytes_on_a_pulled_cable_are_lost_and_counted():
    bench = LineWithEnds(baud=1_000_000)
    bench.line.connected = False
    bench.uplink(0, b"lost")
    bench.write(0, b"lost, too")
    bench.run(10_000)
    bench.line.connected = True
    bench.uplink(10_000, b"up")
    bench.write(10_000, b"down")
    bench.run()
    assert (joined(bench.on_board), joined(bench.on_ground)) == (b"up", b"down")
    assert (bench.line.up.cut_bytes, bench.line.down.cut_bytes) == (4, 9)


messages = st.lists(st.tuples(st.integers(0, 3000), st.binary(min_size=1, max_size=300)), max_size=40)


@pytest.mark.long
@given(
    up=messages,
    down=messages,
    baud=st.sampled_from([9600, 57_600, 921_600, 3_000_000]),
    threshold=st.integers(1, 128),
    cuts=st.lists(st.integers(0, 60_000), max_size=4),
    readings=st.lists(st.booleans(), min_size=1, max_size=50),
)
def test_bytes_keep_their_order_and_counters_add_up(up, down, baud, threshold, cuts, readings):
    bench = LineWithEnds(baud=baud, interrupt_threshold=threshold, receive_buffer=128, transmit_buffer=512)
    line, received, reads = bench.line, bytearray(), 0

    def interrupt(now_us):
        nonlocal reads
        reads += 1
        if readings[reads % len(readings)]:
            received.extend(line.read())

    def toggle(now_us):
        line.connected = not line.connected

    line.connect(interrupt, lambda now_us, data: bench.on_ground.append((now_us, data)))
    sent_up, taken_down, refused = bytearray(), bytearray(), 0
    for wait_us, data in up:
        sent_up += data
        bench.uplink(wait_us, data)
    for cut_us in cuts:
        bench.events.at(cut_us, toggle)
    now_us = 0
    for wait_us, data in down:
        now_us += wait_us
        bench.events.run(now_us)
        if line.write(now_us, data):
            taken_down += data
        else:
            refused += len(data)
    bench.run()
    received += line.read()

    for counters in (line.up, line.down):
        arrived = counters.delivered_bytes + counters.overrun_bytes + counters.cut_bytes
        assert arrived == counters.sent_bytes
        assert counters.busy_us == counters.sent_bytes * 10_000_000 // baud
    assert line.up.sent_bytes + line.up.dropped_bytes == len(sent_up)
    assert line.up.delivered_bytes == len(received)
    assert (line.down.sent_bytes, line.down.dropped_bytes) == (len(taken_down), refused)
    assert line.down.delivered_bytes == len(joined(bench.on_ground))
    if not cuts:
        assert joined(bench.on_ground) == taken_down
        if not line.overruns and not line.up.dropped_bytes:
            order = b"".join(data for _, data in sorted(up, key=lambda message: message[0]))
            assert received == order
    assert [when for when, _ in bench.on_ground] == sorted(when for when, _ in bench.on_ground)
    assert all(len(data) <= threshold for _, data in bench.on_ground)
