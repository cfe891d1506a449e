"""A flight in lockstep: the radio or the serial line modelled, the ground station on the same time line."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from firmware_py.core_runner import PythonRunner
from ground_station.links.frame_log import FRAME_LOG, FrameLog
from ground_station.links.loopback import LoopbackLink
from ground_station.station import GroundStation, Link
from ground_station.telemetry_log import TelemetryLog
from ground_station.tracker import tracker_of
from ground_station.trajectory import Goal
from hil.clock import Clock, FreeRunning
from hil.config import LabConfig
from hil.devices.radio import Receiver, VirtualRadio
from hil.devices.stm32f405.firmware import ImageFirmware
from hil.devices.stm32f405.settings import ImageSettings
from hil.laboratory.channels import radio_channel, tracker_channel
from hil.laboratory.experiment import Experiment
from hil.laboratory.faults import Fault
from hil.laboratory.flight import Flight
from hil.laboratory.laboratory import Laboratory
from hil.laboratory.recorder import Channel
from hil.laboratory.robot import Executor

RADIO, MAVLINK = "radio", "mavlink"
LOCKSTEP = (RADIO, MAVLINK)  # links that are fully simulated


class ModelledLine:
    """`hil.laboratory.flight.Line` for the modelled links; `station`, `tracker` and `radio` may be read."""

    def __init__(self, flight: Flight, link: str, telemetry_path: Path | None) -> None:
        config, robot = flight.config, flight.robot
        self.record: Path | None = None  # the log has the goals already
        self._robot = robot
        self.trajectory = flight.experiment.trajectory(
            Goal(config.flight.home, 0.0), config.flight.release_us
        )
        self.tracker = tracker_of(config.tracker, config.mocap.period_us)
        self.radio = VirtualRadio(config.radio, flight.events, flight.streams.radio, robot.air, robot.wire_us)
        robot.send_packet = self.radio.downlink
        self._frames: FrameLog | None = None
        self._link, self._channel = (
            self._serial(flight, telemetry_path) if link == MAVLINK else self._radio(config)
        )
        self._telemetry = TelemetryLog(telemetry_path) if telemetry_path else None
        self.station = GroundStation(
            self._link, self.trajectory, self._telemetry, config.station, self.tracker
        )
        on_ground: Receiver = self.station.on_packet
        if isinstance(robot.firmware, ImageFirmware):
            on_ground = self._set_up(flight, robot.firmware)
        self.radio.connect(robot.packet_received, on_ground, robot.polled)
        if robot.uart is not None:
            robot.uart.connect(robot.uart_ready, self.station.on_packet)
        robot.seen_by(lambda frame, now_us, _: self.station.on_frame(frame, now_us))

    def _set_up(self, flight: Flight, image: ImageFirmware) -> Receiver:
        """Let the settings of the flight reach the image; returns what takes packets from the board."""
        say = partial(flight.note, "lab")
        settings = ImageSettings(
            image.parameters, image.differences, flight.config, flight.events, self.radio.uplink, say
        )
        flight.events.at(0, settings.begin)

        def on_ground(now_us: int, data: bytes) -> None:
            self.station.on_packet(now_us, data)
            settings.hear(now_us, data)

        return on_ground

    def channels(self) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
        """The counters of line and tracker."""
        return (self._channel,), (tracker_channel(self.tracker),) if self.tracker else ()

    def _radio(self, config: LabConfig) -> tuple[Link, Channel]:
        return LoopbackLink(self.radio.uplink, config.station.link_latency_us), radio_channel(self.radio)

    def _serial(self, flight: Flight, telemetry_path: Path | None) -> tuple[Link, Channel]:
        """Return the station's end of the serial line, whose package is an extra."""
        from hil.laboratory.serial_line import link_of, serial_channel

        uart = self._robot.uart
        assert uart is not None
        link = link_of(flight.config, uart)
        if telemetry_path is not None:
            self._frames = FrameLog(telemetry_path.with_name(FRAME_LOG))
            link.note_frame = self._frames.note
        flight.events.at(0, lambda now_us: flight.note("lab", link.budget.text))
        return link, serial_channel(uart, self._robot.firmware, link)

    def command(self, now_us: int, packet: bytes) -> None:
        """Send a packet of the operator over the radio."""
        self.radio.uplink(now_us, packet)

    def look(self, now_us: int) -> list[tuple[str, str]]:
        """The station's messages."""
        return [("station", line) for line in self.station.notices()]

    def finish(self, lab: Laboratory) -> None:
        """Nothing: the station ends with its time line."""

    def close(self) -> None:
        """Close the station's files."""
        with ExitStack() as closing:  # all of them, even on a full disk
            for written in (self._telemetry, self._frames):
                if written is not None:
                    closing.callback(written.close)


def lockstep_flight(
    config: LabConfig,
    experiment: Experiment,
    duration_s: float,
    seed: int,
    telemetry_path: Path | None,
    clock: Clock | None = None,
    trace_all: bool = False,
    link: str = RADIO,
    faults: Sequence[Fault] = (),
    runner: Executor = PythonRunner,
) -> Flight:
    """Return a flight that is released at `flight.release_us`, over a modelled link."""
    flight = Flight(
        config, experiment, duration_s, seed, clock or FreeRunning(), link == RADIO, link == MAVLINK,
        faults, runner, trace_all,
    )  # fmt: skip
    flight.line = ModelledLine(flight, link, telemetry_path)
    flight.plan(config.flight.release_us)
    flight.watch()
    return flight
