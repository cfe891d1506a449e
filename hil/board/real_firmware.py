"""A real board in the loop: its firmware flies on samples of the virtual gyro, and its servo counts drive the plant.

Over the link the board reports its supervisor's state, its servo counts and some counters. It does not report the core's
estimate; those columns of the log are NaN. Corrections go to the board as in a real flight. The link delays the samples
to the board, the board's buffer delays them again, and the link delays the counts on their return: the sum is measured as
the loop's delay. Each pose's age includes the link latency, estimated as half the round trip without queueing.

The plant follows the board: when the board is late the plant waits, and when a sample is late the flight on board pauses.
So a slow link slows the flight below real time, but the delay stays within the window of samples
(`hil.board.sample_window`).
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
    Loop,
    decode_loop,
    loop,
)
from firmware_py.wire.crtp import Packet, decode_ext_pose, encode_ext_pose
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.supervisor import Cause, State
from ground_station.errors import LinkError
from ground_station.links.core_client import CoreClient
from hil.board.board_firmware import PowerOn
from hil.board.clock import Paced
from hil.board.sample_window import SampleWindow
from hil.emulator.crazyflie.log_table import ImageVariable
from hil.emulator.crazyflie.shockburst import syslink_us
from hil.errors import LabError

SAMPLE_US = 1000
SILENCE_US = 1_000_000
LATE_MAX_US = 10_000  # that the plant catches up after a wait, so that samples flow at once
LOOK_S = 0.001  # between two reads of the link, while the plant waits
SLEW_US = 25  # time shift, a hundred times a second, for each sample too many that waits on board
SLEW_MAX_US = 1000
COUNTED = ("waiting", "held", "late", "lost", "doubled")  # by the board, of samples
KEPT = 50  # board reports, half a second: the loop's added delay is their mean


class _Clock:
    """The clock of a processor that is not scheduled here."""

    def __init__(self) -> None:
        self.now_us = 0

    def run(self, now_us: int, until_us: int = 0) -> None:
        self.now_us = now_us

    advance = run

    def stop_before(self, us: int) -> None: ...  # it does not run ahead


@dataclass(frozen=True, slots=True)
class RealBoard:
    """A board to fly in the loop; `moving`: its servos move as well."""

    client: CoreClient
    moving: bool
    wall: Paced  # maps simulated time to the wall clock
    needs_polls: ClassVar[bool] = False
    in_flash: ClassVar[bytes] = b""
    wire_us = staticmethod(syslink_us)

    def flashed_with(self, flash: bytes) -> RealBoard:
        return self

    def boot(self, start: PowerOn) -> RealFirmware:
        """Switch the board to the loop. Raises `LinkError` when it does not answer."""
        if start.board.sensors:
            raise LabError(
                "--hil: the samples of the robot's own sensors do not reach a real board; --board URI lets its core fly"
            )
        return RealFirmware(self, start.board)

    def leave(self) -> None:
        """Switch the board back to its own gyro, if it still answers."""
        with suppress(LinkError):
            self.client.execute([loop(Hil.OFF)])


@dataclass(slots=True)
class _Supervisor:
    """The supervisor's last state that the board reported."""

    state: State = State.CALIBRATING
    cause: Cause = Cause.NONE


