"""One flight: the board, the ground station and the world on one time line.

Hardware events own time; at equal time hardware goes first, then the firmware's tasks. Everything random comes from one
seed, split into one stream per component. The loop is the one of ARCHITECTURE.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from firmware_py.core_runner import PythonRunner, RunnerFactory
from firmware_py.extras import install_command
from firmware_py.firmware import Firmware, Thief
from ground_station.links.loopback import LoopbackLink
from ground_station.mocap import MocapFrame
from ground_station.station import GroundStation, Link
from ground_station.telemetry_log import TelemetryLog
from ground_station.tracker import tracker_of
from ground_station.trajectory import Goal
from hil.channels import (
    battery_channel,
    fault_channel,
    flight_channels,
    marker_channel,
    radio_channel,
    tracker_channel,
)
from hil.clock import Clock, FreeRunning
from hil.config import LabConfig
from hil.errors import LabError
from hil.events import EventQueue
from hil.experiments import Experiment
from hil.faults import Fault, plan
from hil.markers import make_markers
from hil.plant.battery import Battery
from hil.plant.plant import Plant
from hil.recorder import Channel, Recorder
from hil.schedule import WINDOW_US, ScheduleTrace
from hil.virtual_board import VirtualBoard
from hil.virtual_imu import VirtualImu
from hil.virtual_mocap import VirtualMocap
from hil.virtual_radio import VirtualRadio

if TYPE_CHECKING:
    from hil.serial_line import SerialLine

IMU_PERIOD_US = 1_000
MOCAP_PHASE_US = 7_000  # so that a pose of 40 ms reaches the estimator 1-3 ms before its step
RECORD_PERIOD_US = 10_000
RECORD_PHASE_US = 250  # just after the controller
PROGRESS_PERIOD_US = 250_000
DROP_NOTE_PERIOD_US = 1_000_000
RADIO, MAVLINK = "radio", "mavlink"
LOCKSTEP = (RADIO, MAVLINK)  # links that are simulated whole


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a flight ended."""

    end_us: int
    lost: str | None  # cause of a crash
    interrupted: bool


@dataclass(frozen=True, slots=True)
class Streams:
    """One random stream per component, all from one seed."""

    gusts: np.random.Generator
    imu: np.random.Generator
    mocap: np.random.Generator
    radio: np.random.Generator
    serial: np.random.Generator
    markers: np.random.Generator

    @classmethod
    def of_seed(cls, seed: int) -> Streams:
        """Split a seed."""
        return cls(*(np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(6)))


