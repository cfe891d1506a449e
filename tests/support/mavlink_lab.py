"""A served robot with a MAVLink line whose far end is pymavlink's own codec, without a wall clock."""

from collections.abc import Callable
from typing import Any

from hil.board.clock import FreeRunning, Readers
from hil.config import load_config
from hil.laboratory.robot import Robot
from hil.servers.built_in_station import fly_built_in
from hil.servers.server import Server, Service
from support.mavlink_client import STATION, codec, lines


class MavlinkLab:
    """`messages` is what the client has heard, with the instant; `flying` has a ground station, on a wire of its own."""

    master = "here"

    def __init__(self, *settings: str, flying: bool = False, absolute: bool = False) -> None:
        self.said: list[str] = []
        self.messages: list[tuple[int, Any]] = []
        self._codec, self._parser = codec(*STATION), codec(0, 0)
        self.server = Server(Service(load_config("floaty", settings), mavlink=True), self.said.append)
        self.server.lab.clock = FreeRunning()
        self.served = self.server.served
        self.robot: Robot = self.served.robot
        self.served.serve_mavlink(self, {})  # type: ignore[arg-type]
        if flying:
            fly_built_in(self.robot, absolute)
        self.run(0.1)

    @property
    def now_us(self) -> int:
        return self.server.lab.now_us

    @property
    def faults(self) -> dict[str, float]:
        """The faults in force, and their sizes."""
        active = self.server.switchboard.active
        assert len({fault.kind for fault in active}) == len(active)
        return {fault.kind: fault.size for fault in active}

    # The end of the line

    def open(
        self, readers: Readers, received: Callable[[int, bytes], object], say: Callable[[str], None]
    ) -> "MavlinkLab":
        self._uplink = received
        return self

    def send(self, data: bytes) -> None:
        now_us = self.server.lab.events.now_us
        for message in self._parser.parse_buffer(bytearray(data)) or ():
            self.messages.append((now_us, message))
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self.tell("timesync", now_us * 1000, message.ts1)

    # The client

    def run(self, duration_s: float) -> None:
        lab = self.server.lab
        lab.end_at(lab.now_us + round(duration_s * 1e6))
        lab.run()

    def tell(self, name: str, *fields: Any) -> None:
        message = getattr(self._codec, f"{name}_encode")(*fields)
        self._uplink(self.server.lab.events.now_us, message.pack(self._codec))

    def goal(self, x: float, y: float, z: float, yaw: float = 0.0) -> None:
        """Send a goal, z up."""
        self.tell("set_position_target_local_ned", 0, 1, 1, 1, 0x9F8, x, -y, -z, 0, 0, 0, 0, 0, 0, -yaw, 0)

    def repeat(self, goal: tuple[float, ...], duration_s: float) -> list[Any]:
        """Send a goal 20 times per second; returns where the robot was each time."""
        places = []
        for _ in range(round(20 * duration_s)):
            self.goal(*goal)
            self.run(0.05)
            places.append(self.place)
        return places

    @property
    def place(self) -> Any:
        """Where the robot truly is [m, W]."""
        return self.robot.body.p_WB.copy()

    def command(self, number: int, *params: float) -> Any:
        """Send a COMMAND_LONG; returns what comes of it, None when no acknowledgement comes."""
        self.messages.clear()
        self.tell("command_long", 1, 1, number, 0, *params, *(0.0,) * (7 - len(params)))
        self.run(0.05)
        return next((message.result for message in self.of("COMMAND_ACK")), None)

    def of(self, kind: str) -> list[Any]:
        return [message for _, message in self.messages if message.get_type() == kind]

    def texts(self) -> list[str]:
        return lines(self.of("STATUSTEXT"))

    def armed(self) -> bool:
        """What the next heartbeat says."""
        self.messages.clear()
        self.run(1.05)
        return bool(self.of("HEARTBEAT")[-1].base_mode & 128)
