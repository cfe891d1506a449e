"""Plays programs of a client's requests on a board and writes down what the client sees.

A program is a text of one request per line, in words: `LINES` names them. The same program runs on the firmware in Python
and on an image; the answers must be equal, and the goal's path must stay within `PATH_M`. The robot is a point that sits at
the board's goal while the board flies, and a pose comes every 20 ms. So a program costs little and needs no real time.

A number in an answer may have a tolerance behind it: `12.3~0.5`.
"""

import json
import os
import struct
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import dist, inf, nan, pi, radians, remainder

from firmware_py.geometry import Quaternion, Vector, from_euler_zyx
from firmware_py.wire import crtp, high_level, log, setpoints
from firmware_py.wire.crtp import Packet
from firmware_py.wire.high_level import PathCommand
from firmware_py.wire.localisation import encode_packed_poses
from firmware_py.wire.log import LogCommand
from firmware_py.wire.parameters import SetByName, encode_set_by_name
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.supervisor import PLATFORM_APP, State
from hil.board.board_firmware import BoardFirmware, Executor, PowerOn
from hil.board.pins import VirtualBoard
from hil.config import LabConfig, load_config
from hil.emulator.events import EventQueue
from hil.errors import LabError

HOME = (0.0, 0.0, 1.15)
STEP_US = 1_000
POSE_US, AGE_US, PATH_US, STREAM_US, ANSWER_US = 20_000, 25_000, 200_000, 50_000, 30_000
SETTLED_US = 1_500_000  # after the boot: the gyro's zero is known, poses arrive
PATH_M, PATH_RAD = 0.05, 0.05
LATE_US = 60_000  # two boards look at a path at times that differ by no more than this
LEVEL = (3, -2, 1, 0, 0, 1365)  # counts of the IMU; the BMI088 driver takes zeros for a defect

BLOCK = 200  # of the log, for `values`
ADDRESS = 0xE7  # last byte of a board's radio address

Place = tuple[float, float, float, float]  # x, y, z [m] and yaw [rad]


@dataclass(slots=True)
class Answers:
    """What a client saw: one text per line that is answered, and the goal's path, one row per `PATH_US`."""

    lines: list[str] = field(default_factory=list)
    path: list[Place] = field(default_factory=list)


