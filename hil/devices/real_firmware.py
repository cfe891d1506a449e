"""A real board in the loop: its firmware flies with the samples of the virtual gyro, its servo counts drive the plant.

Over the link the board reports the state of its supervisor, its servo counts and some counters. It does not report the
core's estimate; those columns of the log are NaN. Corrections go to the board as in a real
flight. Between the instant that the board's gyro shows and the one at which its flaps act lie the way of the samples to
the board, their wait there, and the way of the counts back: the loop's own delay, which is measured. Each pose's age
includes the link latency, estimated as half the round trip without queueing.

The plant follows the board: when the board is late the plant waits, and when a sample is late the flight on board stands
still. So a link that is too slow makes the flight slower than real time, and its delay no longer than the window of samples
(`hil.devices.sample_window`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import nan
from typing import ClassVar

import numpy as np

from firmware_py.board import Board
from firmware_py.rtos import TaskReport
from firmware_py.signals import COUNTERS, Signals
from firmware_py.wire import WireError, crtp
from firmware_py.wire.core_port import (
    CHANNEL_LOOP,
    HIL_WAITING,
    PORT_CORE,
    Hil,
    Looped,
    decode_looped,
    loop,
)
from firmware_py.wire.crtp import Packet, decode_ext_pose, encode_ext_pose
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.supervisor import Cause, State
from ground_station.errors import LinkError
from ground_station.links.core_client import CoreClient
from hil.clock import Paced
from hil.crazyflie.log_table import ImageVariable
from hil.crazyflie.shockburst import syslink_us
from hil.devices.board_firmware import PowerOn
from hil.devices.sample_window import SampleWindow

SAMPLE_US = 1000
SILENCE_US = 1_000_000
LATE_MAX_US = 10_000  # that the plant makes up for behind a wait, so that samples are on their way at once
LOOK_S = 0.001  # between two looks at the link, while the plant waits
SLEW_US = 25  # by which time is moved, a hundred times a second, for each sample that too many wait on board
SLEW_MAX_US = 1000
COUNTED = ("waiting", "held", "late", "lost", "doubled")  # by the board, of samples
KEPT = 50  # of what the board told, half a second: what the loop adds is their mean


class _Clock:
    """The time of a processor that nobody here schedules."""

    next_wake_us: ClassVar[None] = None

    def __init__(self) -> None:
        self.now_us = 0

    def advance(self, now_us: int) -> None:
        """Let it be so late."""
        self.now_us = now_us

    def run(self, now_us: int, until_us: int = 0) -> None:
        """Let it be so late; nothing happens by itself."""
        self.now_us = now_us

    def stop_before(self, us: int) -> None:
        """Nothing: it does not run ahead."""

    def reports(self) -> tuple[TaskReport, ...]:
        """Nothing: what a board's tasks do is not told."""
        return ()


@dataclass(frozen=True, slots=True)
class RealBoard:
    """A board that is to fly in the loop; `moving`: its servos move as well."""

    client: CoreClient
    moving: bool
    wall: Paced  # the wall clock, and how simulated time lies on it
    needs_polls: ClassVar[bool] = False

    def wire_us(self, data: bytes) -> int:
        """Return what the serial line between the two chips of a board takes."""
        return syslink_us(data)

    def boot(self, start: PowerOn) -> RealFirmware:
        """Take it into the loop. Raises `LinkError` when it does not answer."""
        return RealFirmware(self, start.board)

    def leave(self) -> None:
        """Let it go back to its own gyro, if it is still there."""
        with suppress(LinkError):
            self.client.execute([loop(Hil.OFF)])


@dataclass(slots=True)
class _Supervisor:
    """What the board reported last about its supervisor."""

    state: State = State.CALIBRATING
    cause: Cause = Cause.NONE


