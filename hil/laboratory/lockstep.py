"""A flight in lockstep: radio or serial line are modelled, and the ground station shares the time line."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from firmware_py.errors import FirmwareError
from firmware_py.wire.memories import CONFIG_SIZE
from firmware_py.wire.telemetry import ALL_BLOCKS, CRAZYFLIE_BLOCKS
from ground_station.errors import LinkError
from ground_station.lines import print_line
from ground_station.links.crazyflie_link import CrazyflieLink, FlightTimes
from ground_station.links.frame_log import FRAME_LOG, FrameLog
from ground_station.links.loopback import LoopbackLink
from ground_station.station import GroundStation, Link
from ground_station.telemetry_log import TelemetryLog
from ground_station.tracker import tracker_of
from ground_station.trajectory import FlightPlan, Goal, Trajectory
from hil.board.board_firmware import Executor, Flashed, PythonBoard
from hil.board.clock import Clock, FreeRunning, Paced
from hil.board.cores.boards import runner_of
from hil.board.eeprom import factory_config
from hil.board.image_settings import APP_PARAMETER, NO_APP, ImageSettings, stock_contents
from hil.board.pins import new_eeprom
from hil.board.radio import Receiver, VirtualRadio
from hil.board.real_core import is_link, real_core
from hil.board.uart import VirtualSerial
from hil.emulator.crazyflie.shockburst import TURN_ROUND_US, Air, air_us
from hil.errors import LabError, refusing
from hil.laboratory.channels import radio_channel, serial_channel, tracker_channel
from hil.laboratory.files.recorder import SETTINGS, Correct
from hil.laboratory.flight import Flight
from hil.laboratory.laboratory import Laboratory
from hil.laboratory.request import MAVLINK, Bench, Request
from hil.laboratory.robot import PYTHON_BOARD, Ports, Robot, Site, nobody_listens
from hil.world.body import Channel

if TYPE_CHECKING:
    from hil.board.image_firmware import ChipImage, ImageObserver
    from hil.emulator.stm32f405.gdb import GdbServer


class ModelledLine:
    """`hil.laboratory.flight.Line` for the modelled links; `station`, `tracker` and `radio` may be read."""

    def __init__(
        self,
        telemetry: Path | None,
        number: int,
        correct: Correct | None,
        request: Request,
        site: Site,
        lab: Laboratory,
    ) -> None:
        config, events, streams = site.config, site.events, site.streams
        serial = request.bench.link == MAVLINK
        self.correct = correct
        self._release_us = config.flight.release_us
        self._home = Goal(config.flight.home, 0.0)
        self.trajectory = FlightPlan(self._home, lambda *_: request.trajectory)
        self.trajectory.start(self._release_us)
        self._bits_per_second, self._wire_us = config.radio.bits_per_second, site.executor.wire_us
        self.tracker = tracker_of(config.tracker, config.mocap.period_us)
        air = Air.of(config.radio)
        uart = VirtualSerial(config.serial, events, streams.serial) if serial else None
        self.radio = VirtualRadio(config.radio, events, streams.radio, air, site.executor.wire_us)
        self._to_peers: Receiver = nobody_listens
        self._peer_noise = streams.radio.spawn(1)[0]
        eeprom = new_eeprom()
        eeprom[:CONFIG_SIZE] = factory_config(number, config.radio)
        ports = Ports(
            self.radio.downlink,
            None if serial else air,
            uart,
            eeprom=eeprom,
            to_peers=lambda now_us, packet: self._to_peers(now_us, packet),
        )
        self.robot = Robot(site, ports)
        self._frames: FrameLog | None = None
        self._pilot: CrazyflieLink | None = None
        self._link, self._channel = (
            self._radio(request) if uart is None else self._serial(site, uart, telemetry)
        )
        blocks = CRAZYFLIE_BLOCKS if config.pilot.enabled else ALL_BLOCKS
        self._telemetry = TelemetryLog(telemetry, blocks) if telemetry else None
        write_sample = None if self._telemetry is None else self._telemetry.write
        self.station = GroundStation(self._link, self.trajectory, write_sample, config.station, self.tracker)
        self._receivers: list[Receiver] = [self.station.on_packet]  # receivers of the board's radio packets
        if self.robot.firmware.flashed is not None and not config.pilot.enabled:
            self._set_up(site, self.robot.firmware.flashed)
        self.radio.connect(self.robot.packet_received, self._on_ground, self.robot.polled)
        if uart is not None:
            uart.connect(self.robot.uart_ready, self.station.on_packet)
        self.robot.seen_by(lambda frame, now_us, _: self.station.on_frame(frame, now_us))

    def _on_ground(self, now_us: int, data: bytes) -> None:
        for receive in self._receivers:
            receive(now_us, data)

    def _set_up(self, site: Site, flashed: Flashed) -> None:
        """Send the flight's settings to the board; report firmware that may not drive this robot."""
        if APP_PARAMETER not in flashed.parameters:
            site.note(SETTINGS, NO_APP)
        say, uplink = partial(site.note, SETTINGS), self.radio.uplink
        settings = ImageSettings(
            flashed.parameters, flashed.differences, site.config, site.events, uplink, say
        )
        site.events.at(0, settings.begin)
        self._receivers.append(settings.on_packet)

    def begin(self, release: Callable[[int], None]) -> None:
        """Plan the release at the profile's time."""
        release(self._release_us)

    def channels(self) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
        """Return the counters of line and tracker."""
        return (self._channel,), (tracker_channel(self.tracker),) if self.tracker else ()

    def _radio(self, request: Request) -> tuple[Link, Channel]:
        latency_us = request.config.station.link_latency_us
        link: Link = LoopbackLink(self.radio.uplink, latency_us, lambda: self.robot.firmware.log_numbers)
        if request.times is not None:
            link = self._pilot = self._crazyflie_link(request, request.times, latency_us)
        return link, radio_channel(self.radio)

    def _crazyflie_link(self, request: Request, times: FlightTimes, latency_us: int) -> CrazyflieLink:
        """Return the link to the stock firmware. Raises `LabError` for an image that does not fit the profile."""
        config, firmware = request.config, self.robot.firmware
        parameters = {} if firmware.flashed is None else firmware.flashed.parameters
        entries = stock_contents(parameters, firmware.log_numbers, config.pilot)
        return CrazyflieLink(
            self.radio.uplink,
            latency_us,
            lambda: self.robot.firmware.log_numbers,
            entries,
            config.pilot,
            self._home,
            times,
        )

    def _serial(self, site: Site, uart: VirtualSerial, telemetry: Path | None) -> tuple[Link, Channel]:
        """Return the station's end of the serial line. Raises `LabError` when it is too slow for a flight."""
        from ground_station.links.mavlink import MavlinkLink  # its package is an extra

        with refusing("--link mavlink: ", LinkError):
            link = MavlinkLink(uart.uplink, site.config.ground.links(self._note_frame))
        self._frames = FrameLog(telemetry.with_name(FRAME_LOG)) if telemetry is not None else None
        site.events.at(0, lambda now_us: site.note("lab", link.budget.text))
        return link, serial_channel(uart, self.robot.firmware, link)

    def _note_frame(self, now_us: int, frame: bytes) -> None:
        if self._frames is not None:
            self._frames.note(now_us, frame)

    def steer(self, trajectory: Trajectory) -> None:
        """Fly another trajectory from now on."""
        self.trajectory.steer(trajectory)

    def join(self, to_peers: Receiver) -> None:
        """Pass the packets that the board broadcasts to other boards."""
        self._to_peers = to_peers

    def hear_peer(self, now_us: int, packet: bytes) -> None:
        """Let a packet of another board arrive, unless it is lost."""
        if self._peer_noise.random() >= self.radio.medium.lost_up(len(packet)):
            delay_us = TURN_ROUND_US + air_us(len(packet), self._bits_per_second) + self._wire_us(packet)
            self.robot.events.at(
                now_us + delay_us, lambda now_us: self.robot.packet_received(now_us, packet, True)
            )

    def command(self, now_us: int, packet: bytes) -> None:
        """Send an operator's packet over the radio."""
        self.radio.uplink(now_us, packet)

    def listen(self, receive: Receiver) -> None:
        """Also pass the board's radio packets to an operator."""
        if self.robot.uart is not None:
            raise LabError("over MAVLink a flight in lockstep has no operator who sets parameters")
        self._receivers.append(receive)

    def new_messages(self, now_us: int) -> list[tuple[str, str]]:
        lines = self.station.notices()
        if self._pilot is not None:
            lines += self._pilot.notices
            self._pilot.notices.clear()
        return [("station", line) for line in lines]

    def finish(self, lab: Laboratory) -> None:
        """Do nothing: the station ends with its time line."""

    def close(self) -> None:
        with ExitStack() as closing:  # all of them, even on a full disk
            for written in (self._telemetry, self._frames):
                if written is not None:
                    closing.callback(written.close)