class ServiceBench:
    """A booted board; `floaty`: it has the flight core, so that its goal can be followed."""

    def __init__(self, executor: Executor, config: LabConfig | None = None) -> None:
        self.answers = Answers()
        self.console: list[str] = []
        self.counts: Sequence[int] = ()  # of the servos
        self.now_us = 0
        self.pose_us, self.poses_as = POSE_US, "pose"
        self.radio = True
        self.place, self.attitude = HOME, (0.0, 0.0, 0.0)  # roll, pitch, yaw [rad]
        self.received: list[Packet] = []
        self._noise = 0
        self._pins = VirtualBoard(
            self._drive, self._from_board, lambda now_us, text: self.console.append(text)
        )
        self._pins.boot(0)
        self._pins.measure(LEVEL)
        self.firmware: BoardFirmware = executor.boot(
            PowerOn(self._pins, config or load_config(), False, True, self._rest)
        )
        self._events = EventQueue()
        self._pins.run_on(self.firmware.kernel, self._events)
        self._boot_us = self.firmware.kernel.now_us
        self._goal = _goal_of(self.firmware)
        self.floaty = self._goal is not None
        self._path_us: int | None = None
        self.run(300_000)
        if self.floaty:
            self.request(
                crtp.PORT_PARAMETERS, 3, encode_set_by_name(SetByName("extPose.absolute", Scalar.U8, 1.0))[1:]
            )
        self.run(SETTLED_US)
        self._path_us = self.now_us

    def _rest(self) -> tuple[int, int, int, int, int, int]:
        self._noise ^= 1
        return (*LEVEL[:2], LEVEL[2] ^ self._noise, *LEVEL[3:])

    def _from_board(self, now_us: int, data: bytes) -> bool:
        self.received.append(crtp.decode(data))
        return True

    def _drive(self, now_us: int, counts: Sequence[int]) -> None:
        self.counts = tuple(counts)

    def supply(self, millivolts: int) -> None:
        """Change the battery's voltage."""
        self._pins.supply(millivolts)

    def run(self, duration_us: int) -> None:
        """Let time pass."""
        kernel, end_us = self.firmware.kernel, self.now_us + duration_us
        while self.now_us < end_us:
            begin_us = self._boot_us + self.now_us
            left_us = -self.now_us % self.pose_us if self.pose_us else 0
            if 0 < left_us < STEP_US:  # the next pose comes within this step
                kernel.run(begin_us, begin_us + left_us - 1)
                begin_us += left_us
                kernel.advance(begin_us)
                self._send_pose()
            self.now_us += STEP_US
            kernel.run(begin_us, self._boot_us + self.now_us - 1)
            kernel.advance(self._boot_us + self.now_us)
            self._events.run(self.now_us)
            self._pins.measure(self._rest())
            self.firmware.imu_ready()
            if self.radio:
                self.firmware.radio_polled()
            if self.pose_us and self.now_us % self.pose_us == 0:
                self._send_pose()
            if self._path_us is not None and (self.now_us - self._path_us) % PATH_US == 0 and self._goal:
                self.answers.path.append(self._goal())
            kernel.run(self._boot_us + self.now_us)

    def _send_pose(self) -> None:
        if not self.radio:
            return
        if self._goal and self.firmware.signals.supervisor.state is State.FLYING:
            x, y, z, yaw = self._goal()
            self.place, self.attitude = (x, y, z), (0.0, 0.0, yaw)
        self.post(*POSES[self.poses_as](self.place, from_euler_zyx(*self.attitude)))

    def post(self, port: int, channel: int, data: bytes) -> None:
        self.firmware.radio_received(crtp.encode(Packet(port, channel, data)))

    def request(self, port: int, channel: int, data: bytes) -> bytes | None:
        """Send a request; return the first answer on its port and channel, None without one."""
        self.received.clear()
        self.post(port, channel, data)
        self.run(ANSWER_US)
        found = (one.data for one in self.received if (one.port, one.channel) == (port, channel))
        return next(found, None)

    def state(self) -> str:
        """Return what a client sees of the supervisors."""
        answer = self.request(crtp.PORT_SUPERVISOR, 0, b"\x0c")
        bits = "nothing" if answer is None else f"bits {int.from_bytes(answer[1:3], 'little'):#06x}"
        if not self.floaty:
            return bits
        supervisor = self.firmware.signals.supervisor
        return f"{bits} {supervisor.state.name.lower()} {supervisor.cause.name.lower()}"

    def play(self, program: str) -> Answers:
        """Execute a program, and look at the end; return the answers."""
        for line in program.strip().splitlines():
            words = line.split("#")[0].split()
            if words:
                self._execute(words)
        flashed = self.firmware.flashed
        self._note("end", "; ".join((self.state(), *(() if flashed is None else flashed.failures))))
        return self.answers

    def _execute(self, words: Sequence[str]) -> None:
        name, *rest = words
        line = LINES[name]
        answer = line(self, rest)
        if answer is not None:
            self._note(" ".join(words), answer)

    def _note(self, asked: str, answer: str) -> None:
        self.answers.lines.append(f"{asked}: {answer}")


def _goal_of(firmware: BoardFirmware) -> Callable[[], Place] | None:
    """Return a function that reads the goal from the flight core; None for a board without it."""
    if (inputs := firmware.inputs) is None:
        return None
    goal = inputs["goal"][0]

    def read() -> Place:
        x, y, z, yaw = goal.tolist()
        return x, y, z, yaw

    return read


def _pose(place: Vector, q: Quaternion) -> tuple[int, int, bytes]:
    return crtp.PORT_LOCALISATION, crtp.CHANNEL_GENERIC, crtp.encode_ext_pose(place, q, None)[1:-1]


def _aged_pose(place: Vector, q: Quaternion) -> tuple[int, int, bytes]:
    return crtp.PORT_LOCALISATION, crtp.CHANNEL_GENERIC, crtp.encode_ext_pose(place, q, AGE_US)[1:]


def _packed_pose(place: Vector, q: Quaternion) -> tuple[int, int, bytes]:
    """Return the packet of a swarm's sender, with another robot's pose before ours."""
    x, y, z = place
    data = encode_packed_poses([(1, (x + 0.5, y + 0.5, z + 0.5), q), (ADDRESS, place, q)])
    return crtp.PORT_LOCALISATION, crtp.CHANNEL_GENERIC, data


