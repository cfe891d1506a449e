"""Poses out of a NatNet stream: their age, what is no pose, and what goes wrong with the server."""

from types import SimpleNamespace as Made

import pytest

from ground_station.config import CaptureConfig
from ground_station.errors import MocapError
from ground_station.links.crazyradio import CrazyradioLink
from ground_station.mocap import MocapFrame
from ground_station.sources.alignment import Alignment
from ground_station.sources.motioncapture_client import MotioncaptureSource
from ground_station.sources.natnet_stream import MISTIMED_FRAMES, NatnetStream, ServerClock
from ground_station.sources.optitrack import OptitrackSource
from ground_station.sources.silence import SILENCE_US, Silence
from ground_station.unused import Reason
from support import natnet_packets as packets

V = (4, 1)
TICKS_PER_US = packets.CLOCK_HZ // 1_000_000
AHEAD_US = 7_000_000_000  # of the server's clock
CAMERA_US = 8000  # exposure to transmission
AS_STREAMED = Alignment(CaptureConfig(axes="z-up"))


class ServedStream:
    """A stream with one body, 7; packets take 300 us each way."""

    def __init__(self) -> None:
        self.stream = NatnetStream("floaty", AS_STREAMED)
        self.now_us = 50_000_000
        self.number = 0
        self.ahead_us = AHEAD_US
        self.stream.on_packet(packets.server_info(V), self.now_us)
        self.stream.on_packet(packets.model_definition({"floaty": 7}, V), self.now_us)
        self.stream.outgoing.clear()

    def ticks(self, t_us: int) -> int:
        return (t_us + self.ahead_us) * TICKS_PER_US

    def echo(self) -> None:
        self.stream.on_packet(packets.echo(self.now_us, self.ticks(self.now_us + 300)), self.now_us + 600)

    def frame(self, number: int | None = None, **options: object) -> MocapFrame | None:
        """Expose after 5 ms; the pose differs each time."""
        self.now_us += 5000
        self.number = self.number + 1 if number is None else number
        sent_us = self.now_us + CAMERA_US
        ticks = (self.ticks(self.now_us), self.ticks(sent_us - 1000), self.ticks(sent_us))
        options = {"pose": ((float(self.now_us), 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))} | options
        data = packets.frame(self.number, V, ticks, **options)  # type: ignore[arg-type]
        return self.stream.on_packet(data, sent_us + 300)

    def pose(self, **options: object) -> MocapFrame:
        frame = self.frame(**options)  # type: ignore[arg-type]
        assert frame is not None
        return frame


@pytest.mark.parametrize("tracked", [True, False])
def test_every_instant_of_the_way_is_by_the_station_s_clock(tracked: bool) -> None:
    bench = ServedStream()
    bench.echo()
    pose = bench.pose(tracked=tracked)
    assert pose.valid == tracked
    instants = (pose.t_us, pose.received_us, pose.transmitted_us, pose.arrived_us)
    way_us = (0, CAMERA_US - 1000, CAMERA_US, CAMERA_US + 300)
    assert instants == pytest.approx([bench.now_us + t_us for t_us in way_us], abs=1)


@pytest.mark.parametrize("asked_us", [-1_000_001, 600])
def test_an_echo_that_is_too_late_or_from_the_future_does_not_set_the_clock(asked_us: int) -> None:
    bench = ServedStream()
    bench.echo()
    asked_us += bench.now_us
    bench.stream.on_packet(packets.echo(asked_us, bench.ticks(asked_us - 500_000)), bench.now_us)
    assert bench.pose().t_us == pytest.approx(bench.now_us, abs=1)


def test_no_frame_counts_before_the_server_has_named_its_bodies() -> None:
    bench = ServedStream()
    bench.stream = NatnetStream("floaty", AS_STREAMED)
    assert bench.frame() is None
    bench.stream.on_packet(packets.server_info(V), bench.now_us)
    assert bench.frame() is None
    assert bench.stream.counters.frames == 0
    bench.stream.on_packet(packets.model_definition({"floaty": 7}, V), bench.now_us)
    assert bench.frame() is not None


