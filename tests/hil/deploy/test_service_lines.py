"""The lines of a client's programs are the packets that cflib sends for the same words, and their answers as text."""

import struct
from math import pi
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cflib.crazyflie.commander import Commander
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.mem.trajectory_memory import CompressedSegment, CompressedStart, Poly4D
from hypothesis import example, given
from hypothesis import strategies as st

from firmware_py.geometry import from_euler_zyx
from hil.deploy import services
from hil.deploy.services import LINES, POSES, TRAJECTORIES, Answers, differences


class Bench:
    """Records the packets that are sent, returns prepared answers, and lets no time pass."""

    def __init__(self, *answers: bytes | None) -> None:
        self.sent: list[tuple[int, int, bytes]] = []
        self.answers, self.ran_us, self.counts = list(answers), 0, (1, 20, 300, 4000)
        self.received: list[Any] = []
        self.firmware = SimpleNamespace(log_numbers={"a.b": 513, "c.d": 2}, parameter_numbers={"e.f": 258})

    def post(self, port: int, channel: int, data: bytes) -> None:
        self.sent.append((port, channel, bytes(data)))

    def request(self, port: int, channel: int, data: bytes) -> bytes | None:
        self.post(port, channel, data)
        return self.answers.pop(0) if self.answers else None

    def run(self, duration_us: int) -> None:
        self.ran_us += duration_us


def said(line: str, *answers: bytes | None) -> tuple[str | None, Bench]:
    bench = Bench(*answers)
    name, *words = line.split()
    return LINES[name](bench, words), bench  # type: ignore[arg-type]


def by_cflib(kind: Any, name: str, *arguments: Any, **options: Any) -> list[tuple[int, int, bytes]]:
    sent: list[tuple[int, int, bytes]] = []
    link = SimpleNamespace(platform=SimpleNamespace(get_protocol_version=lambda: 12),
        send_packet=lambda packet: sent.append((packet.port, packet.channel, bytes(packet.data))))  # fmt: skip
    getattr(kind(link), name)(*arguments, **options)
    return sent