def _cut_pose(place: Vector, q: Quaternion) -> tuple[int, int, bytes]:
    """Return the packet of a sender that forgets the last byte: no board uses it."""
    port, channel, data = _pose(place, q)
    return port, channel, data[:-1]


POSES: Mapping[str, Callable[[Vector, Quaternion], tuple[int, int, bytes]]] = {
    "pose": _pose,
    "aged": _aged_pose,
    "packed": _packed_pose,
    "cut": _cut_pose,
    "app": lambda place, q: (crtp.PORT_PLATFORM, PLATFORM_APP, _pose(place, q)[2]),
}


# The lines


def _numbers(words: Sequence[str]) -> list[float]:
    special = {"nan": nan, "inf": inf, "-inf": -inf}
    return [
        special[word] if word in special else float(word)
        for word in words
        if not word.isalpha() or word in special
    ]


def _flags(words: Sequence[str], *names: str) -> list[bool]:
    return [name in words for name in names]


def _hex(answer: bytes | None, known: int = 99) -> str:
    return "nothing" if answer is None else answer[:known].hex()


def _command(bench: ServiceBench, command: PathCommand, *fields: float) -> str:
    data = high_level.encode(command, *fields)[1:]
    answer = bench.request(high_level.PORT, 0, data)
    return "nothing" if answer is None else f"status {answer[3]}"


def _vertical(command: PathCommand) -> "Line":
    def line(bench: ServiceBench, words: Sequence[str]) -> str:
        height, duration, *yaw = _numbers(words)
        return _command(bench, command, 0, height, radians(yaw[0]) if yaw else 0.0, not yaw, duration)

    return line


def _vertical_with_velocity(command: PathCommand) -> "Line":
    def line(bench: ServiceBench, words: Sequence[str]) -> str:
        height, velocity = _numbers(words)
        (relative,) = _flags(words, "relative")
        return _command(bench, command, 0, height, relative, 0.0, True, velocity)

    return line


def _go_to(bench: ServiceBench, words: Sequence[str]) -> str:
    x, y, z, yaw, duration = _numbers(words)
    return _command(
        bench, PathCommand.GO_TO, 0, *_flags(words, "relative", "linear"), x, y, z, radians(yaw), duration
    )


def _spiral(bench: ServiceBench, words: Sequence[str]) -> str:
    angle, first, last, ascent, duration = _numbers(words)
    flags = _flags(words, "sideways", "clockwise")
    return _command(bench, PathCommand.SPIRAL, 0, *flags, radians(angle), first, last, ascent, duration)


def _start(bench: ServiceBench, words: Sequence[str]) -> str:
    number, scale = (*_numbers(words), 1.0)[:2]
    flags = _flags(words, "relative", "turned", "reversed")
    return _command(bench, PathCommand.START, 0, *flags, int(number), scale)


def _define(bench: ServiceBench, words: Sequence[str]) -> str:
    number, kind, offset, pieces = map(int, _numbers(words))
    return _command(bench, PathCommand.DEFINE, number, 1, kind, offset, pieces)


def _polynomial(duration: float, *axes: Sequence[float]) -> bytes:
    powers = [value for axis in axes for value in (*axis, *(0.0,) * (8 - len(axis)))]
    return struct.pack("<33f", *powers, duration)


def _compressed(start: Sequence[int], *pieces: tuple[int, Sequence[Sequence[int]]]) -> bytes:
    data = struct.pack("<4h", *start)
    for duration_ms, axes in (*pieces, (0, ((), (), (), ()))):
        kinds = sum({0: 0, 1: 1, 3: 2, 7: 3}[len(points)] << 2 * axis for axis, points in enumerate(axes))
        data += struct.pack("<BH", kinds, duration_ms)
        data += b"".join(struct.pack(f"<{len(points)}h", *points) for points in axes)
    return data


# Trajectories by name: polynomials in m, rad and s, compressed ones in mm and tenths of a degree.
TRAJECTORIES: Mapping[str, bytes] = {
    "straight": _polynomial(2.0, (0.0, 0.04), (), (1.15,), ()),
    "corner": _polynomial(1.0, (0.0, 0.08), (), (1.15,), ())
    + _polynomial(1.0, (0.08,), (0.0, 0.06), (1.15,), ()),
    "turning": _polynomial(2.0, (0.02, 0.03), (0.01, -0.02), (1.15,), (0.2, 0.3)),
    "swing": _polynomial(2.0, (0.0, 0.4, -0.2), (), (1.15,), ()),
    "not finite": _polynomial(2.0, (nan,), (), (1.15,), ()),
    "small": _compressed((0, 0, 1150, 0), (2000, ((50,), (), (), (600,)))),
    "curved": _compressed(
        (0, 0, 1150, 0), (1000, ((40, 80, 80), (0, 0, 60), (), ())), (500, ((), (), (1200,), ()))
    ),
}