class RealFirmware:
    """The firmware of a board in the loop. Raises `LinkError` when the board does not answer."""

    log_numbers: ClassVar[Mapping[str, int]] = {}  # its log service is not asked
    scheduler: ClassVar[None] = None
    usage: ClassVar[None] = None
    clock_us: ClassVar[None] = None
    mavlink: ClassVar[None] = None
    flashed: ClassVar[None] = None
    overrun: ClassVar[str] = ""

    def __init__(self, real: RealBoard, board: Board) -> None:
        self.kernel = self.statistics = _Clock()
        self._told: Looped | None = None  # last
        self._delay_us = 0  # from a sample to the counts that came of it, lately
        self._added_us = 0  # the link's way, which corrections tell on top of their age
        self._stood_us = 0  # how long simulated time stood still in all, because the board was late
        self._supervisor = _Supervisor()
        self.signals = Signals(
            np.full(16, nan, np.float32), np.zeros(len(COUNTERS), np.int32), np.full(4, nan, np.float32),
            np.full(4, nan, np.float32), np.zeros(4, np.int32), self._supervisor,
        )  # fmt: skip
        self.variables = (
            _variable("delay", "us", lambda: self._delay_us),
            _variable("added", "us", lambda: self._added_us),
            _variable("stood", "us", lambda: self._stood_us),
            *(_variable(name, "", partial(self._counted, name)) for name in COUNTED),
        )
        self._board = board
        self._client = real.client
        self._wall = real.wall
        self._mode = Hil.MOVING if real.moving else Hil.STILL
        self._window = SampleWindow()
        self._correction: bytes | None = None  # that waits for the link
        self._heard_us = 0
        self._delays: deque[tuple[int, int]] = deque(maxlen=KEPT)  # whole, and what of it waited in buffers
        self._about = real.client.begin()

    def __str__(self) -> str:
        return f"{self._client.name}: core {self._about.core}, profile {self._about.profile}, in the loop"

    def imu_ready(self) -> None:
        """The virtual IMU has a sample: hand it on, take what the board has told, and wait for it when it is late."""
        if self._window.count == 0:  # what compiles has been compiled: from now on samples come
            self._client.execute([loop(self._mode)])
        self._window.put(self._board.read_imu()[:3])
        self._exchange()
        if not self._window.full:
            return
        start_us = self._wall.wall_us()
        while self._window.full:
            self._exchange(LOOK_S)
            if self._wall.wall_us() - start_us > SILENCE_US:
                raise self._silent()
        too_late_us = max(0, self._wall.late_us(self.kernel.now_us) - LATE_MAX_US)
        self._stood_us += too_late_us
        self._wall.shift(too_late_us)

    def radio_received(self, data: bytes, broadcast: bool = False) -> None:
        """Hand a correction on, with the age that it has for this board; nothing else is for it."""
        packet = crtp.decode(data)
        if packet.port != crtp.PORT_LOCALISATION:
            return
        try:
            pose = decode_ext_pose(packet.data)
        except WireError:
            self._client.packets.send_any(data)
            return
        age_us = None if pose.age_us is None else pose.age_us + self._added_us
        self._correction = encode_ext_pose(pose.p_GB, pose.q_GB, age_us)
        self._send()

    def radio_polled(self) -> None:
        """Nothing: the board's own radio is polled."""

    def uart_ready(self) -> None:
        """Nothing: no serial line leads to the board."""

    def check_watchdog(self) -> None:
        """Raise `LinkError` when the board has told nothing for too long."""
        if self.kernel.now_us - self._heard_us > SILENCE_US:
            raise self._silent()

    def _silent(self) -> LinkError:
        return LinkError(f"{self._client.name}: silent for {SILENCE_US * 1e-6:.0f} s")

    def _counted(self, name: str) -> int:
        """Return a counter of the board, 0 before its first report."""
        return 0 if self._told is None else int(getattr(self._told, name))

    def _exchange(self, timeout_s: float = 0.0) -> None:
        """Take what the board tells, within a time, and send what the link and the board have room for."""
        for raw in self._client.packets.received(timeout_s):
            self._hear(raw)
        self._send()

    def _send(self) -> None:
        packets = self._client.packets
        if packets.ready and self._correction is not None:  # first: there are few of them
            packets.send_any(self._correction)
            self._correction = None
        if packets.ready and (data := self._window.packet(self._wall.wall_us())) is not None:
            packets.send_any(crtp.encode(Packet(PORT_CORE, CHANNEL_LOOP, data)))

    def _hear(self, raw: bytes) -> None:
        packet = crtp.decode(raw)
        if packet.port != PORT_CORE or packet.channel != CHANNEL_LOOP:
            return
        told = self._told = decode_looped(packet.data)
        self._heard_us = self.kernel.now_us
        supervisor = self._supervisor
        supervisor.state, supervisor.cause = State(told.state), Cause(told.cause)
        counters = self.signals.counters
        counters[COUNTERS.index("fused")] = told.fused
        counters[COUNTERS.index("refused")] = told.refused
        counters[COUNTERS.index("pose_age_us")] = told.age_us
        self.signals.count[:] = told.counts
        self._board.write_compare(told.counts)
        if self._window.hear(told, self._wall.wall_us()) and told.fresh:
            self._measure(told)

    def _measure(self, told: Looped) -> None:
        """Take in how old the sample was from which these counts came, and keep as many waiting as the board wants."""
        window = self._window
        batch_us = (window.batch - 1) * SAMPLE_US // 2  # that a sample waits on the mean for its packet
        self._delays.append(((window.count - window.used) * SAMPLE_US, told.waiting * SAMPLE_US + batch_us))
        total_us, waited_us = (sum(values) // len(self._delays) for values in zip(*self._delays, strict=True))
        self._delay_us, self._added_us = total_us, max(0, total_us - waited_us) // 2
        surplus_us = SLEW_US * (told.waiting - HIL_WAITING)
        self._wall.shift(max(-SLEW_MAX_US, min(SLEW_MAX_US, surplus_us)))


def _variable(name: str, unit: str, read: Callable[[], int]) -> ImageVariable:
    return ImageVariable(f"loop.{name}", Scalar.I32, read, unit)