PATH, NOW = HighLevelCommander, Commander
RAD = pi / 180.0


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("takeoff 1.1 2", by_cflib(PATH, "takeoff", 1.1, 2.0, yaw=None)), ("takeoff 1.1 2 30", by_cflib(PATH, "takeoff",
        1.1, 2.0, yaw=30 * RAD)),
        ("land 0.1 3", by_cflib(PATH, "land", 0.1, 3.0, yaw=None)), ("land 0.1 3 -20", by_cflib(PATH, "land", 0.1, 3.0,
        yaw=-20 * RAD)),
        ("goto 0.1 0.2 1.3 40 5", by_cflib(PATH, "go_to", 0.1, 0.2, 1.3, 40 * RAD, 5.0)),
        ("goto 0.1 0.2 1.3 40 5 relative", by_cflib(PATH, "go_to", 0.1, 0.2, 1.3, 40 * RAD, 5.0, relative=True)),
        ("goto 0.1 0.2 1.3 40 5 linear", by_cflib(PATH, "go_to", 0.1, 0.2, 1.3, 40 * RAD, 5.0, linear=True)),
        ("spiral 90 0.1 0.2 0.3 4", by_cflib(PATH, "spiral", pi / 2, 0.1, 0.2, 0.3, 4.0)),
        ("spiral 90 0.1 0.2 0.3 4 sideways", by_cflib(PATH, "spiral", pi / 2, 0.1, 0.2, 0.3, 4.0, sideways=True)),
        ("spiral 90 0.1 0.2 0.3 4 clockwise", by_cflib(PATH, "spiral", pi / 2, 0.1, 0.2, 0.3, 4.0, clockwise=True)),
        ("start 3", by_cflib(PATH, "start_trajectory", 3)), ("start 3 1.5 relative", by_cflib(PATH, "start_trajectory",
        3, 1.5, True)),
        ("start 3 turned", by_cflib(PATH, "start_trajectory", 3, relative_yaw=True)),
        ("start 3 reversed", by_cflib(PATH, "start_trajectory", 3, reversed=True)),
        ("define 3 1 132 5", by_cflib(PATH, "define_trajectory", 3, 132, 5, type=1)), ("stop", by_cflib(PATH, "stop")),
        ("rise 1.5 0.2", [(8, 0, struct.pack("<BBf?f?f", 9, 0, 1.5, False, 0.0, True, 0.2))]),  # cflib has none
        ("sink 0.5 0.2 relative", [(8, 0, struct.pack("<BBf?f?f", 10, 0, 0.5, True, 0.0, True, 0.2))]),
        ("setpoint position 0.1 0.2 1.3 40", by_cflib(NOW, "send_position_setpoint", 0.1, 0.2, 1.3, 40.0)),
        ("setpoint velocity 0.1 0.2 0.3 40", by_cflib(NOW, "send_velocity_world_setpoint", 0.1, 0.2, 0.3, 40.0)),
        ("setpoint height 1 2 3 0.4", by_cflib(NOW, "send_zdistance_setpoint", 1.0, 2.0, 3.0, 0.4)),
        ("setpoint hover 0.1 0.2 30 0.4", by_cflib(NOW, "send_hover_setpoint", 0.1, 0.2, 30.0, 0.4)),
        ("setpoint full 0.125 0.25 1.5",
         by_cflib(NOW, "send_full_state_setpoint", (0.125, 0.25, 1.5), (0, 0, 0), (0, 0, 0), np.array([0.0, 0.0, 0.0,
         1.0]), 0, 0, 0)),
        ("setpoint attitude 12345", by_cflib(NOW, "send_setpoint", 0.0, -0.0, 0.0, 12345)), ("setpoint stop",
        by_cflib(NOW, "send_stop_setpoint")),
        ("setpoint manual", [(7, 0, struct.pack("<BfffHB", 11, 0, 0, 0, 20_000, 0))]),
        ("stream velocity 0.1 0.2 0.3 40 0.125", 2 * by_cflib(NOW, "send_velocity_world_setpoint", 0.1, 0.2, 0.3, 40.0)),
        ("notify", by_cflib(NOW, "send_notify_setpoint_stop")), ("disconnect", by_cflib(NOW, "send_setpoint", 0, 0,
        0, 0)),
        ("arm", [(9, 1, b"\1\1")]), ("disarm", [(9, 1, b"\1\0")]), ("recover", [(9, 1, b"\2")]), ("emergency", [(9, 1,
        b"\3")]), ("feed", [(9, 1, b"\4")]),
        ("ask 13 1 0a0b", [(13, 1, b"\x0a\x0b")]), ("read e.f", [(2, 1, b"\2\1")]), ("write e.f 0708", [(2, 2,
        b"\2\1\7\x08")]),
        ("misc 5 e.f", [(2, 3, b"\5\2\1")]), ("log 6 9 7 a.b 3 c.d 2 4", [(5, 1, struct.pack("<BBBHBHBH", 6, 9, 7, 513,
        3, 2, 2, 4))]),
        ("set e.f F32 1.5", [(2, 3, b"\0e\0f\0\6" + struct.pack("<f", 1.5))]),
    ],
)  # fmt: skip
def test_a_line_sends_what_cflib_sends(line: str, expected: list[tuple[int, int, bytes]]) -> None:
    assert said(line)[1].sent == expected


@pytest.mark.parametrize(("line", "answer", "text"), [("takeoff 1 2", b"\1\2\3\x0b", "status 11"),
    ("goto 1 2 3 4 5", None, "nothing"), ("arm", b"\x01\xab", "01ab"),
    ("ask 13 1 00", b"\1\2\3\4", "01020304"), ("ask 13 1 00 2", b"\1\2\3\4", "0102"),
    ("ask 13 1 00", None, "nothing"), ("set a.b U8 1", b"\1\2\x07", "status 7"),
    ("set a.b U8 1", None, "nothing"), ("read e.f", b"\2\1\0\xcd", "00cd"),
    ("write e.f 00", b"\2\1\xee", "ee"), ("write e.f 00", None, "nothing"),
    ("misc 5 e.f", b"\5\2\1\x09\x08", "0908"), ("misc 5 e.f", None, "nothing"),
    ("log 5 0", b"\5\0\2", "050002"), ("servos 3", None, "1~3 20~3 300~3 4000~3")])  # fmt: skip