def _upload(bench: ServiceBench, words: Sequence[str]) -> str:
    offset, data = int(words[-1]), TRAJECTORIES[" ".join(words[:-1])]
    statuses = set()
    number = trajectory_memory(bench)
    for begin in range(0, len(data), 24):
        head = struct.pack("<BI", number, offset + begin)
        answer = bench.request(crtp.PORT_MEMORIES, 2, head + data[begin : begin + 24])
        statuses.add(_hex(answer)[10:])
    return " ".join(sorted(statuses))


def trajectory_memory(bench: ServiceBench) -> int:
    """Return the number of the trajectories' memory."""
    count = bench.request(crtp.PORT_MEMORIES, 0, b"\x01")
    assert count is not None
    for number in range(count[1]):
        answer = bench.request(crtp.PORT_MEMORIES, 0, bytes((2, number)))
        if answer is not None and answer[2] == 0x12:
            return number
    raise AssertionError("no memory of trajectories")


def _setpoint(words: Sequence[str]) -> bytes:
    """Return the packet of a set-point without its header byte: kind, and its numbers."""
    kind, numbers = words[0], _numbers(words[1:])
    if kind == "position":
        x, y, z, yaw = numbers
        return setpoints.encode_place((x, y, z), radians(yaw))[1:]
    if kind == "full":
        x, y, z = (round(1000 * value) for value in numbers)
        return struct.pack("<B9hI3h", 6, x, y, z, 0, 0, 0, 0, 0, 0, 3 << 30, 0, 0, 0)
    number = {"velocity": 8, "height": 9, "hover": 10}[kind]
    return struct.pack("<B4f", number, *numbers)


def _post_setpoint(bench: ServiceBench, words: Sequence[str]) -> None:
    if words[0] == "manual":
        bench.post(crtp.PORT_GENERIC_SETPOINT, 0, struct.pack("<BfffHB", 11, 0.0, 0.0, 0.0, 20_000, 0))
    elif words[0] == "attitude":
        bench.post(crtp.PORT_COMMANDER, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, int(words[1])))
    elif words[0] == "stop":
        bench.post(crtp.PORT_GENERIC_SETPOINT, 0, b"\0")
    else:
        bench.post(crtp.PORT_GENERIC_SETPOINT, 0, _setpoint(words))
    bench.run(ANSWER_US)


