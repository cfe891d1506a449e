"""A robot that is flown by its station while another client sends random bytes: nothing is lost, on either protocol.

The client sends 5,000 packets per second, some 85 kB/s, as fast as the radio's queue takes them. What is left out are
requests that are a client's right, see `support.random_requests`.
"""

import struct

import numpy as np
import pytest

from firmware_py.wire import crtp, high_level
from hil.board.clock import FreeRunning
from hil.config import load_config
from hil.servers.built_in_station import fly_built_in
from hil.servers.server import Server, Service
from support.mavlink_client import STATION, codec
from support.mavlink_lab import MavlinkLab
from support.random_requests import harmless_message, random_packet, spoilt

PERIOD_US = 200


class Fuzzed:
    """One robot and a client on its UDP radio: its own station flies it, or a command by absolute poses."""

    def __init__(self, seed: int, absolute: bool) -> None:
        self.said: list[str] = []
        config = load_config("floaty", [f"predictor.absolute={absolute}"])
        self.server = Server(Service(config), self.said.append)
        self.server.lab.clock = FreeRunning()
        self.served = self.server.served
        fly_built_in(self.served.robot, absolute)
        self.rng = np.random.default_rng(seed)
        if absolute:
            self.wait(1.0)
            self.served.robot.packet_received(self.server.lab.now_us, go_to(config.flight.home))
        self.wait(3.5)

    def wait(self, duration_s: float) -> float:
        """Fly on and return how far the robot was from home at most [m]."""
        lab, robot, furthest = self.server.lab, self.served.robot, 0.0
        for _ in range(round(duration_s * 10)):
            lab.end_at(lab.now_us + 100_000)
            lab.run()
            furthest = max(furthest, float(np.abs(robot.body.p_WB - robot.config.flight.home).max()))
        return furthest

    def flood(self, now_us: int) -> None:
        """Send one random packet."""
        self.served.udp_radio.uplink(now_us, random_packet(self.rng))


def go_to(place: tuple[float, float, float]) -> bytes:
    """cflib's command, to be there within a second."""
    fields = struct.pack("<BB2?5f", high_level.PathCommand.GO_TO, 0, False, False, *place, 0.0, 1.0)
    return crtp.encode(crtp.Packet(high_level.PORT, 0, fields))


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "duration_s", "absolute"),
    [(2, 10.0, False), (3, 10.0, True)],
    ids=["corrections", "absolute poses"],
)
def test_a_client_s_random_packets_lose_nothing(seed: int, duration_s: float, absolute: bool) -> None:
    fuzzed = Fuzzed(seed, absolute)
    robot = fuzzed.served.robot
    assert robot.free
    robot.events.every(PERIOD_US, robot.events.now_us + 1, fuzzed.flood)
    assert fuzzed.wait(duration_s) < 0.15, fuzzed.said[-5:]
    assert robot.firmware.link.malformed > 50 * duration_s
    assert not any("lost" in line or "failsafe" in line for line in fuzzed.said)
    lines = [line for line in fuzzed.said if "commander" in line]
    assert len(lines) < 40 + 4 * duration_s  # throttled: there are some twenty kinds


@pytest.mark.long
def test_random_messages_and_bytes_on_the_serial_line_lose_nothing() -> None:
    lab, rng, sender = MavlinkLab(flying=True), np.random.default_rng(4), codec(*STATION)
    lab.run(4.5)
    assert lab.robot.free

    def flood(now_us: int) -> None:
        """Send a message that must not be obeyed, one that is spoilt, or bytes."""
        frame, kind = bytes(harmless_message(rng).pack(sender)), rng.random()
        lab._uplink(now_us, frame if kind < 0.7 else spoilt(rng, frame) if kind < 0.9 else rng.bytes(40))

    lab.robot.events.every(1000, lab.robot.events.now_us + 1, flood)
    for _ in range(100):
        lab.run(0.1)
        assert np.abs(lab.place - lab.robot.config.flight.home).max() < 0.15, lab.said[-5:]
    assert lab.robot.firmware.mavlink is not None
    assert lab.robot.firmware.mavlink.counters.bad > 500
    assert not any("lost" in line or "failsafe" in line for line in lab.said)