def test_an_answer_is_text_without_what_differs_between_boards(
    line: str, answer: bytes | None, text: str
) -> None:
    assert said(line, answer)[0] == text


def test_times_pass_and_poses_come_as_a_line_says() -> None:
    assert said("wait 1.25")[1].ran_us == 1_250_000
    assert said("stream velocity 0 0 0 0 0.125")[1].ran_us == 100_000
    assert said("setpoint stop")[1].ran_us == said("notify")[1].ran_us == services.ANSWER_US
    told = {word: said(f"poses {word}")[1].__dict__ for word in ("on", "off", "12.5", "aged", "cut")}
    assert [told[word].get("pose_us") for word in ("on", "off", "12.5")] == [20_000, 0, 12_500]
    assert [told[word].get("poses_as") for word in ("aged", "cut")] == ["aged", "cut"]
    assert (said("radio on")[1].__dict__["radio"], said("radio off")[1].__dict__["radio"]) == (True, False)
    bench = said("place 1 2 3 10 20 30")[1].__dict__
    assert (bench["place"], bench["attitude"]) == ((1, 2, 3), (pytest.approx(10 * RAD),
        pytest.approx(20 * RAD), pytest.approx(30 * RAD)))  # fmt: skip
    assert said("place 1 2 3")[1].__dict__["attitude"] == (0, 0, 0)


def test_trajectories_are_those_that_cflib_packs_and_go_up_in_pieces_of_24_bytes() -> None:
    def line(*terms: float) -> Any:
        return Poly4D.Poly([*terms, *[0.0] * (8 - len(terms))])

    corner = (Poly4D(1.0, line(0.0, 0.08), line(), line(1.15), line()).pack() + Poly4D(1.0, line(0.08),
        line(0, 0.06), line(1.15), line()).pack())  # fmt: skip
    assert TRAJECTORIES["corner"] == bytes(corner)
    turning = Poly4D(2.0, line(0.02, 0.03), line(0.01, -0.02), line(1.15), line(0.2, 0.3)).pack()
    assert TRAJECTORIES["turning"] == bytes(turning)
    end = struct.pack("<BH", 0, 0)
    small = (CompressedStart(0.0, 0.0, 1.15, 0.0).pack() + CompressedSegment(2.0, [0.05], [], [],
        [60.001 * RAD]).pack())  # fmt: skip
    assert TRAJECTORIES["small"] == bytes(small) + end
    curved = (CompressedStart(0.0, 0.0, 1.15, 0.0).pack() + CompressedSegment(1.0, [0.04, 0.08, 0.08],
        [0.0, 0.0, 0.06], [], []).pack())  # fmt: skip
    assert TRAJECTORIES["curved"] == bytes(curved + CompressedSegment(0.5, [], [], [1.2], []).pack()) + end
    memories = (b"\1\2", b"\2\0\x01", b"\2\1\x12")  # the second one is that of trajectories
    data = TRAJECTORIES["straight"]
    text, bench = said("upload straight 24", *memories, *(struct.pack("<BIB", 1, 0,
        n == 2) for n in range(6)))  # fmt: skip
    assert text == "00 01", "each status once"
    assert bench.sent[:3] == [(4, 0, b"\1"), (4, 0, b"\2\0"), (4, 0, b"\2\1")]
    assert bench.sent[3:] == [(4, 2, struct.pack("<BI", 1, 24 + at) + data[at : at + 24]) for at in range(0,
        len(data), 24)]  # fmt: skip