class Flight:
    """A board in its virtual tunnel with its ground station, ready to be released.

    `faults` come on top of the experiment's own; `runner` executes the flight core.
    """

    plant: Plant
    imu: VirtualImu
    mocap: VirtualMocap
    radio: VirtualRadio
    serial: SerialLine | None
    board: VirtualBoard
    link: str

    def __init__(
        self,
        config: LabConfig,
        experiment: Experiment,
        duration_s: float,
        seed: int,
        telemetry_path: Path | None,
        clock: Clock | None = None,
        trace_all: bool = False,
        link: str = RADIO,
        faults: Sequence[Fault] = (),
        runner: RunnerFactory = PythonRunner,
    ) -> None:
        streams = Streams.of_seed(seed)
        home, offset = config.flight.home, config.flight.start_offset
        self.config = config
        self.link = link
        self.events = EventQueue()
        self.clock: Clock = clock or FreeRunning()
        self.release_us = config.flight.release_us
        self.end_us = self.release_us + round(duration_s * 1e6)
        self.lost: str | None = None
        self.free = False
        self._drops_noted: dict[str, int] = {}
        self._next_drop_note_us = 0
        self.recorder: Recorder | None = None
        self.trajectory = experiment.trajectory(Goal(home, 0.0), self.release_us)
        self.plant = Plant(
            config.plant, config.tunnel, config.actuators, streams.gusts,
            (home[0] + offset[0], home[1] + offset[1], home[2] + offset[2]),
        )  # fmt: skip
        self.battery: Battery = Battery(config.battery)
        self.imu = VirtualImu(config.imu, streams.imu)
        self.mocap = VirtualMocap(
            config.mocap, streams.mocap, make_markers(config.markers, config.plant, streams.markers)
        )
        self.radio = VirtualRadio(config.radio, self.events, streams.radio)
        self.serial = _serial_line(config, self.events, streams.serial) if link == MAVLINK else None
        end: Link = (
            self.serial.link
            if self.serial
            else LoopbackLink(self.radio.uplink, config.station.link_latency_us)
        )
        self.telemetry = TelemetryLog(telemetry_path) if telemetry_path else None
        self.tracker = tracker_of(config.tracker, config.mocap.period_us)
        self.station = GroundStation(end, self.trajectory, self.telemetry, config.station, self.tracker)
        uart = self.serial.uart if self.serial else None
        self.board = VirtualBoard(self.plant.set_counts, self.radio.downlink, self._console, uart)
        self.board.battery_mv = self.battery.millivolts
        self.firmware = Firmware(config, self.board, mavlink=link == MAVLINK, runner=runner)
        self.board.run_on(self.firmware.kernel, self.events)
        self.radio.connect(self._radio_to_board, self.station.on_packet)
        if self.serial:
            self.serial.connect(self.firmware, self.station)
            self.events.at(0, self._state_budget)
        self.plant.hold()
        self.events.at(self.release_us, self._release)
        experiment.script(self)
        self.faults = (*experiment.faults, *faults)
        self.active_faults = plan(self.faults, self)
        self.schedule = ScheduleTrace(self.firmware.kernel)
        start_us = 0 if trace_all else self.release_us
        self.events.at(start_us, self.schedule.begin)
        self.events.at(self.end_us if trace_all else start_us + WINDOW_US, self.schedule.end)
        self.events.every(IMU_PERIOD_US, IMU_PERIOD_US, self._imu_sample)
        self.events.every(config.mocap.period_us, MOCAP_PHASE_US, self._expose)
        self.events.every(RECORD_PERIOD_US, RECORD_PHASE_US, self._record)

    @property
    def now_us(self) -> int:
        """The present instant of the simulation."""
        return self.board.now_us

    def channels(self) -> tuple[Channel, ...]:
        """Return what there is to record."""
        link = self.serial.channel(self.firmware) if self.serial else radio_channel(self.radio)
        channels = flight_channels(self.plant, self.board, self.firmware, self.trajectory, lambda: self.free)
        tracker = (tracker_channel(self.tracker),) if self.tracker else ()
        faults = (fault_channel(self.active_faults),) if self.faults else ()
        markers = (marker_channel(self.mocap),) if self.mocap.markers else ()
        return (*channels, link, battery_channel(self.battery), *tracker, *markers, *faults)

    @cached_property
    def thief(self) -> Thief:
        """A task on the board above all others, there from the first use on; it takes nothing until told to."""
        return self.firmware.add_thief()

    def run(self, progress: Callable[[int], None] | None = None) -> Outcome:
        """Fly to the end, the crash, or Ctrl-C; the log is left open for the caller to close."""
        try:
            self._loop(progress or _silent)
        except KeyboardInterrupt:
            self.note("lab", "interrupted by the user")
            return Outcome(self.board.now_us, self.lost, interrupted=True)
        return Outcome(self.board.now_us, self.lost, interrupted=False)

    def _loop(self, progress: Callable[[int], None]) -> None:
        """Go from one instant at which anything happens to the next."""
        events, kernel, wait_until = self.events, self.firmware.kernel, self.clock.wait_until
        next_progress_us = 0
        while kernel.now_us < self.end_us:
            now_us = self.end_us if events.next_us is None else min(events.next_us, self.end_us)
            wake_us = kernel.next_wake_us
            if wake_us is not None and wake_us < now_us:
                kernel.run(now_us - 1)  # by itself, up to the next thing that hardware does
                if events.next_us is not None and events.next_us < now_us:
                    continue  # a task has set hardware going that acts earlier
            wait_until(now_us)
            kernel.advance(now_us)
            events.run(now_us)
            kernel.run(now_us)
            if now_us >= next_progress_us:
                progress(now_us)
                next_progress_us = now_us + PROGRESS_PERIOD_US

    # Hardware events

    def _imu_sample(self, now_us: int) -> None:
        self.plant.advance(now_us)
        self.board.imu = self.imu.sample(self.plant)
        self.firmware.imu_ready()

    def _expose(self, now_us: int) -> None:
        self.plant.advance(now_us)
        frame = self.mocap.expose(now_us, self.plant)
        arrival_us = self.mocap.arrival_us(now_us)
        self.events.at(arrival_us, self._deliver(self.mocap.stamped(frame, arrival_us)))

    def _deliver(self, frame: MocapFrame) -> Callable[[int], None]:
        return lambda now_us: self.station.on_frame(frame, now_us)

    def _radio_to_board(self, now_us: int, data: bytes) -> None:
        self.firmware.radio_received(data)

    def _release(self, now_us: int) -> None:
        self.plant.release()
        self.free = True
        self.note("lab", "released")

    def _record(self, now_us: int) -> None:
        self.plant.advance(now_us)
        self.battery.draw(now_us, self.plant.flap_travel)
        self.board.battery_mv = self.battery.millivolts
        if self.recorder is not None:
            self.recorder.row(now_us)
        self.firmware.check_watchdog()
        self._note_drops(now_us)
        for line in self.station.notices():
            self.note("station", line)
        for line in self.clock.notices():
            self.note("lab", line)
        if self.plant.lost is not None:
            self.lost = self.plant.lost
            self.end_us = now_us
            self.note("lab", f"lost: {self.lost}")

    def _note_drops(self, now_us: int) -> None:
        """Say which queue drops, once per second at most."""
        for queue in self.firmware.kernel.queues:
            if queue.dropped > self._drops_noted.get(queue.name, 0) and now_us >= self._next_drop_note_us:
                self.note("board", f"queue {queue.name} is full: {queue.dropped} dropped so far")
                self._drops_noted[queue.name] = queue.dropped
                self._next_drop_note_us = now_us + DROP_NOTE_PERIOD_US

    def _state_budget(self, now_us: int) -> None:
        assert self.serial is not None
        self.note("lab", self.serial.link.budget.text)

    def _console(self, now_us: int, text: str) -> None:
        self.note("board", text)

    def note(self, source: str, text: str) -> None:
        """Put a line into the event log."""
        if self.recorder is not None:
            self.recorder.note(self.board.now_us, source, text)

    def write_schedule(self, folder: Path) -> None:
        """Write what was traced of the scheduler."""
        self.schedule.end(self.now_us)
        self.schedule.write(folder)

    def close(self) -> None:
        """Close what the flight itself opened."""
        if self.telemetry is not None:
            self.telemetry.close()


def _serial_line(config: LabConfig, events: EventQueue, rng: np.random.Generator) -> SerialLine:
    """Return the serial line, whose packages are an extra."""
    try:
        from hil.serial_line import SerialLine
    except ImportError as error:
        raise LabError(f"--link mavlink needs pymavlink ({error}): {install_command('mavlink')}") from None
    return SerialLine(config, events, rng)


def _silent(now_us: int) -> None:
    """Show no progress."""
