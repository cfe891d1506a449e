"""A served robot that flies by absolute poses and cflib's commanders alone, as standard scripts and cflib's examples do.

The poses are the script's, or those of `floaty serve --station poses`. Commanders sleep in simulated time.
"""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from math import tau
from types import SimpleNamespace

import numpy as np
import pytest
from cflib.crazyflie.commander import Commander
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.mem.trajectory_memory import Poly4D
from cflib.positioning import position_hl_commander
from cflib.positioning.position_hl_commander import PositionHlCommander
from numpy.polynomial import Polynomial

from firmware_py.geometry import to_euler_zyx
from firmware_py.wire.crtp import PORT_MEMORIES, Packet, encode, encode_ext_pose
from ground_station.mocap import MocapFrame
from hil.board.clock import FreeRunning
from hil.config import load_config
from hil.servers.built_in_station import fly_built_in
from hil.servers.server import Server, Service

POSE_PERIOD_US = 20_000
LOOK_PERIOD_US = 10_000
TRAJECTORIES = 1  # the memory's number
RMS_M = 0.06


class Script:
    """cflib's commanders and a feed of poses, on the time line of the laboratory; `station`: poses are the server's."""

    def __init__(self, station: bool = False) -> None:
        self.said: list[str] = []
        self.server = Server(Service(load_config()), self.said.append)
        self.server.lab.clock = FreeRunning()
        self.robot = self.server.robot
        self._next_us = 0
        if station:
            fly_built_in(self.robot, absolute=True)
        else:
            self.robot.seen_by(lambda frame, now_us, _: self._feed(frame, now_us))
        self.cf = SimpleNamespace(
            send_packet=lambda packet: self._send(bytes((packet.header, *packet.data))),
            platform=SimpleNamespace(get_protocol_version=lambda: 12),
            param=SimpleNamespace(set_value=lambda name, value: None),
            is_connected=lambda: True,
        )
        self.commander = self.cf.high_level_commander = HighLevelCommander(self.cf)
        self.low_level = Commander(self.cf)
        self._errors: list[np.ndarray] = []
        self.robot.events.every(LOOK_PERIOD_US, LOOK_PERIOD_US, self._look)
        parameters = {parameter.name: parameter for parameter in self.robot.firmware.parameters}
        parameters["extPose.absolute"].set(1)
        self.wait(2.0)

    def _feed(self, frame: MocapFrame, now_us: int) -> None:
        """What cflib's send_extpose sends: no age."""
        if now_us >= self._next_us and frame.valid:
            self._next_us = now_us + POSE_PERIOD_US
            self.robot.packet_received(now_us, encode_ext_pose(frame.p_WB, frame.q_WB, None)[:-1])

    def _send(self, packet: bytes) -> None:
        self.robot.packet_received(self.server.lab.now_us, packet)

    def _look(self, now_us: int) -> None:
        """Note how far the robot is from its goal while there is one."""
        pilot = self.robot.firmware.pilot
        if not pilot.stabilizer.high_level.planner.rests:
            self._errors.append(self.robot.body.p_WB - pilot.frame().position)

    def follows(self, duration_s: float) -> bool:
        """Whether the robot had a goal for that long, followed it within the limit on every axis and was not lost."""
        rms_m = np.sqrt(np.mean(np.square(self._errors), axis=0))
        assert len(self._errors) * LOOK_PERIOD_US == pytest.approx(duration_s * 1e6, abs=3e5)
        return bool(rms_m.max() < RMS_M) and not any(
            "lost" in line or "refused" in line for line in self.said
        )

    def upload(self, data: bytes) -> None:
        """Write to the trajectory memory."""
        for start in range(0, len(data), 24):
            piece = struct.pack("<BI", TRAJECTORIES, start) + data[start : start + 24]
            self._send(encode(Packet(PORT_MEMORIES, 2, piece)))
            self.wait(0.01)

    @contextmanager
    def time(self) -> Iterator[None]:
        """Let cflib's position commander sleep in simulated time."""
        real = position_hl_commander.time
        position_hl_commander.time = SimpleNamespace(
            time=lambda: self.server.lab.now_us * 1e-6, sleep=self.wait
        )
        try:
            yield
        finally:
            position_hl_commander.time = real

    def wait(self, duration_s: float) -> None:
        lab = self.server.lab
        lab.end_at(lab.now_us + round(duration_s * 1e6))
        lab.run()

    def off(self, x: float, y: float, z: float) -> float:
        return float(np.abs(self.robot.body.p_WB - (x, y, z)).max())


@pytest.mark.long
def test_a_standard_sequence_takes_off_moves_and_lands() -> None:
    script = Script()
    assert script.robot.free  # it flies where it was held
    script.commander.takeoff(1.0, 2.0)
    script.wait(4.0)
    assert script.off(0.0, 0.0, 1.0) < 0.05
    script.commander.go_to(0.12, -0.08, 1.2, 0.5, 3.0)
    script.wait(5.0)
    assert script.off(0.12, -0.08, 1.2) < 0.06
    assert to_euler_zyx(script.robot.body.q_WB)[2] == pytest.approx(0.5, abs=0.1)
    script.commander.land(0.9, 3.0, yaw=None)
    script.wait(2.9)
    assert script.off(0.12, -0.08, 0.9) < 0.08
    script.wait(0.2)
    assert script.off(0.12, -0.08, 0.9) < 0.08  # it stays where it has landed
    assert not any("lost" in line for line in script.said)


def eight(size: float, duration_s: float) -> list[Poly4D]:
    """A figure of eight, lying, in eight pieces."""
    pieces = []
    length_s = duration_s / 8
    t = np.linspace(0.0, length_s, 50)
    for number in range(8):
        phase = tau * (number * length_s + t) / duration_s
        x, y = (
            Polynomial.fit(t, values, 7, domain=[0, length_s], window=[0, length_s]).coef.tolist()
            for values in (size * np.sin(phase), size / 2 * np.sin(2 * phase))
        )
        pieces.append(Poly4D(length_s, Poly4D.Poly(x), Poly4D.Poly(y)))
    return pieces


@pytest.mark.long
@pytest.mark.parametrize("station", [False, True], ids=["poses of the script", "poses of the station"])
def test_a_trajectory_between_take_off_and_landing_is_followed(station: bool) -> None:
    script = Script(station)
    pieces = eight(0.06, 8.0)
    script.upload(b"".join(piece.pack() for piece in pieces))
    script.commander.define_trajectory(1, 0, len(pieces))
    script.commander.takeoff(1.0, 2.0)
    script.wait(3.0)
    script.commander.start_trajectory(1, 1.0, relative_position=True)
    script.wait(8.0)
    script.commander.land(0.9, 2.0)
    script.wait(2.0)
    assert script.follows(13.0)


@pytest.mark.long
def test_the_position_commander_goes_from_place_to_place() -> None:
    script = Script(station=True)
    with (
        script.time(),
        PositionHlCommander(
            script.cf,
            default_height=1.1,
            default_landing_height=0.9,
            controller=PositionHlCommander.CONTROLLER_PID,
        ) as commander,
    ):
        commander.forward(0.05)
        commander.left(0.05)
        commander.back(0.05)
        commander.go_to(0.0, 0.0, 1.1)
    assert script.follows(2.2 + 4 * 0.1 + 0.4)
