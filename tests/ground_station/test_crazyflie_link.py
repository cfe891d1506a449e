"""A Crazyflie with its own firmware is flown by the packets that cflib would send, in the order of a flight."""

import struct
import warnings
from math import pi, radians
from types import SimpleNamespace

import numpy as np
import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.commander import Commander
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.localization import Localization

from firmware_py.wire import crtp, high_level, setpoints
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.telemetry import CRAZYFLIE_BLOCKS
from ground_station.config import PilotConfig
from ground_station.links.crazyflie_link import AWAY, CrazyflieLink, FlightTimes, FromFloor, smooth
from ground_station.links.crtp_controls import TocEntry
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal, Hold, Offsets, Square, Step

PERIOD_US = 10_000
HOME = Goal((0.0, 0.0, 1.0), 0.0)
CONFIG = PilotConfig(parameters={"stabilizer": {"estimator": 2.0, "controller": 3.0}})
TABLE = {
    "stabilizer.estimator": TocEntry(3, Scalar.U8, True, False),
    "stabilizer.controller": TocEntry(4, Scalar.U8, True, False),
    "kalman.resetEstimation": TocEntry(9, Scalar.U8, True, False),
}
TIMES = FlightTimes.of(CONFIG, 3_000_000, 12_000_000)


class CflibPackets:
    """What cflib sends."""

    def __init__(self) -> None:
        self.packets: list[bytes] = []
        radio = SimpleNamespace(
            send_packet=lambda packet: self.packets.append(bytes((packet.header, *packet.data))),
            platform=SimpleNamespace(get_protocol_version=lambda: 12),
            add_port_callback=lambda *_: None,
        )
        self.high_level, self.low_level = HighLevelCommander(radio), Commander(radio)
        self.localisation = Localization(radio)


def masked(packet: bytes) -> bytes:
    """Return a packet without its header's reserved bits."""
    return bytes((packet[0] & 0xF3,)) + packet[1:]


def test_commands_and_set_points_are_cflibs_bytes() -> None:
    cflib = CflibPackets()
    cflib.high_level.takeoff(1.25, 2.5, yaw=0.5)
    cflib.high_level.land(0.1, 3.0, yaw=-0.5)
    cflib.high_level.stop()
    cflib.low_level.send_position_setpoint(0.1, -0.2, 0.3, 45.0)
    cflib.low_level.send_notify_setpoint_stop()
    ours = [
        high_level.encode(high_level.PathCommand.TAKE_OFF, 0, 1.25, 0.5, False, 2.5),
        high_level.encode(high_level.PathCommand.LAND, 0, 0.1, -0.5, False, 3.0),
        high_level.encode(high_level.PathCommand.STOP, 0),
        setpoints.encode_place((0.1, -0.2, 0.3), pi / 4),
        setpoints.encode_end(),
    ]
    assert [masked(packet) for packet in ours] == [masked(packet) for packet in cflib.packets]


class Flown:
    """A link at work for some seconds: what it sent, with the instant; `deaf` boards answer nothing."""

    def __init__(
        self, trajectory, seconds: float, deaf: bool = False, refuse: bool = False, protocol: int = 10
    ) -> None:
        self.sent: list[tuple[int, crtp.Packet]] = []
        self.refuse, self.protocol = refuse, protocol
        self.link = CrazyflieLink(self.take, 1000, dict, TABLE, CONFIG, HOME, TIMES)
        self.deaf = deaf
        self.waiting: list[bytes] = []
        for now_us in range(0, round(seconds * 1e6), PERIOD_US):
            frame = MocapFrame(now_us, (1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5), True, now_us, now_us)
            for reply in self.waiting:
                self.link.receive(now_us, reply)
            self.waiting.clear()
            self.link.send(now_us, frame, trajectory.at(now_us))

    def take(self, now_us: int, raw: bytes) -> None:
        packet = crtp.decode(raw)
        self.sent.append((now_us, packet))
        if self.deaf:
            return
        if packet.port == crtp.PORT_PARAMETERS:
            self.waiting.append(raw)  # the value in force
        if packet.port in (crtp.PORT_PLATFORM, crtp.PORT_SUPERVISOR):
            answer = bytes(
                (packet.data[0] | (0x80 if packet.port == crtp.PORT_SUPERVISOR else 0), not self.refuse)
            )
            if (packet.port, packet.channel) == (crtp.PORT_PLATFORM, 1):  # its version
                answer = struct.pack("<BI", packet.data[0], self.protocol)
            self.waiting.append(crtp.encode(crtp.Packet(packet.port, packet.channel, answer)))

    def of(self, port: int) -> list[tuple[int, crtp.Packet]]:
        return [(us, packet) for us, packet in self.sent if packet.port == port]


def test_every_pose_goes_out_as_cflibs_external_pose() -> None:
    cflib, flown = CflibPackets(), Flown(Hold(HOME), 0.1)
    cflib.localisation.send_extpose((1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5))
    poses = [crtp.encode(packet) for _, packet in flown.of(crtp.PORT_LOCALISATION)]
    assert len(poses) == 10
    assert {masked(pose)[: len(cflib.packets[0])] for pose in poses} == {masked(cflib.packets[0])}


