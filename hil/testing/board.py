"""A board without a world: the firmware alone, in simulated time, which advances only in `run` and `expect`."""

from collections.abc import Mapping, Sequence

from firmware_py.board import ImuCounts
from firmware_py.core_runner import RunnerFactory, default_runner
from firmware_py.firmware import Firmware
from firmware_py.geometry import Vector
from firmware_py.rtos import TaskReport
from hil.board.imu import ACCEL_COUNTS, COS, COUNTS, GYRO_COUNTS, SIN
from hil.board.pins import VirtualBoard
from hil.config import LabConfig
from hil.emulator.events import EventQueue
from hil.errors import LabError
from hil.world.motion import GRAVITY

IMU_PERIOD_US = 1_000


class UnmetExpectation(AssertionError):  # noqa: N818 - pytest shows the name
    """The board did not print an expected line in time."""


class SerialPins:
    """A serial line without delay: received bytes are available at once, sent ones are stored."""

    overruns = 0

    def __init__(self, sent: list[tuple[int, bytes]]) -> None:
        self._received = bytearray()
        self._sent = sent

    def receive(self, data: bytes) -> None:
        """Take bytes from outside."""
        self._received += data

    def read(self) -> bytes:
        data = bytes(self._received)
        self._received.clear()
        return data

    def write(self, now_us: int, data: bytes) -> bool:
        self._sent.append((now_us, data))
        return True


class BareBoard:
    """A booted board. It is at rest and level until `feed_imu` is called.

    `sent` has its sent packets, each with its time [us]; `console` its lines; `counts` the servo timers' compare counts.
    With `serial` it speaks MAVLink over its UART: `receive` and `sent` are the bytes there.
    """

    def __init__(
        self, config: LabConfig, runner: RunnerFactory = default_runner, serial: bool = False
    ) -> None:
        self.counts: tuple[int, ...] = ()
        self.console: list[str] = []
        self.sent: list[tuple[int, bytes]] = []
        self.now_us, self._noise = 0, 1
        self.imu_running = True  # False: no more interrupts of the IMU
        self._heard = 0  # console lines that an `expect` has matched or passed
        self._repeats = 0  # the current generation of repeated packets
        self._events = EventQueue()
        self._serial = SerialPins(self.sent) if serial else None
        self._board = VirtualBoard(
            self._set_counts, self._send, lambda now_us, text: self.console.append(text), self._serial
        )
        self._board.boot(0)
        self.feed_imu()
        self.firmware = Firmware(config, self._board, mavlink=serial, runner=runner)
        self._board.run_on(self.firmware.kernel, self._events)
        self._events.every(IMU_PERIOD_US, IMU_PERIOD_US, self._sample)

    def feed_imu(
        self,
        omega_B: Vector = (0.0, 0.0, 0.0),
        f_B: Vector = (0.0, 0.0, GRAVITY),
        counts: ImuCounts | None = None,
    ) -> None:
        """Set the IMU's measurement from now on: rates [rad/s] and specific force [m/s2], both in B, or counts."""
        self._fed = counts or (*_counts(omega_B, GYRO_COUNTS), *_counts(f_B, ACCEL_COUNTS))
        self._board.measure(self._fed)

    def receive(self, packet: bytes, every_ms: float = 0.0) -> None:
        """Deliver a packet now and every `every_ms` until `stop_repeating`: CRTP from the radio, MAVLink from the UART."""
        if not every_ms:
            self._arrive(packet)
            return
        generation, period_us = self._repeats, round(every_ms * 1e3)

        def again(now_us: int) -> None:
            if generation == self._repeats:
                self._arrive(packet)
                self._events.at(now_us + period_us, again)

        again(self.now_us)

    def stop_repeating(self) -> None:
        """Stop all repeated packets."""
        self._repeats += 1

    hush = stop_repeating  # as earlier tests call it

    def run(self, ms: float) -> None:
        self._run_until(self.now_us + round(ms * 1e3))

    def expect(self, text: str, within_ms: float) -> str:
        """Advance time until the board prints a line that contains `text`, and return the line.

        Lines up to the one matched last do not count. Raises `UnmetExpectation`.
        """
        __tracebackhide__ = True
        begin_us, first = self.now_us, self._heard
        end_us = begin_us + round(within_ms * 1e3)
        while True:
            while self._heard < len(self.console):
                line = self.console[self._heard]
                self._heard += 1
                if text in line:
                    return line
            if self.now_us >= end_us:
                said = "".join(f"\n  {line}" for line in self.console[first:]) or " nothing"
                raise UnmetExpectation(
                    f"{text!r} not printed within {within_ms:g} ms from {begin_us / 1000:g} ms on; the board printed:{said}"
                )
            self._run_until(min(self.now_us + IMU_PERIOD_US, end_us))

    def read(self, name: str) -> float:
        """Return a log variable, like `stateEstimate.z`. Raises `LabError` for a missing one."""
        for variable in self.firmware.variables:
            if variable.name == name:
                return variable.read()
        raise LabError(f"log variable {name!r}: there is none; cfclient lists them all")

    @property
    def tasks(self) -> Mapping[str, TaskReport]:
        """The tasks' timing, by name: run time, response, missed deadlines."""
        return {report.name: report for report in self.firmware.reports()}

    @property
    def battery_mv(self) -> int:
        """The supply voltage [mV]; may be set."""
        return self._board.battery_mv

    @battery_mv.setter
    def battery_mv(self, value: int) -> None:
        self._board.supply(value)

    def _run_until(self, end_us: int) -> None:
        """Execute events in order of time: hardware first, then the firmware."""
        events, firmware = self._events, self.firmware
        while self.now_us < end_us:
            wakes = (end_us, events.next_us, firmware.next_wake_us)
            self.now_us = min(wake for wake in wakes if wake is not None)
            if self.now_us > firmware.kernel.now_us:
                firmware.kernel.advance(self.now_us)
            events.run(self.now_us)
            firmware.run(self.now_us)
        firmware.check_watchdog()

    def _sample(self, now_us: int) -> None:
        if self.imu_running:
            self._noise = -self._noise  # of one count: a real gyro does not repeat samples for long
            *before, r, x, y, z = self._fed
            self._board.measure((*before, r + self._noise, x, y, z))
            self.firmware.imu_ready()

    def _arrive(self, packet: bytes) -> None:
        if self._serial is None:
            self.firmware.radio_received(packet)
        else:
            self._serial.receive(packet)
            self.firmware.uart_ready()

    def _set_counts(self, now_us: int, counts: Sequence[int]) -> None:
        self.counts = tuple(counts)

    def _send(self, now_us: int, data: bytes) -> bool:
        if self._serial is None:
            self.sent.append((now_us, data))
        return True


def _counts(v_B: Vector, per_unit: float) -> tuple[int, int, int]:
    """Return a vector as the sensor measures it: turned into S, in counts, saturated."""
    x, y, z = v_B
    v_S = COS * x + SIN * y, COS * y - SIN * x, z
    a, b, c = (int(min(max(round(one * per_unit), -COUNTS), COUNTS - 1.0)) for one in v_S)
    return a, b, c
