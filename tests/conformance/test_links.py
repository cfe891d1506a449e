"""Laws of every `ground_station.station.Link`: what is sent reaches the board once, and what the board sends the station.

The board's end is read and written without our own code: CRTP by the layouts of the documentation, MAVLink by pymavlink.
"""

import io
import struct
from collections.abc import Callable
from typing import Any, Protocol

import pymavlink.dialects.v20.development as dialect
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.wire import WireError
from ground_station.config import LinkSettings, StationConfig
from ground_station.links.loopback import LoopbackLink
from ground_station.links.mavlink import MavlinkLink
from ground_station.mocap import MocapFrame
from ground_station.station import GroundStation, Link
from ground_station.trajectory import Goal, Hold
from support.log_board import TABLE

LATENCY_US = 900
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
NAN, INFINITE = float("nan"), float("inf")
EXT_POSE, LOG_REQUEST, LOG_DATA = 0x61, 0x51, 0x52  # port and channel, without the link bits
Place = tuple[float, ...]


class BoardEnd(Protocol):
    """A link, and the board at its other end."""

    link: Link
    sent: list[bytes]

    def errors(self) -> list[Place]:
        """The places of the body relative to the goal, one per pose that arrived; yaw of the goal is 0."""
        ...

    def telemetry(self, t_ms: int, p_GB: Place) -> bytes:
        """What the board sends when it is there; the goal lies at the origin."""
        ...