class RealFirmware:
    """The firmware of a board in the loop. Raises `LinkError` when the board does not answer."""

    log_numbers: ClassVar[Mapping[str, int]] = {}  # its log service is not used
    parameter_numbers: ClassVar[Mapping[str, int]] = {}
    inputs: ClassVar[None] = None
    scheduler: ClassVar[None] = None
    usage: ClassVar[None] = None
    clock_us: ClassVar[None] = None
    mavlink: ClassVar[None] = None
    flight_tasks: ClassVar[None] = None
    flashed: ClassVar[None] = None
    overrun: ClassVar[str] = ""

    def __init__(self, real: RealBoard, board: Board) -> None:
        self.kernel = _Clock()
        self._report: Loop | None = None  # last
        self._delay_us = 0  # recent mean, from a sample to the counts it caused
        self._added_us = 0  # the link's latency, which corrections add to their age
        self._stood_us = 0  # total pause of simulated time because the board was late
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
        self._correction: bytes | None = None  # waits for the link
        self._heard_us = 0
        self._delays: deque[tuple[int, int]] = deque(maxlen=KEPT)  # total, and the part spent in buffers
        self._about = real.client.begin()

    def __str__(self) -> str:
        return f"{self._client.name}: core {self._about.core}, profile {self._about.profile}, in the loop"

    def imu_ready(self) -> None:
        """Send the virtual IMU's new sample, read the board's reports, and wait for the board when it is late."""
        if self._window.count == 0:  # compilation is done: samples flow from now on
            self._client.execute([loop(self._mode)])
        self._window.put(self._board.imu[:3].tolist())
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
        """Forward a correction with its age at this board; drop other packets."""
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

    def radio_polled(self) -> None: ...  # the board's own radio is polled

    def uart_ready(self) -> None: ...  # the board has no serial line

    def reports(self) -> tuple[TaskReport, ...]:
        return ()  # a board does not report its tasks

    def check_watchdog(self) -> None:
        """Raise `LinkError` when the board has reported nothing for too long."""
        if self.kernel.now_us - self._heard_us > SILENCE_US:
            raise self._silent()

    def _silent(self) -> LinkError:
        return LinkError(f"{self._client.name}: silent for {SILENCE_US * 1e-6:.0f} s")

    def _counted(self, name: str) -> int:
        """Return a counter of the board, 0 before its first report."""
        return 0 if self._report is None else int(getattr(self._report, name))

    def _exchange(self, timeout_s: float = 0.0) -> None:
        """Read the board's reports, within a timeout, and send what the link and the board have room for."""
        for raw in self._client.packets.received(timeout_s):
            self._on_packet(raw)
        self._send()

    def _send(self) -> None:
        packets = self._client.packets
        if packets.ready and self._correction is not None:  # first: these are few
            packets.send_any(self._correction)
            self._correction = None
        if packets.ready and (data := self._window.packet(self._wall.wall_us())) is not None:
            packets.send_any(crtp.encode(Packet(PORT_CORE, CHANNEL_LOOP, data)))

    def _on_packet(self, raw: bytes) -> None:
        packet = crtp.decode(raw)
        if packet.port != PORT_CORE or packet.channel != CHANNEL_LOOP:
            return
        report = self._report = decode_loop(packet.data)
        self._heard_us = self.kernel.now_us
        supervisor = self._supervisor
        supervisor.state, supervisor.cause = State(report.state), Cause(report.cause)
        counters = self.signals.counters
        counters[COUNTERS.index("fused")] = report.fused
        counters[COUNTERS.index("refused")] = report.refused
        counters[COUNTERS.index("pose_age_us")] = 100 * report.age
        self.signals.count[:] = report.counts
        self._board.write_compare(report.counts)
        if self._window.on_report(report, self._wall.wall_us()) and report.fresh:
            self._measure(report)

    def _measure(self, report: Loop) -> None:
        """Measure the age of the sample behind these counts, and keep as many waiting as the board wants."""
        window = self._window
        batch_us = (window.batch - 1) * SAMPLE_US // 2  # a sample's mean wait for its packet
        self._delays.append(((window.count - window.used) * SAMPLE_US, report.waiting * SAMPLE_US + batch_us))
        total_us, waited_us = (sum(values) // len(self._delays) for values in zip(*self._delays, strict=True))
        self._delay_us, self._added_us = total_us, max(0, total_us - waited_us) // 2
        surplus_us = SLEW_US * (report.waiting - HIL_WAITING)
        self._wall.shift(max(-SLEW_MAX_US, min(SLEW_MAX_US, surplus_us)))


def _variable(name: str, unit: str, read: Callable[[], int]) -> ImageVariable:
    return ImageVariable(f"loop.{name}", Scalar.I32, read, unit)
