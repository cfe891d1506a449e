"""A flight in lockstep on what a NatNet stream says: the bytes between cameras and station, and what happens to them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ground_station.config import CaptureConfig
from ground_station.mocap import MocapFrame
from ground_station.sources.alignment import Alignment
from ground_station.sources.natnet_stream import NatnetStream
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import Recorder, load_log
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.metrics import judge, measure
from hil.laboratory.request import Request
from support import natnet_packets as packets

V = (4, 1)
AHEAD_US = 7_000_000_000  # of Motive's clock
TICKS_PER_US = packets.CLOCK_HZ // 1_000_000
FLYING, FAILSAFE = "FLYING", "FAILSAFE"

Network = Callable[[int, bytes], list[bytes]]  # (now_us, packet sent) -> packets that arrive then


class NatnetFlight:
    """Hover on frames that go through `network` as NatNet, in axes with z up; the station's requests are answered."""

    def __init__(self, network: Network, duration_s: float, *overrides: str) -> None:
        self.flight = lockstep_flight(
            Request.of(EXPERIMENTS["hover"], overrides=overrides, duration_s=duration_s)
        )
        self.stream = NatnetStream("floaty", Alignment(CaptureConfig(axes="z-up")))
        self.stream.on_packet(packets.server_info(V), 0)
        self.stream.on_packet(packets.model_definition({"wand": 3, "floaty": 7}, V), 0)
        self.states: list[tuple[int, str]] = []
        self.exposed_us: list[int] = []
        self._network = network
        self._number = 0
        self._on_frame = self.flight.line.station.on_frame
        self.flight.line.station.on_frame = self._transmit  # type: ignore[method-assign]
        self.flight.events.every(10_000, 5_000, self._look)

    def _look(self, now_us: int) -> None:
        state = self.flight.robot.firmware.signals.supervisor.state.name
        if not self.states or self.states[-1][1] != state:
            self.states.append((now_us, state))

    def _transmit(self, frame: MocapFrame, now_us: int) -> None:
        """Send a frame as Motive would."""
        self._number += 1
        w, x, y, z = frame.q_WB
        instants = (frame.t_us, now_us - 18_000, now_us)
        data = packets.frame(
            self._number, V, tuple((t_us + AHEAD_US) * TICKS_PER_US for t_us in instants),
            tracked=frame.valid, pose=(frame.p_WB, (x, y, z, w)),
        )  # fmt: skip
        self.stream.call(now_us, packets_wait=False)
        for asked in self.stream.outgoing:
            if asked[0] == 12:
                asked_us = int.from_bytes(asked[4:], "little")
                self._deliver(packets.echo(asked_us, (now_us + AHEAD_US) * TICKS_PER_US), now_us)
        self.stream.outgoing.clear()
        self._deliver(data, now_us)

    def _deliver(self, data: bytes, now_us: int) -> None:
        for arrived in self._network(now_us, data):
            pose = self.stream.on_packet(arrived, now_us)
            if pose is not None:
                self.exposed_us.append(pose.t_us)
                self._on_frame(pose, now_us)

    def fly(self, folder: Path) -> list[str]:
        """Fly, and return the limits that fail."""
        recorder = Recorder(folder, self.flight.channels(), {})
        outcome = self.flight.run(recorder=recorder)
        recorder.close()
        values = measure(load_log(folder), outcome.lost is not None)
        return [
            str(verdict) for verdict in judge(values, EXPERIMENTS["hover"].limits, {}) if not verdict.holds
        ]


@pytest.mark.long
def test_hover_holds_its_limits_among_packets_out_of_order_twice_or_broken(tmp_path: Path) -> None:
    """A tenth of the packets each: overtaken by the next one, sent twice, cut short, followed by noise."""
    rng = np.random.default_rng(3)
    overtaken: list[bytes] = []
    done = dict.fromkeys(("overtaken", "twice", "cut", "noise", "fine"), 0)

    def network(now_us: int, data: bytes) -> list[bytes]:
        late, overtaken[:] = overtaken[:], []
        kind = rng.choice(list(done), p=(0.1, 0.1, 0.1, 0.1, 0.6)) if data[0] == 7 else "fine"
        done[str(kind)] += 1
        if kind == "overtaken":
            overtaken.append(data)
            return late
        broken = {"cut": [data[: rng.integers(len(data))]], "noise": [data, b"\x07\0" + rng.bytes(300)]}
        return [*broken.get(str(kind), [data, data] if kind == "twice" else [data]), *late]

    lab = NatnetFlight(network, 4.0)
    assert lab.fly(tmp_path) == []
    counters = lab.stream.counters
    assert counters.malformed == done["cut"] + done["noise"] > 50
    assert counters.dropped >= done["twice"] > 50
    assert counters.mistimed == counters.lost == 0
    assert np.diff(lab.exposed_us).min() > 4_000  # what was overtaken or comes twice is not flown on
    [notice] = lab.stream.notices  # of the first one; it is repeated after 5 s
    assert notice.startswith("motion capture: 1 packet cannot be read: ")


@pytest.mark.long
def test_a_stream_that_stops_is_failsafe_and_one_line_and_flies_again_when_it_is_back(tmp_path: Path) -> None:
    """Motive stops from 2 to 4 s, with the robot still in its holder."""

    def network(now_us: int, data: bytes) -> list[bytes]:
        return [] if 2_000_000 <= now_us < 4_000_000 else [data]

    lab = NatnetFlight(network, 2.0, "flight.release_us=5000000")
    assert lab.fly(tmp_path) == []
    told_us, states = zip(*lab.states[-3:], strict=True)
    assert states == (FLYING, FAILSAFE, FLYING)
    assert 2_400_000 < told_us[1] < 2_700_000
    assert 4_000_000 < told_us[2] < 4_200_000
    stopped, back = lab.stream.notices
    assert stopped == "motion capture: no frames; calling the server again"
    assert back == "motion capture: frames arrive again after 2.0 s"


@pytest.mark.long
def test_a_body_that_is_taken_out_in_flight_is_failsafe_and_one_line(tmp_path: Path) -> None:
    lab = NatnetFlight(lambda now_us, data: [data], 3.0, "flight.release_us=5000000")
    rename = packets.model_definition({"wand": 3}, V)
    lab.flight.events.at(2_000_000, lambda now_us: lab.stream.on_packet(rename, now_us) and None)
    lab.flight.lab.end_at(3_000_000)
    lab.fly(tmp_path)
    assert lab.states[-1][1] == FAILSAFE
    assert lab.stream.notices == ["motion capture: no body 'floaty'; there are: wand"]