def test_means_of_log_variables_have_their_tolerances() -> None:
    bench = Bench(*[b"\0"] * 9)
    rows = [(1.5, 4.0), (2.5, 8.0)]
    bench.run = lambda duration_us: bench.received.extend(  # type: ignore[method-assign]
        SimpleNamespace(port=5, channel=2, data=struct.pack("<BHB2f", block, 0, 0, *row)) for block,
        row in [(services.BLOCK, rows[0]), (1, (9, 9)), (services.BLOCK, rows[1])]
    )  # fmt: skip
    assert LINES["values"](bench, ["0.1", "a.b~0.25", "c.d~3"]) == "2~0.25 6~3"  # type: ignore[arg-type]
    assert [data[:2] for port, channel, data in bench.sent if (port, channel) == (5, 1)] == [
        bytes((command, services.BLOCK)) for command in (6, 8, 2)
    ], "created, started every 10 ms and deleted"
    assert LINES["values"](Bench(*[b"\0"] * 9), ["0.1", "a.b~0.25"]) == "nothing"  # type: ignore[arg-type]


def test_a_pose_is_sent_as_the_client_of_its_kind_sends_it() -> None:
    place, q = (0.5, -0.25, 1.5), from_euler_zyx(0.0, 0.0, pi / 2)
    half = 0.5**0.5
    pose = struct.pack("<B7f", 8, *place, 0.0, 0.0, half, half)
    sent = {name: make(place, q) for name, make in POSES.items()}
    assert {name: one[:2] for name, one in sent.items()} == dict.fromkeys(sent,
        (6, 1)) | {"app": sent["app"][:2]}  # fmt: skip
    assert (sent["pose"][2], sent["app"][2], sent["cut"][2]) == (pose, pose, pose[:-1])
    assert sent["aged"][2][:-1].startswith(pose)
    assert len(sent["aged"][2]) > len(pose)
    first, second = (struct.unpack("<B3h", sent["packed"][2][at : at + 7]) for at in (1, 12))
    assert (first, second) == ((1, 1000, 250, 2000), (0xE7, 500, -250, 1500)), "another robot's before ours"


def test_goals_of_two_boards_are_compared_with_those_of_the_instants_around() -> None:
    path = [(0.1 * n, 0.0, 1.0, 0.0) for n in range(5)]
    for other in ([path[0], *path[:-1]], [*path[1:], path[-1]]):
        assert list(differences(Answers([], path), Answers([], other))) == []
    assert list(differences(Answers([], path), Answers([], [path[0], path[0], path[0], path[3],
        path[4]]))) == [f"goal {path[0]} after 0.4 s, expected {path[2]}"]  # fmt: skip
    assert list(differences(Answers(["arm: 01"]), Answers(["arm: 02"]))) == ["arm: 02, expected 01"]
    assert list(differences(Answers(["x: nan"]), Answers(["x: nan"]))) == []
    assert np.isnan(services._numbers(["nan", "relative", "-inf", "1.5"])).tolist() == [True, False, False]
    assert services._numbers(["-inf", "inf", "2"]) == [-np.inf, np.inf, 2.0]


@example(period_us=1001, begun_us=1000)
@given(
    period_us=st.integers(services.STEP_US, 30_000),
    begun_us=st.integers(0, 20).map(lambda n: n * services.STEP_US),
)
def test_poses_come_at_the_multiples_of_their_period_each_once(period_us: int, begun_us: int) -> None:
    sent: list[int] = []
    nothing = lambda *_: None  # noqa: E731
    bench: Any = object.__new__(services.ServiceBench)
    kernel = SimpleNamespace(now_us=0, run=nothing)
    kernel.advance = lambda now_us: setattr(kernel, "now_us", now_us)
    bench.firmware = SimpleNamespace(kernel=kernel, imu_ready=nothing, radio_polled=nothing)
    bench._events, bench._pins = SimpleNamespace(run=nothing), SimpleNamespace(measure=nothing)
    bench._boot_us, bench.now_us, bench.pose_us, bench.radio, bench._path_us, bench._noise = (
        7,
        begun_us,
        period_us,
        True,
        None,
        0,
    )
    bench._send_pose = lambda: sent.append(kernel.now_us - bench._boot_us)
    bench.run(60_000)
    assert sent == [us for us in range(0, begun_us + 60_001, period_us) if us > begun_us]