class CrtpBoard:
    """The other end of a loopback."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.link = LoopbackLink(lambda now_us, data: self.sent.append(data), LATENCY_US, lambda: TABLE)
        self._granted = 0

    def errors(self) -> list[Place]:
        poses = [data for data in self.sent if data[0] & 0xF3 == EXT_POSE and data[1] == 8]
        return [struct.unpack_from("<3f", data, 2) for data in poses]

    def telemetry(self, t_ms: int, p_GB: Place) -> bytes:
        if not self._granted:
            self._grant()
        return bytes((LOG_DATA, 0)) + t_ms.to_bytes(3, "little") + struct.pack("<6f", *p_GB, 0, 0, 0)

    def _grant(self) -> None:
        """Grant what the station asks for, until it asks for nothing more."""
        self.link.start_telemetry(0)
        while self._granted < len(self.sent):
            request = self.sent[self._granted]
            self._granted += 1
            if request[0] & 0xF3 == LOG_REQUEST:
                self.link.receive(0, bytes((request[0], *request[1:3].ljust(2, b"\0"), 0)))


class MavlinkBoard:
    """The other end of a serial line."""

    def __init__(self, baud: int, key: bytes = b"") -> None:
        self.codec = dialect.MAVLink(io.BytesIO(), srcSystem=1, srcComponent=1)
        if key:
            self.codec.signing.secret_key = key
            self.codec.signing.sign_outgoing = True
        self.sent: list[bytes] = []
        config = LinkSettings(50.0, LATENCY_US, baud, key)
        self.link = MavlinkLink(lambda now_us, data: self.sent.append(data), config)

    def errors(self) -> list[Place]:
        goal: Any = None
        found = []
        for message in self.codec.parse_buffer(b"".join(self.sent)):
            if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                goal = message
            elif message.get_type() == "ATT_POS_MOCAP":
                found.append((message.x - goal.x, goal.y - message.y, goal.z - message.z))
        return found

    def telemetry(self, t_ms: int, p_GB: Place) -> bytes:
        data = [*p_GB, *[0.0] * 55]
        message = dialect.MAVLink_debug_float_array_message(1000 * t_ms, b"floaty", 0, data)
        return bytes(message.pack(self.codec))


BOARDS: dict[str, Callable[[], BoardEnd]] = {
    "loopback": CrtpBoard,
    "mavlink": lambda: MavlinkBoard(921_600),
    "mavlink at 57600 baud": lambda: MavlinkBoard(57_600),
    "mavlink, signed": lambda: MavlinkBoard(921_600, bytes(range(32))),
}


@pytest.fixture(params=BOARDS)
def board(request: pytest.FixtureRequest) -> BoardEnd:
    return BOARDS[request.param]()


def send(board: BoardEnd, now_us: int, p: Place, q: Place = UPRIGHT, goal: Place = (0.0, 0.0, 0.0)) -> None:
    board.link.send(now_us, MocapFrame(now_us - 40_000, p, q, True), Goal(goal, 0.0))


def test_poses_arrive_once_in_order_relative_to_the_goal_of_their_instant(board: BoardEnd) -> None:
    expected = []
    for number in range(100):
        p, goal = (0.01 * number, -0.02 * number, 0.5), (0.3 * (number // 10), 0.1, -0.2 * (number // 10))
        send(board, 20_000 * number + 40_000, p, goal=goal)
        expected.append(tuple(a - b for a, b in zip(p, goal, strict=True)))
    assert board.errors() == [pytest.approx(error, abs=1e-6) for error in expected]


@pytest.mark.parametrize(
    ("p", "q"),
    [
        ((NAN, 0.0, 0.0), UPRIGHT),
        ((0.0, INFINITE, 0.0), UPRIGHT),
        ((0.0, 0.0, 1e39), UPRIGHT),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5, 0.1)),
        ((0.0, 0.0, 0.0), (1.0, NAN, 0.0, 0.0)),
    ],
)
def test_a_station_sends_no_invalid_pose_but_the_next_valid_one(board: BoardEnd, p: Place, q: Place) -> None:
    station = GroundStation(board.link, Hold(Goal((0.0, 0.0, 0.0), 0.0)), None, StationConfig())
    for t_us, place, rotation in ((0, p, q), (20_000, (0.1, 0.2, 0.3), UPRIGHT)):
        station.on_frame(MocapFrame(t_us, place, rotation, True), t_us + 40_000)
    assert board.errors() == [pytest.approx((0.1, 0.2, 0.3))]
    assert station.counters.invalid == 1


def test_telemetry_arrives_once_and_in_order_in_the_goals_frame(board: BoardEnd) -> None:
    send(board, 40_000, (0.0, 0.0, 0.0))
    expected = [(20 * number, (0.25 * number, -0.5, 0.125)) for number in range(20)]
    found = []
    for t_ms, p_GB in expected:
        found += board.link.receive(50_000 + 1000 * t_ms, board.telemetry(t_ms, p_GB))
    places = [sample for sample in found if sample.block.variables[0].name == "stateEstimate.x"]
    assert [(sample.timestamp_ms, sample.values[:3]) for sample in places] == expected


def test_whoever_asks_for_telemetry_again_sends_again(board: BoardEnd) -> None:
    board.link.start_telemetry(0)
    asked = len(board.sent)
    board.link.start_telemetry(500_000)
    assert len(board.sent) == 2 * asked > 0


def test_the_latency_is_the_stated_one_until_it_is_measured(board: BoardEnd) -> None:
    send(board, 40_000, (0.0, 0.0, 0.0))
    assert (board.link.latency.us, board.link.latency.measured) == (LATENCY_US, False)


@pytest.mark.long
@pytest.mark.parametrize("name", BOARDS)
@given(pieces=st.lists(st.binary(max_size=40), max_size=5))
def test_no_bytes_do_harm(name: str, pieces: list[bytes]) -> None:
    """They are telemetry, nothing or malformed, and what comes behind them is understood."""
    board = BOARDS[name]()
    send(board, 40_000, (0.0, 0.0, 0.0))
    for piece in pieces:
        try:
            board.link.receive(50_000, piece)
        except WireError:
            assert name == "loopback", "a stream of bytes has no malformed pieces"
    found = []
    for t_ms in range(0, 400, 20):  # a frame that began in the bytes before may swallow some
        found += board.link.receive(60_000 + 1000 * t_ms, board.telemetry(t_ms, (0.0, 0.0, 0.0)))
    assert found[-1].timestamp_ms == 380