def test_parameters_arming_take_off_landing_and_stop_come_in_their_order() -> None:
    flown = Flown(Hold(HOME), 15.0)
    written = [packet.data for _, packet in flown.of(crtp.PORT_PARAMETERS)]
    assert written == [struct.pack("<HB", *pair) for pair in ((3, 2), (4, 3), (9, 1), (9, 0))]
    platform = flown.of(crtp.PORT_PLATFORM)
    assert [packet.data for _, packet in platform] == [b"\0", b"\2", b"\1\1"]  # its version; recover, arm
    assert 2_000_000 < platform[0][0] < 3_000_000
    commands = [(us, high_level.decode(packet.data)[0].name) for us, packet in flown.of(high_level.PORT)]
    assert commands == [(3_000_000, "TAKE_OFF"), (11_700_000, "LAND"), (14_700_000, "STOP")]
    assert flown.of(crtp.PORT_GENERIC_SETPOINT) == []  # home needs none
    assert flown.link.notices == [
        "stabilizer.estimator 2", "stabilizer.controller 3", "kalman.resetEstimation 1",
        "kalman.resetEstimation 0", "armed",
    ]  # fmt: skip


@pytest.mark.parametrize("protocol", [10, 11, 12, 13])
def test_boards_that_have_the_supervisors_port_are_armed_there_as_by_cflib(protocol: int) -> None:
    sent, client = [], Crazyflie()
    client.send_packet = lambda packet, *_, **__: sent.append(
        (packet.port, packet.channel, bytes(packet.data))
    )
    client.platform.get_protocol_version = lambda: protocol
    with warnings.catch_warnings(action="ignore"):  # of older firmware
        client.supervisor.send_crash_recovery_request()
        client.supervisor.send_arming_request(True)
    flown = Flown(Hold(HOME), 4.0, protocol=protocol)
    ours = [
        (packet.port, packet.channel, packet.data)
        for _, packet in flown.sent
        if packet.port in (crtp.PORT_PLATFORM, crtp.PORT_SUPERVISOR)
    ]
    assert ours[1:] == sent
    assert flown.link.notices[-1] == "armed"


def test_a_goal_that_leaves_home_is_sent_until_the_landing() -> None:
    y, yaw = (Square(size, 0.0, 1 / 1.5) for size in (0.2, radians(30)))  # and back, and away at the end
    steps = Offsets(HOME, 8_000_000, y=y, yaw=yaw)
    flown = Flown(steps, 13.0)
    *places, (last_us, end) = flown.of(crtp.PORT_GENERIC_SETPOINT)
    assert places[0][0] == 8_000_000
    assert len(places) == (11_700_000 - 8_000_000) // PERIOD_US
    position, yaw = setpoints.decode_place(places[-1][1].data)
    assert position == pytest.approx((0.0, 0.2, 1.0))
    assert yaw == pytest.approx(radians(30))
    assert (last_us, end.channel) == (11_700_000, setpoints.CHANNEL_NOTICE)


def test_a_moving_goal_is_sent_with_every_pose_however_close_they_are() -> None:
    goal = Goal((0.1, 0.2, 1.3), 0.4)
    flown, begin_us = Flown(Hold(goal), 8.0), 8_000_000
    flown.sent.clear()
    for now_us in range(begin_us, begin_us + 5):
        flown.link.send(now_us, MocapFrame(now_us, (1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5), True), goal)
    for port in (crtp.PORT_LOCALISATION, crtp.PORT_GENERIC_SETPOINT):
        assert [us - begin_us for us, _ in flown.of(port)] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("away", "sent"), [(AWAY, False), (1.01 * AWAY, True)])
def test_a_goal_within_a_millimetre_of_home_is_home(away: float, sent: bool) -> None:
    flown = Flown(Offsets(HOME, 8_000_000, y=Step(away)), 13.0)
    assert bool(flown.of(crtp.PORT_GENERIC_SETPOINT)) == sent


def test_a_board_that_refuses_or_is_silent_is_reported() -> None:
    for protocol in (10, 12):
        refused = Flown(Hold(HOME), 4.0, refuse=True, protocol=protocol)
        assert refused.link.notices[-1] == "the board refuses to recover"
    silent = Flown(Hold(HOME), 3.0, deaf=True)
    assert silent.link.notices == ["no answer within 2 s"]
    assert silent.of(high_level.PORT) == []


def test_goals_of_take_off_and_landing_are_the_firmwares_polynomial() -> None:
    """At rest at both ends: velocity, acceleration and jerk are zero there, and a seventh-order polynomial is unique."""
    fitted = np.polynomial.Polynomial.fit(
        np.linspace(0, 1, 20), [smooth(s) for s in np.linspace(0, 1, 20)], 7
    )
    for order, (begin, end) in enumerate(((0, 1), (0, 0), (0, 0), (0, 0))):
        there = fitted.deriv(order) if order else fitted
        assert (there(0.0), there(1.0)) == pytest.approx((begin, end), abs=1e-6)
    goals = FromFloor(Offsets(HOME, 8_000_000, y=Step(0.2)), 0.015, HOME, CONFIG, TIMES)
    assert goals.at(0).p_WG == (0.0, 0.0, 0.015)
    assert goals.at(4_000_000).p_WG[2] == pytest.approx(0.5 * (1.0 + 0.015))
    assert goals.at(6_000_000) == HOME
    assert goals.at(9_000_000).p_WG == (0.0, 0.2, 1.0)
    assert goals.at(12_700_000).p_WG == pytest.approx((0.0, 0.2, 0.5 * (1.0 + 0.015)))
    assert goals.at(15_000_000).p_WG == (0.0, 0.2, 0.015)


def test_log_blocks_fit_a_packet() -> None:
    assert all(block.layout.size <= 26 for block in CRAZYFLIE_BLOCKS)
    assert len({block.id for block in CRAZYFLIE_BLOCKS}) == len(CRAZYFLIE_BLOCKS)