def _stream(bench: ServiceBench, words: Sequence[str]) -> None:
    *words, duration = words
    for _ in range(round(float(duration) * 1e6) // STREAM_US):
        bench.post(crtp.PORT_GENERIC_SETPOINT, 0, _setpoint(words))
        bench.run(STREAM_US)


def _notify(bench: ServiceBench, words: Sequence[str]) -> None:
    bench.post(crtp.PORT_GENERIC_SETPOINT, 1, bytes(5))
    bench.run(ANSWER_US)


def _arm(bench: ServiceBench, armed: int) -> str:
    return _hex(bench.request(crtp.PORT_SUPERVISOR, 1, bytes((1, armed))))


def _stop(bench: ServiceBench, words: Sequence[str]) -> str:
    return _command(bench, PathCommand.STOP, 0)


def _post(bench: ServiceBench, port: int, channel: int, data: bytes) -> None:
    bench.post(port, channel, data)
    bench.run(ANSWER_US)


def _wait(bench: ServiceBench, words: Sequence[str]) -> None:
    bench.run(round(float(words[0]) * 1e6))


def _ask(bench: ServiceBench, words: Sequence[str]) -> str:
    """`ask PORT CHANNEL HEX [BYTES]`: only the first BYTES of the answer are compared."""
    data = bytes.fromhex(words[2])
    return _hex(bench.request(int(words[0]), int(words[1]), data), int(words[3]) if len(words) > 3 else 99)


def _set(bench: ServiceBench, words: Sequence[str]) -> str:
    name, kind, value = words
    data = encode_set_by_name(SetByName(name, Scalar[kind], float(value)))[1:]
    answer = bench.request(crtp.PORT_PARAMETERS, 3, data)
    return "nothing" if answer is None else f"status {answer[-1]}"


def _read(bench: ServiceBench, words: Sequence[str]) -> str:
    """`read NAME`: the value of a parameter."""
    answer = bench.request(crtp.PORT_PARAMETERS, 1, struct.pack("<H", parameter_number(bench, words[0])))
    return _hex(answer)[4:]


def _write(bench: ServiceBench, words: Sequence[str]) -> str:
    """`write NAME HEX`: bytes to a parameter."""
    number = struct.pack("<H", parameter_number(bench, words[0]))
    answer = bench.request(crtp.PORT_PARAMETERS, 2, number + bytes.fromhex(words[1]))
    return "nothing" if answer is None else answer[2:].hex()


def _misc(bench: ServiceBench, words: Sequence[str]) -> str:
    """`misc COMMAND NAME`: a request about a parameter's state, without its number in the answer."""
    number = struct.pack("<H", parameter_number(bench, words[1]))
    answer = bench.request(crtp.PORT_PARAMETERS, 3, bytes((int(words[0]),)) + number)
    return "nothing" if answer is None else answer[3:].hex()


def parameter_number(bench: ServiceBench, name: str) -> int:
    """Return a parameter's number in the board's table."""
    return bench.firmware.parameter_numbers[name]


def _log(bench: ServiceBench, words: Sequence[str]) -> str:
    """`log COMMAND BLOCK [TYPE NAME ...]`: a request on the log's control channel."""
    command, block, *items = words
    data = bytes((int(command), int(block)))
    for kind, name in zip(items[::2], items[1::2], strict=True):
        number = bench.firmware.log_numbers[name] if "." in name else int(name)
        data += struct.pack("<BH", int(kind), number)
    return _hex(bench.request(crtp.PORT_LOG, log.CHANNEL_CONTROL, data))


def _values(bench: ServiceBench, words: Sequence[str]) -> str:
    """`values SECONDS NAME~TOLERANCE ...`: means of up to six log variables, sampled every 10 ms."""
    duration, *asked = words
    names, tolerances = zip(*(item.split("~") for item in asked), strict=True)
    items = [(Scalar.F32, bench.firmware.log_numbers[name]) for name in names]
    for packet in (*log.creation(BLOCK, items), log.request(LogCommand.START_MS, BLOCK, 10, 0)):
        bench.request(packet.port, packet.channel, packet.data)
    bench.received.clear()
    bench.run(round(float(duration) * 1e6))
    data = (
        log.decode_data(one.data)
        for one in bench.received
        if (one.port, one.channel) == (crtp.PORT_LOG, log.CHANNEL_DATA)
    )
    rows = [struct.unpack(f"<{len(names)}f", values) for block, _, values in data if block == BLOCK]
    packet = log.request(LogCommand.DELETE, BLOCK)
    bench.request(packet.port, packet.channel, packet.data)
    if not rows:
        return "nothing"
    means = (sum(column) / len(rows) for column in zip(*rows, strict=True))
    return " ".join(f"{mean:.6g}~{tolerance}" for mean, tolerance in zip(means, tolerances, strict=True))


def _servos(bench: ServiceBench, words: Sequence[str]) -> str:
    """`servos TOLERANCE`: the counts of the four outputs."""
    return " ".join(f"{count}~{words[0]}" for count in bench.counts)


def _poses(bench: ServiceBench, words: Sequence[str]) -> None:
    """`poses on | off | PERIOD [ms] | pose | aged | packed | cut | app`."""
    word = words[0]
    if word in POSES:
        bench.poses_as = word
    else:
        bench.pose_us = {"on": POSE_US, "off": 0}[word] if word.isalpha() else round(1000 * float(word))


def _radio(bench: ServiceBench, words: Sequence[str]) -> None:
    bench.radio = words[0] == "on"


def _battery(bench: ServiceBench, words: Sequence[str]) -> None:
    bench.supply(int(words[0]))


def _look(bench: ServiceBench, words: Sequence[str]) -> str:
    return bench.state()


def _place(bench: ServiceBench, words: Sequence[str]) -> None:
    x, y, z, roll, pitch, yaw = (*_numbers(words), 0.0, 0.0, 0.0)[:6]
    bench.place = x, y, z
    bench.attitude = radians(roll), radians(pitch), radians(yaw)


Line = Callable[[ServiceBench, Sequence[str]], str | None]
LINES: Mapping[str, Line] = {
    "takeoff": _vertical(PathCommand.TAKE_OFF),  # height, duration, perhaps yaw
    "land": _vertical(PathCommand.LAND),
    "rise": _vertical_with_velocity(PathCommand.TAKE_OFF_WITH_VELOCITY),  # height, velocity
    "sink": _vertical_with_velocity(PathCommand.LAND_WITH_VELOCITY),
    "goto": _go_to,  # x y z yaw duration [relative] [linear]
    "spiral": _spiral,  # angle, radii, ascent, duration [sideways] [clockwise]
    "start": _start,  # number [time scale] [relative] [turned] [reversed]
    "define": _define,  # number, type, offset, pieces
    "upload": _upload,  # name, offset
    "stop": _stop,
    "setpoint": _post_setpoint,  # position x y z yaw, full x y z, velocity, hover, manual, attitude THRUST, stop
    "stream": _stream,  # set-point, duration
    "notify": _notify,
    "arm": lambda bench, words: _arm(bench, 1),
    "disarm": lambda bench, words: _arm(bench, 0),
    "recover": lambda bench, words: _hex(bench.request(crtp.PORT_SUPERVISOR, 1, b"\x02")),
    "emergency": lambda bench, words: _post(bench, crtp.PORT_SUPERVISOR, 1, b"\x03"),
    "feed": lambda bench, words: _post(bench, crtp.PORT_SUPERVISOR, 1, b"\x04"),
    "disconnect": lambda bench, words: _post(bench, crtp.PORT_COMMANDER, 0, bytes(14)),  # as cflib does
    "poses": _poses,
    "place": _place,  # of a robot that does not fly: x y z [roll pitch yaw]
    "radio": _radio,  # on, off
    "battery": _battery,  # millivolts
    "wait": _wait,
    "look": _look,
    "ask": _ask,
    "set": _set,
    "read": _read,
    "write": _write,
    "misc": _misc,
    "log": _log,
    "values": _values,
    "servos": _servos,
}


def differences(expected: Answers, found: Answers) -> Iterator[str]:
    """Yield how the answers of two boards differ."""
    for one, other in zip(expected.lines, found.lines, strict=True):
        if not (len(one.split()) == len(other.split()) and all(map(_near, one.split(), other.split()))):
            yield f"{other}, expected {one.rsplit(': ', 1)[1]}"
    slack = max(1, LATE_US // PATH_US)
    for row, place in enumerate(found.path):
        near = expected.path[max(0, row - slack) : row + slack + 1]
        if near and not any(_beside(place, one) for one in near):
            yield f"goal {place} after {row * PATH_US * 1e-6:.1f} s, expected {near[len(near) // 2]}"
            return


def _near(expected: str, found: str) -> bool:
    (one, between, tolerance), (other, _, _) = expected.partition("~"), found.partition("~")
    return expected == found or (bool(between) and abs(float(one) - float(other)) <= float(tolerance))


def _beside(one: Place, other: Place) -> bool:
    turned = abs(remainder(one[3] - other[3], 2 * pi))
    return dist(one[:3], other[:3]) <= PATH_M and turned <= PATH_RAD


def play_in_copies(bench: ServiceBench, programs: Iterable[str]) -> Iterator[Answers]:
    """Play programs, each on a copy of a booted board in a copy of this process; the board stays as it is.

    Raises `LabError` when a copy breaks off.
    """
    room = len(os.sched_getaffinity(0))
    started: deque[tuple[int, int]] = deque()
    for program in programs:
        if len(started) == room:
            yield _played(*started.popleft())
        started.append(_begin(bench, program))
    while started:
        yield _played(*started.popleft())


def _begin(bench: ServiceBench, program: str) -> tuple[int, int]:
    """Return the process that plays a program, and the pipe with its answers."""
    reading, writing = os.pipe()
    if (child := os.fork()) == 0:
        try:
            played = bench.play(program)
            with os.fdopen(writing, "w") as pipe:
                json.dump([played.lines, played.path], pipe)
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(0)
    os.close(writing)
    return child, reading


def _played(child: int, reading: int) -> Answers:
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    if not text:
        raise LabError("the board broke off a program of requests")
    lines, path = json.loads(text)
    return Answers(lines, [(x, y, z, yaw) for x, y, z, yaw in path])
