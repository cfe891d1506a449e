"""A board in the loop, on a link that a test writes: what its reports change, and how long the plant waits for it."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.signals import COUNTERS
from firmware_py.wire.core_port import CHANNEL_LOOP, PORT_CORE, Hil, Loop, PacketLayout, loop
from firmware_py.wire.crtp import Packet, decode, decode_ext_pose, encode, encode_ext_pose
from firmware_py.wire.supervisor import Cause, State
from ground_station.errors import LinkError
from hil.board.pins import VirtualBoard
from hil.board.real_firmware import RealBoard, RealFirmware
from hil.board.sample_window import WINDOW
from hil.config import load_config

REPORT = Loop(0, 0, State.FLYING, Cause.SILENCE, True, 11, 12, 13, 14, 21, 22, 23, 24, 31, 32, 33)


class Link:
    """A link to a board, and the wall clock: each read of the link takes `step_us`."""

    def __init__(self, moving: bool = False) -> None:
        self.name, self.ready, self.inbox = "board", True, list[bytes]()
        self.sent, self.executed, self.shifts = list[bytes](), list[Any](), list[int]()
        self.us, self.step_us, self.behind_us = 0, 0, 0
        self.reads = 0  # until the inbox is read
        self.servos: list[tuple[int, ...]] = []
        self.pins = VirtualBoard(
            lambda us, counts: self.servos.append(tuple(counts)), lambda *_: True, lambda *_: None
        )
        client: Any = SimpleNamespace(
            name=self.name, packets=self, begin=lambda: SimpleNamespace(core="c", profile="p")
        )
        client.execute = self.executed.append
        config = load_config()
        start: Any = SimpleNamespace(board=self.pins, config=config)
        self.firmware: RealFirmware = RealBoard(client, moving, self).boot(start)  # type: ignore[arg-type]

    def received(self, timeout_s: float) -> Iterator[bytes]:
        self.us += self.step_us
        self.reads -= 1
        if self.reads > 0:
            return iter(())
        inbox, self.inbox = self.inbox, []
        return iter(inbox)

    def send_any(self, raw: bytes) -> None:
        self.sent.append(raw)

    def wall_us(self) -> int:
        return self.us

    def late_us(self, now_us: int) -> int:
        return self.behind_us

    def shift(self, us: int) -> None:
        self.shifts.append(us)

    def report(self, channel: int = CHANNEL_LOOP, port: int = PORT_CORE, **changes: Any) -> None:
        data = PacketLayout.of(Loop).struct.pack(*REPORT._replace(**changes))
        self.inbox.append(encode(Packet(port, channel, data)))

    def samples(self, many: int) -> None:
        for _ in range(many):
            self.firmware.imu_ready()

    @property
    def variables(self) -> dict[str, float]:
        return {one.name.removeprefix("loop."): one.read() for one in self.firmware.variables}


@pytest.mark.parametrize("moving", [False, True])
def test_the_board_goes_into_the_loop_with_the_first_sample(moving: bool) -> None:
    link = Link(moving)
    assert link.executed == []
    link.samples(3)
    assert link.executed == [[loop(Hil.MOVING if moving else Hil.STILL)]]


@pytest.mark.parametrize("other", [{"port": PORT_CORE + 1}, {"channel": CHANNEL_LOOP + 1}])
def test_a_report_is_seen_in_every_view_and_packets_of_others_in_none(other: dict[str, int]) -> None:
    link = Link()
    link.report(**other)
    link.samples(1)
    signals = link.firmware.signals
    assert (signals.supervisor.state, signals.supervisor.cause) == (State.CALIBRATING, Cause.NONE)
    assert set(link.variables.values()) == {0}
    assert link.servos == []
    link.report(used=1)
    link.samples(1)
    assert (signals.supervisor.state, signals.supervisor.cause) == (State.FLYING, Cause.SILENCE)
    counters = dict(zip(COUNTERS, signals.counters.tolist(), strict=True))
    assert {name: value for name, value in counters.items() if value} == {
        "fused": 31,
        "refused": 32,
        "pose_age_us": 3300,
    }
    assert signals.count.tolist() == [21, 22, 23, 24] == list(link.servos[0])
    counted = {"waiting": 0, "held": 11, "late": 12, "lost": 13, "doubled": 14}
    assert {name: link.variables[name] for name in counted} == counted


def test_a_loop_s_delay_is_that_of_the_samples_between_and_half_of_what_no_buffer_explains_is_added() -> None:
    """Ten samples, of which the board used four: 6 ms; three wait on board, and a sample 2 ms for its packet of five."""
    link = Link()
    link.samples(9)
    assert link.firmware._window.batch == 5
    link.report(used=4, waiting=3)
    link.samples(1)
    assert (link.variables["delay"], link.variables["added"]) == (6000, 500)
    assert link.shifts == [25 * (3 - 8)]
    pose = encode_ext_pose((0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0), 30_000)
    for age_us, aged_us in ((30_000, 30_500), (None, None)):
        link.firmware.radio_received(encode_ext_pose((0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0), age_us))
        assert decode_ext_pose(decode(link.sent[-1]).data).age_us == pytest.approx(aged_us, abs=100)
    link.report(used=4, waiting=3, fresh=False)
    link.report(used=4, waiting=6)  # it took nothing
    link.samples(1)
    assert (link.variables["delay"], len(link.shifts)) == (6000, 1)
    sent = len(link.sent)
    for other in (encode(Packet(5, 0, b"x")), encode(Packet(6, 1, decode(pose).data[:5]))):
        link.firmware.radio_received(other)
    assert link.sent[sent:] == [other], "a packet of its port that is no pose is passed on"


def test_a_correction_waits_for_the_link_until_a_newer_one_replaces_it_and_is_sent_once() -> None:
    link = Link()
    link.ready = False
    for x in (0.1, 0.2):
        link.firmware.radio_received(encode_ext_pose((x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 30_000))
    assert link.sent == []
    link.ready = True
    link.samples(3)
    poses = [decode_ext_pose(packet.data) for packet in map(decode, link.sent) if packet.port != PORT_CORE]
    assert [pose.p_GB[0] for pose in poses] == [pytest.approx(0.2)]


@pytest.mark.parametrize(("waiting", "shift_us"), [(8, 0), (9, 25), (7, -25), (48, 1000), (49, 1000)])
def test_the_plant_is_shifted_by_the_samples_that_wait_on_board(waiting: int, shift_us: int) -> None:
    link = Link()
    link.samples(WINDOW - 1)
    link.firmware._measure(REPORT._replace(waiting=waiting))
    assert link.shifts == [shift_us]


@pytest.mark.parametrize(("behind_us", "stood_us"), [(10_000, 0), (12_345, 2_345), (-500, 0)])
def test_the_plant_waits_for_a_board_that_is_late(behind_us: int, stood_us: int) -> None:
    link = Link()
    link.samples(WINDOW - 1)
    link.behind_us, link.step_us, link.reads = behind_us, 200_000, 6
    link.report(used=1, waiting=8, fresh=False)  # is read after 1 s
    link.samples(1)
    assert (link.variables["stood"], link.shifts) == (stood_us, [stood_us])


def test_a_board_that_is_silent_for_more_than_a_second_ends_the_flight() -> None:
    link = Link()
    link.samples(WINDOW - 1)
    link.report(used=0, waiting=8)
    link.firmware.kernel.run(300_000)
    link.firmware._exchange()
    link.firmware.kernel.run(1_300_000)
    link.firmware.check_watchdog()
    link.firmware.kernel.run(1_300_001)
    with pytest.raises(LinkError, match=r"^board: silent for 1 s$"):
        link.firmware.check_watchdog()
    link.step_us = 200_000
    with pytest.raises(LinkError, match=r"^board: silent for 1 s$"):
        link.samples(1)
    assert link.us == 1_400_000