def test_no_stage_of_the_way_takes_less_than_no_time() -> None:
    bench = ServedStream()  # without an echo the server's clock is thought to be 300 us behind
    bench.now_us += 5000
    early, late = bench.ticks(bench.now_us - 9000), bench.ticks(bench.now_us)
    for ticks in ((late, early, late), (early, late, late + 90 * TICKS_PER_US), (early, late, early)):
        bench.number += 1
        pose = bench.stream.on_packet(packets.frame(bench.number, V, ticks), bench.now_us + 300)
        assert pose is not None
        way_us = (pose.t_us, pose.received_us, pose.transmitted_us, pose.arrived_us)
        assert sorted(way_us) == list(way_us)


def test_without_echoes_only_the_way_through_the_network_is_missing() -> None:
    bench = ServedStream()
    assert abs(bench.pose().t_us - (bench.now_us + 300)) <= 1


def test_the_clock_follows_drift_and_shrugs_off_late_packets() -> None:
    clock = ServerClock(1_000_000)
    for second in range(600):
        now_us = second * 1_000_000
        server_us = now_us + second * 30  # 30 ppm fast
        clock.answered(now_us - 300, server_us, now_us + 300)
        clock.sent(server_us, now_us + 40_000)
        assert abs(clock.to_station_us(server_us) - now_us) < 60


@pytest.mark.long
def test_a_server_whose_clock_was_set_is_followed_again() -> None:
    bench = ServedStream()
    bench.echo()
    assert bench.pose().valid
    bench.ahead_us -= 5_000_000
    assert not bench.pose().valid
    bench.echo()
    assert bench.pose().valid
    bench.ahead_us -= 5_000_000
    for _ in range(MISTIMED_FRAMES):
        pose = bench.pose()
        assert (pose.valid, pose.unused) == (False, (Reason.MISTIMED, pytest.approx((5.0,), rel=0.1)))
    assert bench.pose().valid  # without an echo


def test_lost_tracking_is_never_a_pose() -> None:
    bench = ServedStream()
    assert bench.pose().valid
    for reason, options in ((Reason.NOT_TRACKED, {"tracked": False}), (Reason.ABSENT, {"number_of_body": 8})):
        pose = bench.pose(**options)
        assert (pose.valid, pose.unused) == (False, (reason, ()))
    frozen = [bench.pose(pose=packets.POSE) for _ in range(6)]
    assert [pose.valid for pose in frozen] == [True, True, True, False, False, False]
    assert frozen[-1].unused[0] is Reason.FROZEN
    assert bench.pose().valid
    assert bench.stream.counters.lost == 5


def test_frames_that_come_twice_or_late_are_dropped_and_counted() -> None:
    bench = ServedStream()
    numbers = [10, 11, 11, 13, 12, 14]
    assert [bench.frame(number) is not None for number in numbers] == [True, True, False, True, False, True]
    assert bench.stream.counters.dropped == 2
    assert bench.frame(2_000_000) is not None
    # A hundred numbers behind: the server began anew.
    assert [bench.frame(number) is not None for number in (1, 1000, 901, 900)] == [True, True, False, True]


@pytest.mark.parametrize(("name", "bodies", "message"), [
    ("flouty", {"floaty": 7, "wand": 8}, "no body 'flouty'; there are: floaty, wand"),
    ("", {"floaty": 7, "wand": 8}, "body=NAME is missing; there are: floaty, wand"),
    ("floaty", {}, "no body 'floaty'; there are: none"),
])  # fmt: skip
def test_a_wrong_body_is_one_line_listing_the_bodies(name: str, bodies: dict[str, int], message: str) -> None:
    stream = NatnetStream(name, AS_STREAMED)
    stream.on_packet(packets.server_info(V), 0)
    with pytest.raises(MocapError) as caught:
        stream.on_packet(packets.model_definition(bodies, V), 0)
    assert str(caught.value) == message


