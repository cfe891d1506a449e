"""A ground station that speaks pymavlink's own codec to a board on a bench: requests in, messages out, in simulated time."""

from collections.abc import Iterable
from functools import partial
from typing import Any

import pymavlink.dialects.v20.development as dialect

from support.firmware_bench import LEVEL, FirmwareBench

STATION = (255, 190)
STREAMS = (
    "HEARTBEAT", "SYS_STATUS", "BATTERY_STATUS", "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED",
    "SERVO_OUTPUT_RAW", "ESTIMATOR_STATUS", "NAMED_VALUE_FLOAT", "SYSTEM_TIME", "CURRENT_MODE",
    "POSITION_TARGET_LOCAL_NED", "VFR_HUD", "ACTUATOR_OUTPUT_STATUS", "HOME_POSITION", "ODOMETRY",
)  # fmt: skip
GYRO_ZERO_US = 600_000  # the gyro's zero is found by then
Pose = tuple[tuple[float, float, float], tuple[float, float, float, float]]
HOME: Pose = ((0.0, 0.0, 1.15), LEVEL)  # W, z up


class MavlinkClient(FirmwareBench):
    """`messages` is what pymavlink found in the board's bytes, with the instant at which they left."""

    uart_overruns = 0

    def __init__(self, *overrides: str, station: tuple[int, int] = STATION) -> None:
        self.codec = codec(*station)
        self.parser = codec(0, 0)
        self.messages: list[tuple[int, Any]] = []
        self.uplink = bytearray()
        self.uart_room = 1 << 30  # bytes that the transmit buffer still takes
        self.clock_ahead_us: int | None = None  # of the station; None: it does not answer
        super().__init__(*overrides, mavlink=True)
        self.overrides = overrides
        assert self.firmware.mavlink is not None
        self.stack = self.firmware.mavlink

    def uart_read(self) -> bytes:
        data = bytes(self.uplink)
        self.uplink.clear()
        return data

    def uart_write(self, data: bytes) -> bool:
        if len(data) > self.uart_room:
            return False
        self.uart_room -= len(data)
        for message in self.parser.parse_buffer(bytearray(data)) or ():
            self.messages.append((self.now_us, message))
            if message.get_type() == "TIMESYNC" and message.tc1 == 0 and self.clock_ahead_us is not None:
                self.events.at(self.now_us + 2000, partial(self._tell_time, message.ts1))
        return True

    def _tell_time(self, ts1: int, now_us: int) -> None:
        """Answer a request that took 2 ms; the answer takes as long."""
        assert self.clock_ahead_us is not None
        data = self.codec.timesync_encode((now_us + self.clock_ahead_us) * 1000, ts1).pack(self.codec)
        self.events.at(now_us + 2000, lambda _: self.receive(data))

    def receive(self, data: bytes) -> None:
        self.uplink += data
        self.firmware.uart_ready()

    def send(self, name: str, *fields: Any) -> None:
        self.receive(getattr(self.codec, f"{name}_encode")(*fields).pack(self.codec))

    def ask(self, name: str, *fields: Any, wait_us: int = 3000) -> list[Any]:
        """Send, and return what the board answers within a while."""
        self.messages.clear()
        self.send(name, *fields)
        self.run(self.now_us + wait_us)
        return [message for _, message in self.messages]

    def one(self, name: str, *fields: Any) -> Any:
        """The only answer, whatever the board sent by itself meanwhile."""
        answers = [answer for answer in self.ask(name, *fields) if answer.get_type() not in STREAMS]
        assert len(answers) == 1, answers
        return answers[0]

    def command(self, number: int, *params: float, target: tuple[int, int] = (1, 1)) -> list[Any]:
        """The answers to a COMMAND_LONG."""
        return self.ask("command_long", *target, number, 0, *params, *(0.0,) * (7 - len(params)))

    def pose(self, pose: Pose = HOME, t_us: int | None = None) -> None:
        """A pose given z up, sent as the standard has it."""
        (x, y, z), (qw, qx, qy, qz) = pose
        stamp_us = self.now_us if t_us is None else t_us
        self.send("att_pos_mocap", stamp_us, (qw, qx, -qy, -qz), x, -y, -z)

    def poses(self, start_us: int, end_us: int, p: Any = HOME[0], lag_us: int = 0) -> None:  # type: ignore[override]
        """Level poses at 50 Hz, each `lag_us` old by the station's clock."""
        for at_us in range(start_us, end_us, 20_000):
            stamp_us = at_us - lag_us + (self.clock_ahead_us or 0)
            self.events.at(at_us, lambda _, t_us=stamp_us: self.pose((p, LEVEL), t_us))

    def of(self, kind: str) -> list[Any]:
        return [message for _, message in self.messages if message.get_type() == kind]

    def texts(self) -> list[str]:
        return lines(self.of("STATUSTEXT"))


def lines(texts: Iterable[Any]) -> list[str]:
    """What these STATUSTEXTs say; a long line comes in pieces."""
    found: list[str] = []
    for message in texts:
        if message.chunk_seq:
            found[-1] += message.text
        else:
            found.append(message.text)
    return found


def codec(system: int, component: int) -> Any:
    made = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    made.robust_parsing = True
    return made


def count(messages: Iterable[Any]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for message in messages:
        counts[message.get_type()] = counts.get(message.get_type(), 0) + 1
    return counts