def lockstep_flight(
    request: Request,
    telemetry: Path | None = None,
    executor: Executor = PYTHON_BOARD,
    clock: Clock | None = None,
    number: int = 1,
    correct: Correct | None = None,
) -> Flight:
    """Return a flight over a modelled link. Without a clock it is paced if the request is in real time.

    `number` is the robot's in a swarm, from 1, and gives its board an own radio address.
    """
    clock = clock or (Paced() if request.bench.realtime else FreeRunning())
    return Flight(request, clock, partial(ModelledLine, telemetry, number, correct), executor)


def in_lockstep(request: Request, telemetry: Path | None, stack: ExitStack, from_us: int = 0) -> Flight:
    """Return a flight over a modelled link, as `executor_of` has it. Raises `LabError` if its board is not available."""
    with refusing("--board ", LinkError):
        return lockstep_flight(request, telemetry, executor_of(request, stack, from_us))


def executor_of(request: Request, stack: ExitStack, from_us: int = 0) -> Executor:
    """Return what executes the firmware of a request; under `--gdb` it waits at `from_us` of the laboratory's time.

    Raises `LabError` or `LinkError` if it is not available.
    """
    bench = request.bench
    if is_link(bench.board):
        return PythonBoard(real_core(bench.board, stack))
    if bench.is_image:
        why_forward = "real time does not" if bench.realtime or not bench.in_lockstep else ""
        server = debugger(bench.gdb, bench.elf or Path(bench.board), stack, why_forward, from_us)
        return replace(image_at(bench.board, bench.elf), debugger=server, observers=observers_of(bench))
    with refusing(f"--board {bench.board}: ", FirmwareError):
        return PythonBoard(runner_of(bench.board, request.config.logic))


