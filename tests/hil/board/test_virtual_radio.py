"""The radio link: times of the reference, loss by the geometric law, exactly once, in order, bounded."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_station.config import StationConfig
from hil.board.radio import VirtualRadio
from hil.emulator.crazyflie.config import RadioConfig
from hil.emulator.crazyflie.shockburst import air_us, exchange_us, syslink_us
from hil.emulator.events import EventQueue

QUIET = {"uplink_loss": 0.0, "downlink_loss": 0.0, "usb_jitter_us": 0}
POSE = 31  # bytes of a correction
TELEMETRY = 29


class RadioWithEnds:
    """A radio, and what arrived at both ends: (when, packet)."""

    def __init__(self, seed=1, **config):
        self.events = EventQueue()
        self.radio = VirtualRadio(RadioConfig(**config), self.events, np.random.default_rng(seed))
        self.on_board, self.on_ground = [], []
        self.radio.connect(
            lambda now_us, data: self.on_board.append((now_us, data)),
            lambda now_us, data: self.on_ground.append((now_us, data)),
        )

    def pose_every(self, period_us, count, size=POSE):
        for number in range(count):
            data = number.to_bytes(2, "little").ljust(size, b"\0")
            self.events.at(number * period_us, lambda now_us, data=data: self.radio.uplink(now_us, data))

    def telemetry_every(self, period_us, count, burst=1, size=TELEMETRY):
        for number in range(count):
            data = number.to_bytes(2, "little").ljust(size, b"\0")
            planned_us = number // burst * period_us
            self.events.at(planned_us, lambda now_us, data=data: self.radio.downlink(now_us, data))


def numbers(arrived):
    return [int.from_bytes(data[:2], "little") for _, data in arrived]


def test_air_times_are_those_of_the_reference():
    assert exchange_us(1, 1, 2_000_000) == pytest.approx(341, abs=1)
    assert exchange_us(31, 31, 2_000_000) == pytest.approx(580, abs=2)
    assert exchange_us(31, 31, 250_000) == pytest.approx(2800, rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize(
    ("size", "bits_per_second", "per_second"),
    [
        (4, 2_000_000, 1148),
        (28, 2_000_000, 915),
        (4, 1_000_000, 1016),
        (28, 1_000_000, 711),
        (28, 250_000, 302),
    ],
)
def test_saturated_link_is_as_fast_as_cflibs_echo_over_an_emulated_dongle(size, bits_per_second, per_second):
    bench = RadioWithEnds(**QUIET, bits_per_second=bits_per_second)
    bench.pose_every(300, 10_000, size + 1)
    bench.telemetry_every(300, 10_000, size=size + 1)
    bench.events.run(3_000_000)
    assert len(bench.on_board) / 3 == pytest.approx(per_second, rel=0.06)
    assert len(bench.on_ground) / 3 == pytest.approx(per_second, rel=0.06)


@pytest.mark.long
def test_usb_jitter_lengthens_every_exchange_by_half_of_it():
    bench = RadioWithEnds(**QUIET | {"usb_jitter_us": 400})
    bench.pose_every(300, 10_000)
    bench.events.run(3_000_000)
    expected = 3_000_000 / (500 + 200 + exchange_us(POSE, 3, 2_000_000))
    assert len(bench.on_board) == pytest.approx(expected, rel=0.004)


def test_first_packet_follows_the_poll_under_way():
    bench = RadioWithEnds(**QUIET)
    bench.events.run(100)
    bench.radio.uplink(100, bytes(POSE))
    bench.events.run(10_000)
    poll_us = 250 + exchange_us(1, 3, 2_000_000) + 250
    assert bench.on_board == [(poll_us + 250 + 130 + 160 + 370, bytes(POSE))]  # USB, turn, air, syslink
    idle_us = poll_us + 500 + exchange_us(POSE, 3, 2_000_000)
    second = RadioWithEnds(**QUIET)
    for at_us in (100, idle_us + 50):
        second.events.at(at_us, lambda now_us: second.radio.uplink(now_us, bytes(POSE)))
    second.events.run(10_000)
    assert [at_us for at_us, _ in second.on_board] == [begin_us + poll_us + 910 for begin_us in (0, idle_us)]


def test_answer_of_the_poll_under_way_carries_what_is_ready_in_time():
    bench = RadioWithEnds(**QUIET)
    bench.radio.downlink(0, bytes(TELEMETRY))  # 350 us of syslink; the poll is heard after 250 + 130 + 40
    bench.events.run(10_000)
    assert bench.on_ground == [(420 + 130 + air_us(TELEMETRY, 2_000_000) + 250, bytes(TELEMETRY))]
    late = RadioWithEnds(**QUIET)
    late.events.run(100)
    late.radio.downlink(100, bytes(TELEMETRY))
    late.events.run(10_000)
    assert late.on_ground[0][0] == bench.on_ground[0][0] + 500 + exchange_us(1, 3, 2_000_000)


def test_on_a_busy_link_no_answer_carries_what_the_radio_has_not_taken_in_yet():
    bench = RadioWithEnds(**QUIET)
    bench.pose_every(500, 1000)
    bench.telemetry_every(1777, 250)
    bench.events.run(600_000)
    latencies = [
        arrived_us - 1777 * n for (arrived_us, _), n in zip(bench.on_ground, range(250), strict=True)
    ]
    shortest_us = syslink_us(bytes(TELEMETRY)) + 130 + air_us(TELEMETRY, 2_000_000) + 250
    assert shortest_us <= min(latencies) < shortest_us + 20


def test_lone_packets_meet_the_polls_at_every_phase():
    bench = RadioWithEnds(**QUIET)
    bench.pose_every(20_000, 2000)
    bench.events.run(50_000_000)
    latencies = [arrived_us - 20_000 * number for number, (arrived_us, _) in enumerate(bench.on_board)][1:]
    shortest, poll_us = 250 + 130 + 160 + 370, 500 + exchange_us(1, 3, 2_000_000)
    assert shortest <= min(latencies) < shortest + 10
    assert shortest + poll_us - 10 < max(latencies) <= shortest + poll_us
    assert np.mean(latencies) == pytest.approx(shortest + poll_us / 2, abs=4 * poll_us / np.sqrt(12 * 2000))


def test_a_quiet_link_plans_nothing():
    bench = RadioWithEnds()
    assert bench.events.next_us is None
    bench.pose_every(20_000, 10)
    bench.telemetry_every(20_000, 40, burst=4)
    bench.events.run(1_000_000)
    assert bench.events.next_us is None
    assert (len(bench.on_board), len(bench.on_ground)) == (10, 40)


@pytest.mark.long
@pytest.mark.parametrize("loss", [0.05, 0.3, 0.6])
def test_loss_follows_the_geometric_law(loss):
    bench = RadioWithEnds(uplink_loss=loss, downlink_loss=loss / 2, usb_jitter_us=0)
    bench.pose_every(100, 20_000)  # saturated: no poll is drawn
    bench.events.run(2_000_000)
    air = bench.radio.air
    fail = 1 - (1 - loss) * (1 - loss / 2)
    unanswered = fail**4
    deviation = np.sqrt(unanswered * (1 - unanswered) / air.exchanges)
    assert air.unanswered / air.exchanges == pytest.approx(unanswered, abs=4 * deviation)
    repetitions = fail + fail**2 + fail**3  # of 3 possible ones, each needs all before it to fail
    assert air.retried / air.exchanges == pytest.approx(repetitions, abs=4 * 1.5 / np.sqrt(air.exchanges))


@pytest.mark.long
def test_wrong_bits_are_losses_by_the_length_of_the_packet():
    bench = RadioWithEnds(**QUIET | {"uplink_bit_error_rate": 1e-3, "downlink_bit_error_rate": 1e-3})
    bench.pose_every(100, 20_000)
    bench.events.run(2_000_000)
    air = bench.radio.air
    fail = 1 - (1 - 1e-3) ** (73 + 8 * POSE + 73 + 8 * 3)
    assert air.retried / air.exchanges == pytest.approx(
        fail + fail**2 + fail**3, abs=4 * 1.5 / np.sqrt(air.exchanges)
    )


def polled_latencies(loss, rng, count):
    """Another implementation: a host that really polls all the time, for lone packets 20 ms and a bit apart."""
    latencies, t = [], 0.0
    for number in range(1, count + 1):
        sent = number * 20_000 + rng.uniform(0, 5000)
        carried, size, heard_at = False, 1, None
        while heard_at is None:
            again = 130 + air_us(size, 2_000_000) + 500
            answered = False
            for failed in range(4):
                if rng.random() < loss:
                    continue
                if carried and heard_at is None:
                    heard_at = t + 250 + failed * again + 130 + air_us(size, 2_000_000)
                if rng.random() >= loss:
                    answered = True
                    break
            on_air = failed * again + exchange_us(size, 3, 2_000_000) if answered else 4 * again
            t += 250 + on_air + 250
            if answered and t >= sent:
                carried, size = True, POSE
        latencies.append(heard_at + 370 - sent)
    return latencies


@pytest.mark.long
@pytest.mark.parametrize("loss", [0.1, 0.3, 0.5])
def test_drawn_polls_delay_like_real_ones(loss):
    bench = RadioWithEnds(uplink_loss=loss, downlink_loss=loss, usb_jitter_us=0)
    count = 3000
    bench.pose_every(20_000, count)
    bench.events.run(20_000 * count + 1_000_000)
    ours = np.array([arrived_us - 20_000 * number for number, (arrived_us, _) in enumerate(bench.on_board)])
    theirs = np.array(polled_latencies(loss, np.random.default_rng(2), count))
    error = np.sqrt((ours.var() + theirs.var()) / count)
    assert ours.mean() == pytest.approx(theirs.mean(), abs=4 * error)
    assert np.quantile(ours, 0.9) == pytest.approx(np.quantile(theirs, 0.9), rel=0.12)


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**32), st.floats(0, 0.7), st.floats(0, 0.7), st.integers(0, 30_000),
    st.integers(0, 500), st.sampled_from([250_000, 2_000_000]),
)  # fmt: skip
def test_packets_arrive_at_most_once_and_in_order(seed, up_loss, down_loss, jitter_us, usb_us, rate):
    bench = RadioWithEnds(
        seed=seed, uplink_loss=up_loss, downlink_loss=down_loss, uplink_jitter_us=jitter_us, usb_us=usb_us,
        bits_per_second=rate,
    )  # fmt: skip
    bench.pose_every(7_000, 60)
    bench.telemetry_every(20_000, 100, burst=4)
    bench.events.run(60_000_000)
    radio = bench.radio
    for arrived, counters in ((bench.on_board, radio.up), (bench.on_ground, radio.down)):
        assert all(a < b for a, b in pairwise(numbers(arrived)))
        assert all(a <= b for (a, _), (b, _) in pairwise(arrived))
        assert counters.delivered == len(arrived)
    # in the end nothing is left under way
    assert radio.up.sent == radio.up.delivered + radio.up.dropped == 60
    assert radio.down.sent == radio.down.delivered == 100 - radio.down.dropped


def test_dead_air_bounds_both_queues_and_the_newest_corrections_survive():
    bench = RadioWithEnds(**QUIET)
    bench.radio.medium.uplink_loss = 1.0
    bench.pose_every(20_000, 50)
    bench.telemetry_every(20_000, 200, burst=4)
    bench.events.run(999_999)
    radio = bench.radio
    assert (bench.on_board, bench.on_ground) == ([], [])
    assert (radio.up.queue_high_water, radio.down.queue_high_water) == (4, 8)
    assert radio.down.dropped == 192
    assert radio.air.retried == 3 * radio.air.unanswered > 0
    assert not radio.downlink(999_999, bytes(TELEMETRY))
    radio.medium.uplink_loss = 0.0
    bench.events.run(2_000_000)
    assert numbers(bench.on_board)[-4:] == [46, 47, 48, 49]
    assert len(bench.on_board) <= 5  # and the one that was under way
    assert numbers(bench.on_ground) == list(range(8))
    longest_us = radio.up.latency_max_us, radio.down.latency_max_us
    assert min(longest_us) > 900_000
    for arrive in (radio.uplink, radio.downlink):
        arrive(2_000_000, bytes(TELEMETRY))
    bench.events.run(2_100_000)
    assert (radio.up.queue_high_water, radio.down.queue_high_water) == (4, 8)
    assert (radio.up.latency_max_us, radio.down.latency_max_us) == longest_us


def test_uplink_jitter_delays_within_its_bound_and_can_be_switched_in_flight():
    bench = RadioWithEnds(**QUIET)
    bench.radio.medium.uplink_jitter_us = 15_000
    bench.pose_every(20_000, 500)
    bench.events.run(9_999_999)
    latencies = [arrived_us - 20_000 * number for number, (arrived_us, _) in enumerate(bench.on_board)]
    assert max(latencies) < 15_000 + 2000
    assert np.std(latencies) == pytest.approx(15_000 / np.sqrt(12), rel=0.1)
    assert bench.radio.air.exchanges == 500
    up = bench.radio.up
    assert (up.latency_sum_us, up.latency_max_us) == (sum(latencies), max(latencies)), (
        "also of the wait at the host"
    )
    bench.radio.medium.uplink_jitter_us = 0
    bench.radio.uplink(9_999_999, bytes(POSE))
    bench.events.run(10_002_000)
    assert len(bench.on_board) == 501


@pytest.mark.long
def test_ground_station_expects_the_latency_that_this_link_has():
    bench = RadioWithEnds()
    bench.pose_every(20_000, 3000)
    bench.telemetry_every(20_000, 12_000, burst=4)
    bench.events.run(61_000_000)
    mean_us = bench.radio.up.latency_sum_us / bench.radio.up.delivered
    # Half a unit of the age on the wire.
    assert StationConfig().link_latency_us == pytest.approx(mean_us, abs=250)


@pytest.mark.parametrize("size", [0, 33])
def test_packets_that_the_radio_cannot_carry_are_refused(size):
    bench = RadioWithEnds()
    with pytest.raises(ValueError, match=r"1\.\.32"):
        bench.radio.uplink(0, bytes(size))
    with pytest.raises(ValueError, match=r"1\.\.32"):
        bench.radio.downlink(0, bytes(size))


def test_downlink_jitter_delays_answers_and_keeps_their_order() -> None:
    calm, shaken = RadioWithEnds(**QUIET), RadioWithEnds(**QUIET | {"downlink_jitter_us": 20_000})
    for bench in (calm, shaken):
        for number in range(4):
            assert bench.radio.downlink(bench.events.now_us, bytes((number,)))
        bench.events.run(1_000_000)
        assert bench.radio.down.latency_sum_us == sum(now_us for now_us, _ in bench.on_ground)
        assert bench.radio.down.delivered == 4
    assert shaken.radio.down.latency_max_us > calm.radio.down.latency_max_us + 5_000


def test_interference_of_one_direction_leaves_the_other_alone() -> None:
    bench = RadioWithEnds(**QUIET | {"downlink_bit_error_rate": 1.0})
    bench.radio.uplink(0, b"pose")
    bench.events.run(100_000)
    assert bench.radio.up.delivered == 1  # heard once, though no answer ever arrives
    assert bench.radio.air.unanswered > 0