def test_a_body_that_goes_away_in_flight_is_a_notice_and_comes_back_with_any_id() -> None:
    bench = ServedStream()
    bench.stream.on_packet(packets.model_definition({"wand": 7}, V), bench.now_us)
    assert bench.stream.notices == ["motion capture: no body 'floaty'; there are: wand"]
    assert not bench.pose().valid
    bench.stream.on_packet(packets.model_definition({"floaty": 9}, V), bench.now_us)
    assert bench.pose(number_of_body=9).valid


def newer(bitstream: bytes | None, multicast: bool = False) -> NatnetStream:
    """A stream whose server speaks 4.2; `bitstream` is its answer to the wish for another version."""
    stream = NatnetStream("floaty", AS_STREAMED)
    stream.on_packet(packets.server_info((4, 2), multicast), 0)
    assert stream.outgoing == [packets.packet(2, b"Bitstream,4.1\0")]
    stream.outgoing.clear()
    if bitstream is not None:
        stream.on_packet(packets.packet(3, bitstream), 0)
    return stream


@pytest.mark.parametrize("answer", [bytes(4), b"Bitstream,4.1\0", b"Bitstream,4.1.0\0"])
def test_a_newer_server_is_asked_for_the_newest_version_that_can_be_read(answer: bytes) -> None:
    stream = newer(answer)
    assert [data[0] for data in stream.outgoing] == [4]
    stream.on_packet(packets.model_definition({"floaty": 7}, V), 0)
    frame = stream.on_packet(packets.frame(1, V, (1, 1, 1)), 0)
    assert frame is not None
    assert (frame.valid, frame.p_WB) == (True, packets.POSE[0])
    stream.on_packet(packets.packet(3, b"no\0"), 0)  # nothing was asked
    assert not stream.notices


@pytest.mark.parametrize("answer", [b"\xff\xff\xff\xff", b"", b"no\0", b"Bitstream,4.2\0"])
def test_a_newer_server_that_refuses_is_one_line(answer: bytes) -> None:
    with pytest.raises(MocapError, match=r"^NatNet 4\.2 of Motive: 3\.0, 3\.1, 4\.0 or 4\.1 is needed\Z"):
        newer(answer)
    assert newer(None).missing() == "NatNet 4.2 of Motive: 3.0, 3.1, 4.0 or 4.1 is needed"


def test_a_newer_server_with_multicast_and_an_older_one_are_refused_at_once() -> None:
    for info in (
        packets.server_info((4, 2), True),
        packets.server_info((2, 10)),
        packets.old_server_info((2, 10)),
        packets.old_server_info((1, 9)),
    ):
        stream = NatnetStream("floaty", AS_STREAMED)
        with pytest.raises(MocapError, match=r"NatNet \d\.\d+ of Motive: 3.0, 3.1, 4.0 or 4.1 is needed"):
            stream.on_packet(info, 0)


def test_unreadable_packets_have_their_reason_now_and_then() -> None:
    bench = ServedStream()
    whole = packets.frame(1, V, (1, 2, 3))
    cut = packets.packet(7, whole[4:60])
    for number in range(1000):
        assert bench.stream.on_packet(cut, bench.now_us + 6000 * number) is None
    first, second = bench.stream.notices
    assert first.startswith("motion capture: 1 packet cannot be read: NatNet packet of 60 bytes")
    assert second.startswith("motion capture: 835 packets cannot be read: NatNet packet of 60 bytes")
    assert bench.stream.counters.malformed == 1000


