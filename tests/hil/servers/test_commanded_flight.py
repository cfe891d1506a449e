"""A served robot that flies by absolute poses and the high-level commander alone, as a standard script lets it."""

from types import SimpleNamespace

import numpy as np
import pytest
from cflib.crazyflie.high_level_commander import HighLevelCommander

from firmware_py.geometry import to_euler_zyx
from firmware_py.wire.crtp import encode_ext_pose
from ground_station.mocap import MocapFrame
from hil.clock import FreeRunning
from hil.config import load_config
from hil.servers.server import Server

POSE_PERIOD_US = 20_000


class Script:
    """cflib's commander and a feed of poses, on the time line of the laboratory."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.server = Server(load_config(), 1, 1, self.said.append)
        self.server.lab.clock = FreeRunning()
        self.robot = self.server.lab.robots[0]
        self._next_us = 0
        self.robot.seen_by(lambda frame, now_us, _: self._feed(frame, now_us))
        packets = SimpleNamespace(
            send_packet=lambda packet: self.robot.packet_received(0, bytes((packet.header, *packet.data))),
            platform=SimpleNamespace(get_protocol_version=lambda: 12),
        )
        self.commander = HighLevelCommander(packets)
        parameters = {parameter.name: parameter for parameter in self.robot.firmware.parameters}
        parameters["extPose.absolute"].set(1)
        self.wait(2.0)

    def _feed(self, frame: MocapFrame, now_us: int) -> None:
        """What cflib's send_extpose sends: no age."""
        if now_us >= self._next_us and frame.valid:
            self._next_us = now_us + POSE_PERIOD_US
            self.robot.packet_received(now_us, encode_ext_pose(frame.p_WB, frame.q_WB, None)[:-1])

    def wait(self, duration_s: float) -> None:
        lab = self.server.lab
        lab.end_us = lab.now_us + round(duration_s * 1e6)
        lab.run()

    def off(self, x: float, y: float, z: float) -> float:
        """How far the robot is from there [m]."""
        return float(np.abs(self.robot.plant.p_WB - (x, y, z)).max())


@pytest.mark.long
def test_a_standard_sequence_takes_off_moves_and_lands() -> None:
    script = Script()
    assert not script.robot.free  # it waits in its holder
    script.commander.takeoff(1.0, 2.0)
    script.wait(4.0)
    assert script.robot.free
    assert script.off(0.0, 0.0, 1.0) < 0.05
    script.commander.go_to(0.15, -0.1, 1.2, 0.5, 3.0)
    script.wait(5.0)
    assert script.off(0.15, -0.1, 1.2) < 0.06
    assert to_euler_zyx(script.robot.plant.q_WB)[2] == pytest.approx(0.5, abs=0.1)
    script.commander.land(0.9, 3.0, yaw=None)
    script.wait(2.9)
    assert script.off(0.15, -0.1, 0.9) < 0.08
    script.wait(0.2)
    assert script.said[-1].endswith("supervisor: waiting")
    assert not any("lost" in line for line in script.said)
