"""A board answers the same random operators with the same bytes at the same instants as it did.

An operator flies, steers, arms, disarms, stops, asks, logs, stores, loses the link, drains the battery and sends
nonsense, in any order; its commander and its small services get each request. If a change is meant,
compare what it does with the original firmware, and write the answers anew:

    make approve
"""

import hashlib
import struct
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pymavlink.dialects.v20.development as dialect
import pytest

from firmware_py.crazyflie.high_level_commander import HighLevelCommander
from firmware_py.crazyflie.planner import PathPoint
from firmware_py.crazyflie.trajectories import POINTS
from firmware_py.geometry import Vector
from firmware_py.wire import crtp, setpoints
from firmware_py.wire.high_level import PathCommand, encode
from firmware_py.wire.parameters import encode_pose_kind
from support.approved import Log, approve, judge, tiers
from support.crtp_client import LINK, LOC, LOG, MEM, PARAM, PLATFORM, SUPERVISOR, CrtpClient
from support.firmware_bench import LEVEL, FirmwareBench
from support.mavlink_client import MavlinkClient
from support.random_use import Random

ANSWERS = Path(__file__).with_name("services.json")
OPERATIONS, SEEDS = 220, range(1, 7)


class Operator:
    """Random operations on a board on its bench."""

    def __init__(self, bench: FirmwareBench, seed: int) -> None:
        self.bench, self.rng = bench, np.random.default_rng(seed)
        self.states: list[str] = []
        self.place, self.age_us, self.cameras = np.zeros(3), 40_000, True

    def number(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def pick(self, *of: Any) -> Any:
        return of[int(self.rng.integers(len(of)))]

    def operate(self, operations: tuple[Callable[[], object], ...]) -> None:
        """Fly half of the operations in peace, and note the supervisors' states."""
        self.bench.imu_alive = True
        for number in range(OPERATIONS):
            if self.rng.random() < 0.6:
                self.pick(*operations)()
            until_us = self.bench.now_us + int(self.rng.choice((1_000, 10_000, 30_000, 200_000)))
            while self.bench.now_us < until_us:
                if self.cameras:
                    self.pose()
                self.bench.run(min(until_us, self.bench.now_us + 20_000))
            core = self.bench.firmware.signals.supervisor
            own = self.bench.firmware.pilot.stabilizer.supervisor
            state = f"{core.state.name} {core.cause.name} {own.state.name}"
            if not self.states or self.states[-1].partition(": ")[2] != state:
                self.states.append(f"{number}: {state}")

    def pose(self) -> None:
        """Send where the robot is."""
        raise NotImplementedError

    def world(self) -> None:
        """Something outside happens."""
        what = self.pick("move", "blind", "late", "still", "drain", "silent", "well", "well", "well")
        self.cameras, self.age_us = what != "blind", 40_000
        self.bench.polling, self.bench.imu_noise = what != "silent", int(what != "still")
        if what == "move":
            self.place = self.rng.normal(0.0, 0.05, 3)
        if what == "late":
            self.age_us = self.pick(0, 20_000, 90_000, 130_000)
        self.bench.supply(self.pick(3300, 3000, 2800) if what == "drain" else 4000)


class CrtpOperator(Operator):
    """Speaks CRTP."""

    bench: CrtpClient

    def pose(self) -> None:
        """Send where the robot is."""
        self.bench.pose(self.bench.now_us, tuple(map(float, self.place)), self.age_us)

    def send(self, port: int, channel: int, data: bytes) -> None:
        self.bench.send(port, channel, data)

    def path(self) -> None:
        """Command the high-level commander."""
        height, yaw, time = self.number(-0.3, 1.0), self.number(-4, 4), self.number(0.2, 3.0)
        command = self.pick(
            encode(PathCommand.TAKE_OFF, 0, height, yaw, int(self.rng.integers(2)), time),
            encode(PathCommand.LAND, 0, height, yaw, int(self.rng.integers(2)), time),
            encode(PathCommand.GO_TO, 0, int(self.rng.integers(2)), 0, *self.rng.normal(0, 0.2, 3), yaw, time),
            encode(PathCommand.STOP, 0),
        )  # fmt: skip
        self.send(8, 0, command[1:])

    def steer(self) -> None:
        """Send a set-point, or nonsense of its ports."""
        place = tuple(map(float, self.rng.normal(0.0, 0.1, 3)))
        self.send(*self.pick(
            (7, 0, setpoints.encode_place(place, self.number(-180, 180))),
            (7, 1, setpoints.encode_end()),
            (7, 0, bytes((int(self.rng.integers(10)),)) + self.rng.bytes(16)),
            (3, 0, struct.pack("<fffH", *self.rng.normal(0, 5, 3), self.pick(0, 0, 30_000))),
        ))  # fmt: skip

    def supervise(self) -> None:
        """Arm, disarm, recover, stop, ask."""
        self.send(*self.pick(
            (SUPERVISOR, 1, b"\x01\x01"), (SUPERVISOR, 1, b"\x01\x00"), (SUPERVISOR, 1, b"\x02"),
            (SUPERVISOR, 0, b"\x0c"), (PLATFORM, 0, b"\1\1"), (PLATFORM, 0, b"\1\0"),
            (LOC, 1, self.pick(b"\4", b"\4", b"\4", b"\3")),
            (LINK, 0, b"echo"), (LINK, 1, b"\0"), (PLATFORM, 1, b"\0"), (PLATFORM, 1, b"\1"), (PLATFORM, 1, b"\2"),
        ))  # fmt: skip

    def parameters(self) -> None:
        """Read, write and store parameters."""
        number = struct.pack("<H", int(self.rng.integers(self.bench_parameters + 2)))
        value = struct.pack("<f", self.pick(0.0, 1.0, -1.0, self.number(-3, 3)))
        self.send(PARAM, *self.pick(
            (0, b"\2" + number), (0, b"\3"), (1, number), (1, number), (2, number + value), (2, number + b"\1"),
            (3, bytes((self.pick(2, 3, 4, 5, 6, 7, 8),)) + number),
        ))  # fmt: skip

    def logs(self) -> None:
        """Create, start, stop and delete blocks of any variables."""
        block = int(self.rng.integers(3))
        items = b"".join(
            struct.pack("<BH", self.pick(1, 3, 7, 7, 7), int(self.rng.integers(self.bench_logs)))
            for _ in range(4)
        )
        self.send(LOG, *self.pick(
            (1, bytes((6, block)) + items), (1, bytes((6, block)) + items), (1, bytes((7, block)) + items[:3]),
            (1, bytes((8, block)) + struct.pack("<HH", self.pick(20, 50), 0)), (1, bytes((3, block, self.pick(1, 5)))),
            (1, bytes((4, block))), (1, bytes((2, block))), (1, b"\5"), (0, b"\2" + items[1:3]), (0, b"\3"),
        ))  # fmt: skip

    def memories(self) -> None:
        """Read and write memories."""
        memory = int(self.rng.integers(6))
        at = struct.pack("<BI", memory, self.pick(0, 4, 8, 16, 100))
        self.send(MEM, *self.pick(
            (0, b"\1"), (0, bytes((2, memory))), (1, at + bytes((self.pick(0, 1, 16, 24, 40),))),
            (2, at + self.rng.bytes(12)),
        ))  # fmt: skip

    def fly(self) -> dict[str, str]:
        """Return what the board sent on each port, what it printed and how it moved."""
        bench = self.bench
        bench.firmware.radio_received(encode_pose_kind(bool(self.rng.integers(2))))
        service = bench.firmware.parameter_numbers
        self.bench_parameters, self.bench_logs = len(service), len(bench.firmware.log_numbers)
        self.operate(
            (
                self.path,
                self.path,
                self.steer,
                self.supervise,
                self.parameters,
                self.logs,
                self.memories,
                self.world,
            )
        )
        ports: dict[str, list[bytes]] = defaultdict(list)
        for at_us, raw in bench.sent:
            packet = crtp.decode(raw)
            ports[f"port {packet.port}"].append(struct.pack("<qB", at_us, packet.channel) + packet.data)
        return told(self, ports)


class MavlinkOperator(Operator):
    """Speaks MAVLink."""

    bench: MavlinkClient

    def pose(self) -> None:
        """Send where the robot is, as the standard has it."""
        self.bench.pose((tuple(map(float, self.place)), LEVEL), self.bench.now_us + 3_000_000 - self.age_us)

    def command(self) -> None:
        """Send a command that the board knows, or another."""
        number = self.pick(
            dialect.MAV_CMD_NAV_TAKEOFF, dialect.MAV_CMD_NAV_LAND, dialect.MAV_CMD_COMPONENT_ARM_DISARM,
            dialect.MAV_CMD_COMPONENT_ARM_DISARM, dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
            dialect.MAV_CMD_DO_SET_MODE, dialect.MAV_CMD_DO_REPOSITION, dialect.MAV_CMD_GET_MESSAGE_INTERVAL,
            dialect.MAV_CMD_DO_FLIGHTTERMINATION, dialect.MAV_CMD_PREFLIGHT_STORAGE, 12345,
        )  # fmt: skip
        first = self.pick(0, 1, 1, 30, 32, 36, 105, 331, 148, 2)
        fields = (first, self.pick(0, 0, 21196, 50_000, -1), *(self.number(-2, 2) for _ in range(5)))
        target = (self.pick(1, 1, 1, 7), 1)
        if self.rng.random() < 0.5:
            self.bench.send("command_long", *target, number, 0, *map(float, fields))
        else:
            self.bench.send(
                "command_int", *target, 1, number, 0, 0, *map(float, fields[:4]), 1, 2, float(fields[6])
            )

    def goal(self) -> None:
        """Send a set-point of some frame and mask."""
        mask = self.pick(0x0DF8, 0x09F8, 0x0DC7, 0x0FFF, 0)
        numbers = [float(one) for one in self.rng.normal(0, 0.1, 11)]
        self.bench.send(
            "set_position_target_local_ned",
            self.bench.now_us // 1000,
            1,
            1,
            self.pick(1, 1, 8, 7),
            mask,
            *numbers,
        )

    def parameters(self) -> None:
        """Read, write and list parameters."""
        name = self.pick(*self.names).encode()
        index = int(self.rng.integers(-1, len(self.names) + 2))
        if self.rng.random() < 0.5:
            self.bench.send("param_request_read", 1, 1, name if index < 0 else b"", index)
        elif self.rng.random() < 0.1:
            self.bench.send("param_request_list", 1, 1)
        else:
            self.bench.send("param_set", 1, 1, name, self.pick(0.0, 1.0, self.number(-3, 3)), 9)

    def others(self) -> None:
        """Tell the time, a heartbeat, a ping, missions, or nothing that anyone knows."""
        bench = self.bench
        kind = self.pick(
            "heartbeat", "timesync", "ping", "mission_request_list", "manual_control", "noise", "system_time"
        )
        if kind == "heartbeat":
            bench.send("heartbeat", 6, 8, 0, 0, 0)
        elif kind == "timesync":
            bench.send("timesync", self.pick(0, 5_000_000), bench.now_us * 1000)
        elif kind == "ping":
            bench.send("ping", bench.now_us, int(self.rng.integers(9)), self.pick(0, 1), self.pick(0, 1))
        elif kind == "mission_request_list":
            bench.send("mission_request_list", 1, 1, 0)
        elif kind == "manual_control":
            bench.send("manual_control", 1, 0, 0, 500, 0, 0)
        elif kind == "system_time":
            bench.send("system_time", 0, bench.now_us // 1000)
        else:
            bench.receive(self.rng.bytes(12))

    def fly(self) -> dict[str, str]:
        """Return the board's messages of each kind, and how it moved."""
        bench = self.bench
        assert bench.firmware.mavlink is not None
        self.names = [name[:16] for name in bench.firmware.parameter_numbers][:40]
        bench.clock_ahead_us = 3_000_000
        self.operate((self.command, self.command, self.goal, self.parameters, self.others, self.world))
        kinds: dict[str, list[bytes]] = defaultdict(list)
        for at_us, message in bench.messages:
            fields = {name: value for name, value in message.to_dict().items() if name != "mavpackettype"}
            kinds[message.get_type()].append(f"{at_us} {fields}".encode())
        return told(self, kinds)


def told(operator: Operator, sent: dict[str, list[bytes]]) -> dict[str, str]:
    """Return counts and hashes of what was sent, printed and moved, and the states."""
    bench = operator.bench
    found = {name: f"{len(rows)} {hashed(rows)}" for name, rows in sorted(sent.items())}
    found["console"] = " / ".join(bench.console)[-1500:]
    found["servos"] = f"{len(bench.writes)} {hashed([str(one).encode() for one in bench.writes])}"
    found["states"] = ", ".join(operator.states)
    return found


def hashed(rows: list[bytes]) -> str:
    """Return a hash of rows."""
    return hashlib.sha256(b"\n".join(rows)).hexdigest()[:12]


class Commanded(Random):
    """A high-level commander that gets commands of all kinds, for paths of any kind, also while it is blocked."""

    place = PathPoint((0.1, -0.2, 1.0), 0.3)

    def estimate(self) -> PathPoint:
        """Return where the robot is."""
        return self.place

    def admits(self, places: Sequence[Vector]) -> bool:
        """Return whether a path may be flown: not into one corner."""
        self.log.note("asked", *(round(one, 5) for place in places for one in place))
        return min(places[-1]) < 1.5

    def number(self, low: float, high: float) -> float:
        return float(np.float32(self.rng.uniform(low, high)))

    def command(self) -> bytes:
        """Return a packet's data of a command, seldom cut or unknown."""
        kind = self.pick(*PathCommand, *(PathCommand.START, PathCommand.DEFINE) * 4)
        flag = partial(self.below, 2)
        groups, time = self.pick(0, 0, 0, 1, 6), self.pick(0.0, self.number(0.2, 3.0), self.number(0.2, 3.0))
        height, yaw = self.number(-0.3, 1.6), self.number(-4.0, 4.0)
        number = self.pick(0, 1, 2, 3, 30, 31)
        fields: Any = {
            PathCommand.SET_GROUP_MASK: (self.pick(0, 0, 2, 5),),
            PathCommand.STOP: (groups,),
            PathCommand.TAKE_OFF_1: (groups, height, time),
            PathCommand.LAND_1: (groups, height, time),
            PathCommand.TAKE_OFF: (groups, height, yaw, flag(), time),
            PathCommand.LAND: (groups, height, yaw, flag(), time),
            PathCommand.TAKE_OFF_WITH_VELOCITY: (groups, height, flag(), yaw, flag(), self.pick(0.0, 0.3)),
            PathCommand.LAND_WITH_VELOCITY: (groups, height, flag(), yaw, flag(), self.pick(0.0, 0.3)),
            PathCommand.GO_TO_1: (groups, flag(), *(self.number(-1, 1) for _ in range(3)), yaw, time),
            PathCommand.GO_TO: (groups, flag(), flag(), *(self.number(-1, 1) for _ in range(3)), yaw, time),
            PathCommand.SPIRAL: (
                groups, flag(), flag(), self.number(-7, 7), self.number(-1, 2), self.number(-1, 2), height, time,
            ),
            PathCommand.START_1: (groups, flag(), flag(), number, self.pick(1.0, 1.0, 0.5, 0.0)),
            PathCommand.START: (groups, flag(), flag(), self.pick(0, 0, 1), number, self.pick(1.0, 1.0, 1.5)),
            PathCommand.DEFINE: (
                number, *self.pick((1, 0, 0), (1, 0, 132), (1, 1, 2000), (1, 0, 4000), (0, 1, 2000), (1, 2, 0)),
                self.pick(1, 2, 2, 0),
            ),
        }[kind]  # fmt: skip
        data = encode(kind, *fields)[1:]
        return self.pick(*(data,) * 20, data[:-1], data + b"\0", bytes((self.pick(14, 99, 255),)), b"")

    def told(self) -> dict[str, str]:
        """Return what it answered, reported and flew."""
        flown = HighLevelCommander(self, partial(self.log.note, "reported"))
        for offset in (0, 132, 264):
            pieces = self.rng.normal(0.0, 0.2, 32), self.rng.uniform(0.5, 1.5, 1)
            flown.memory[offset : offset + 132] = np.concatenate(pieces).astype("<f4").tobytes()
        packed = struct.pack("<4h", *self.rng.integers(-500, 500, 4))
        for kinds in (0b10_01_11_10, 0b01_00_10_11):
            points = sum(POINTS[kinds >> 2 * axis & 3] for axis in range(4))
            packed += struct.pack("<BH", kinds, 700) + struct.pack(
                f"<{points}h", *self.rng.integers(-500, 500, points)
            )
        flown.memory[2000 : 2000 + len(packed) + 3] = packed + bytes(3)
        t = 0.0
        for _ in range(1500):
            if self.rng.random() < 0.5:
                data = self.command()
                self.log.note(f"command {data[:1].hex()}", data.hex(), flown.execute(data, t))
            if self.rng.random() < 0.05:
                flown.block(self.below(3) == 0)
                self.place = PathPoint(
                    (self.number(-1, 1), self.number(-1, 1), self.number(0, 2)), self.number(-3, 3)
                )
            if self.rng.random() < 0.05:
                flown.defaults.take_off_velocity = self.pick(0.3, 0.7)
                flown.defaults.landing_velocity = self.pick(0.2, 0.6)
            wanted = flown.setpoint(t)
            numbers = (*(wanted.place or ()), wanted.yaw, *wanted.velocity)
            self.log.note("flown", *(f"{one + 0.0:.5g}" for one in numbers), flown.bits(t))
            t += self.pick(0.01, 0.1, 0.4)
        return self.log.told()


def requests() -> dict[str, str]:
    """Return the answers to each first byte on each channel of the small services, with several tails."""
    bench, log = CrtpClient(), Log()
    for port in (LINK, PLATFORM, SUPERVISOR, MEM):
        for channel in range(4):
            for first in (*range(16), 0x81, 0xFF):
                for tail in (b"", b"\0", b"\1", b"\1\0", b"\2\0\0\0\4", b"\2\xfc\x0f\0\0\4"):
                    bench.sent.clear()
                    bench.send(port, channel, bytes((first,)) + tail)
                    bench.run(bench.now_us + 2_000)
                    counted = bench.firmware.link.malformed, bench.firmware.pilot.stabilizer.supervisor.bits
                    answers = [raw.hex() for _, raw in bench.sent]
                    log.note(f"{port} {channel}", first, tail.hex(), *answers, *counted)
    return log.told()


FLIGHTS: dict[str, Callable[[], dict[str, str]]] = {
    **{f"radio {seed}": lambda seed=seed: CrtpOperator(CrtpClient(), seed).fly() for seed in SEEDS},  # type: ignore[misc]
    **{f"commanded {seed}": lambda seed=seed: Commanded(seed).told() for seed in SEEDS},  # type: ignore[misc]
    "requests": requests,
    **{f"mavlink {seed}": lambda seed=seed: MavlinkOperator(MavlinkClient(), seed).fly() for seed in SEEDS},  # type: ignore[misc]
}


# They reach no line that the others do not.
LONG = [
    *(f"mavlink {number}" for number in (1, 2, 4)),
    *(f"radio {number}" for number in (3, 4, 6)),
    *(f"commanded {number}" for number in range(2, 7)),
]


@pytest.mark.parametrize("name", tiers(FLIGHTS, LONG))
def test_a_board_answers_a_random_operator_as_it_did(name: str) -> None:
    judge(ANSWERS, name, FLIGHTS[name](), "pymavlink")


if __name__ == "__main__":
    approve(ANSWERS, FLIGHTS, "pymavlink")