def test_a_server_is_called_until_it_answers_and_then_for_its_bodies() -> None:
    stream = NatnetStream("floaty", AS_STREAMED)

    def called(now_us: int) -> list[tuple[int, bytes]]:
        stream.outgoing.clear()
        stream.call(now_us, packets_wait=False)
        return [(data[0], data[4:]) for data in stream.outgoing]

    def alive(now_us: int) -> list[tuple[int, bytes]]:
        return [(10, b"\0"), (12, now_us.to_bytes(8, "little"))]

    assert called(500_000) == [(0, b"Ping\0"), *alive(500_000)]
    assert stream.missing() == "no NatNet server answers"
    assert called(999_999) == []
    stream.on_packet(packets.server_info(V), 0)
    assert called(1_000_000) == [(4, b"\0"), *alive(1_000_000)]
    assert stream.missing() == "the server names no bodies"
    stream.on_packet(packets.model_definition({"floaty": 7}, V), 0)
    assert called(1_500_000) == alive(1_500_000)


def test_an_answer_without_a_clock_is_unreadable_from_a_server_that_should_have_one() -> None:
    stream = NatnetStream("floaty", AS_STREAMED)
    stream.on_packet(packets.old_server_info((3, 1)), 0)
    (line,) = stream.notices
    assert line.endswith("NatNet 3.1 server 'Motive': its answer lacks clock and data port")
    assert (stream.server, stream.counters.malformed) == (None, 1)


def test_changed_models_are_asked_for() -> None:
    bench = ServedStream()
    bench.frame(parameters=2)
    assert [data[0] for data in bench.stream.outgoing] == [4]


def test_a_stopped_stream_is_reported_once_and_requested_until_it_returns() -> None:
    bench = ServedStream()
    bench.frame()
    calls = 0
    for _ in range(30):
        bench.now_us += 100_000
        bench.stream.call(bench.now_us, packets_wait=False)
        calls += sum(data[0] == 0 for data in bench.stream.outgoing)
        bench.stream.outgoing.clear()
    assert 4 <= calls <= 6
    assert bench.pose().valid
    assert bench.stream.notices == [
        "motion capture: no frames; calling the server again", "motion capture: frames arrive again after 3.0 s",
    ]  # fmt: skip


def test_a_busy_station_does_not_report_silence() -> None:
    bench = ServedStream()
    bench.frame()
    bench.now_us += 3_000_000
    bench.stream.call(bench.now_us, packets_wait=True)
    assert 0 not in [data[0] for data in bench.stream.outgoing]
    assert bench.pose().valid
    assert bench.stream.notices == []


def test_silence_is_reported_at_its_begin_and_end() -> None:
    notices: list[str] = []
    silence = Silence(notices)
    assert not silence.lasts(10 * SILENCE_US)  # nothing has come yet: that is for who connects to say
    for begin_us in (20_000_000, 30_000_000):
        silence.on_frame(begin_us)
        asked = [silence.lasts(begin_us + wait_us) for wait_us in (SILENCE_US, SILENCE_US + 1, 2_000_000)]
        assert asked == [False, True, True]
    for end_us in (32_500_000, 32_505_000):
        silence.on_frame(end_us)
    assert notices == [
        "motion capture: no frames; calling the server again", "motion capture: frames arrive again after 10.0 s",
        "motion capture: no frames; calling the server again", "motion capture: frames arrive again after 2.5 s",
    ]  # fmt: skip


def test_a_summary_names_each_count_of_cameras_and_links() -> None:
    counted = Made(lost=1, dropped=2, malformed=3)
    assert (
        OptitrackSource.summary(Made(_stream=Made(counters=counted)))
        == "mocap 1 lost, 2 dropped, 3 malformed"
    )
    cameras = Made(_age_us=2500, _lost=1, _malformed=2)
    assert MotioncaptureSource.summary(cameras) == "mocap 2.5 ms old (assumed), 1 lost, 2 malformed"
    link = Made(sent=4, late=5, quality=6.0, _rate=7.0)
    assert CrazyradioLink.summary(link) == "corrections 4 sent, 5 late  quality 6 %  7 exchanges/s"
    link._rate = 0.0
    assert CrazyradioLink.summary(link) == "corrections 4 sent, 5 late"