def image_at(board: str, elf: Path | None) -> ChipImage:
    """Return the image that `--board` and `--elf` name. Raises `LabError` if it cannot run here."""
    from hil.board.image_firmware import ChipImage  # not needed by a flight without an image

    with refusing(f"--board {board}: ", FirmwareError):
        return ChipImage.load(Path(board), elf)


def observers_of(bench: Bench) -> tuple[ImageObserver, ...]:
    """Return what watches an image in flight."""
    found: list[ImageObserver] = []
    if bench.coverage is not None:
        from hil.laboratory.files.coverage import Coverage

        found.append(Coverage(bench.coverage, bench.board, bench.elf))
    if bench.profile_cpu is not None:
        from hil.laboratory.files.cpu_profile import Profiler

        found.append(Profiler(bench.profile_cpu))
    return tuple(found)


def debugger(
    port: int | None, image: Path, stack: ExitStack, why_forward: str = "", from_us: int = 0
) -> GdbServer | None:
    """Open the port of `--gdb` until the stack is closed; it prints the command to type when it waits.

    It waits at power-on, or at a later time of the laboratory. `image` is the ELF, or what flies without
    one. `why_forward`: why this flight cannot go back in time.
    """
    if port is None:
        return None
    from hil.emulator.stm32f405.checkpoints import Checkpoints, why_none
    from hil.emulator.stm32f405.gdb import GdbServer
    from hil.emulator.stm32f405.image import has_symbols

    why_forward = why_forward or why_none()
    if why_forward:
        print_line(f"--gdb {port}: time runs forward only: {why_forward}")

    def waiting(port: int) -> None:
        symbols = f"{shlex.quote(str(image))} " if has_symbols(image) else ""
        print_line(f"waiting for gdb-multiarch {symbols}-ex 'target remote 127.0.0.1:{port}'")

    checkpoints = None if why_forward else Checkpoints()
    return stack.enter_context(closing(GdbServer(port, waiting, checkpoints, from_us)))
