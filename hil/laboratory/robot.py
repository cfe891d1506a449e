"""One robot in its tunnel: body, battery, IMU, the cameras that see it, and a board whose firmware boots and reboots.

All times are the laboratory's, except the firmware's, which count from its boot. The caller provides the receiver of the
board's radio packets and the other end of its UART.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from math import isfinite
from typing import Literal

import numpy as np

from firmware_py.logic.loading import load_logic
from ground_station.mocap import MocapFrame
from hil.board.board_firmware import Executor, PowerOn, PythonBoard
from hil.board.cameras import VirtualMocap
from hil.board.imu import GYRO_COUNTS, VirtualImu
from hil.board.markers import Sighting, VirtualMarkers
from hil.board.own_sensors import PERIOD_US as SENSORS_US
from hil.board.own_sensors import OwnSensors
from hil.board.pins import CpuLoad, InjectFailure, Requests, VirtualBoard, new_eeprom, unsupported
from hil.board.uart import VirtualSerial
from hil.config import LabConfig, load_config
from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.nrf51 import peer_packet
from hil.emulator.crazyflie.shockburst import Air
from hil.emulator.events import EventQueue
from hil.errors import LabError
from hil.laboratory.bodies import make_body
from hil.world.battery import Battery, open_circuit_voltage
from hil.world.body import Body, Carrier, Vector

IMU_PERIOD_US = 1_000
# Share of a gyro's flight noise before the fans run, if it exceeds what the stock firmware accepts at rest: less than 100
# counts squared.
BENCH_NOISE, BENCH_GYRO = 0.05, 10.0 / GYRO_COUNTS  # [rad/s]
MOCAP_PHASE_US = 7_000  # so that a pose of 40 ms reaches the estimator 1-3 ms before its step

See = Callable[[MocapFrame, int, Sighting | None], None]  # (frame, now_us, sighting of the markers)
Note = Callable[[str, str], None]  # writes a source and its text into the event log
PYTHON_BOARD = PythonBoard()
SendPacket = Callable[[int, bytes], bool]  # (now_us, packet): False when it must wait


@dataclass(frozen=True, slots=True)
class Streams:
    """One random stream per component, all from one seed."""

    gusts: np.random.Generator
    imu: np.random.Generator
    mocap: np.random.Generator
    radio: np.random.Generator
    serial: np.random.Generator
    markers: np.random.Generator
    board: np.random.Generator  # of its sensors besides the IMU
    sensors: np.random.Generator  # of a user's own robot

    @classmethod
    def of_seed(cls, seed: int) -> Streams:
        """Split a seed."""
        return cls(*(np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(8)))


@dataclass(frozen=True, slots=True)
class Site:
    """A robot's place, its time line, and the executor of its firmware."""

    config: LabConfig
    events: EventQueue
    streams: Streams
    note: Note
    executor: Executor = PYTHON_BOARD


@dataclass(frozen=True, slots=True)
class Ports:
    """The connections of a robot's board: the medium of its radio and its UART, None if missing, and the receivers.

    `polled`: a real host polls its radio, so empty polls need no model. `restart` boots the robot after a reset of its
    processor; by default it does so itself. `radio_command` takes what the processor commands its radio chip; by default
    only its power switch works. `fail` makes a part of it fail. `eeprom` may have contents.
    """

    send_packet: SendPacket
    air: Air | None = None
    uart: VirtualSerial | None = None
    polled: bool = False
    restart: Callable[[int], None] | None = None
    radio_command: Callable[[int, int, bytes], None] | None = None
    fail: InjectFailure = unsupported
    eeprom: bytearray = field(default_factory=new_eeprom)
    to_peers: Callable[[int, bytes], object] = lambda now_us, packet: (
        None
    )  # takes what it sends to other boards


class Robot:
    """Built at rest in its holder at home, with the firmware running; `watch` starts IMU and cameras.

    Faults of its links change `air` (of its radio) and `uart`; None for a missing link. `firmware` is that of the current
    boot.
    """

    def __init__(self, site: Site, ports: Ports) -> None:
        config, streams = site.config, site.streams
        home, offset = config.flight.home, config.flight.start_offset
        self.start_W = (home[0] + offset[0], home[1] + offset[1], home[2] + offset[2])
        self.config = config
        self.events = site.events
        self._beat_us = site.events.beat.cell("now_us")
        self.note = site.note
        self.free = False
        self.powered = True
        self.pushes: tuple[float, ...] = (0.0,) * 6  # of faults: force [N, W] and torque [N m, B]
        self._contact: tuple[float, ...] = (0.0,) * 3
        self.body: Body = make_body(config, streams.gusts, self.start_W)
        self.body.hold()
        at_rest = self.body.draw(0, open_circuit_voltage(config.battery.charge))
        self.battery: Battery = Battery(config.battery, at_rest)
        self.imu: VirtualImu = VirtualImu(config.imu, streams.imu)
        seen = (config.markers, self.body.markers, streams.markers)
        markers = VirtualMarkers(*seen) if config.markers.enabled else None
        self.mocap = VirtualMocap(config.mocap, streams.mocap, markers)
        self.sensors = OwnSensors(self.body.sensors, config.sensors, streams.sensors)
        self.sensors.check(load_logic(config.logic))
        self.air, self.uart = ports.air, ports.uart
        self.executor = site.executor
        self._ports = ports
        self._carrier = Carrier(self.body, streams.board, self.body.room, config.robot.decks, self.body.escs)
        self._thief: CpuLoad | None = None
        self._seen_by: list[See] = []
        self._on_boot: list[Callable[[], None]] = []
        self._resets = 0
        self._failures: tuple[str, ...] = ()  # of the firmware before the last power-on
        self.board = VirtualBoard(
            self.body.set_counts,
            ports.send_packet,
            lambda now_us, text: self.note("board", text),
            self.uart,
            Requests(self._reset, ports.radio_command or self._radio_command, ports.fail),
            ports.eeprom,
            self.sensors.samples,
        )
        self.board.supply(self.battery.millivolts)
        self.boot(0)

    def boot(self, now_us: int) -> None:
        """Start the firmware; its clock begins here. The EEPROM keeps its content."""
        self.booted_us = now_us
        self.powered = True
        if now_us:
            self._failures = self.failures
        if self.uart is not None:
            self.uart.read()  # a booted processor starts with an empty buffer
        self.board.boot(now_us)
        specimen = self.imu.twin()  # gives every board the same sensor noise in flight
        specimen.set_noise_scale(BENCH_NOISE if self.config.imu.gyro_noise > BENCH_GYRO else 1.0)
        rest = None if now_us else lambda: specimen.sample(self.body)
        start = PowerOn(
            self.board, self.config, self.uart is not None, self._ports.polled, rest, self.body.outputs,
            self._carrier,
        )  # fmt: skip
        self.firmware = self.executor.boot(start)
        self.imu.continue_from(specimen)
        self.board.run_on(self.firmware.kernel, self.events)
        flight = self.firmware.flight_tasks
        self._in_c = flight is not None and flight.take_beats(self.events.beat, now_us, self._take_beat)
        if self._thief is not None:
            self._occupy(self._thief)
        for act in self._on_boot:
            act()

    def on_boot(self, act: Callable[[], None]) -> None:
        """Call `act` after every further boot: `firmware` is another one then."""
        self._on_boot.append(act)

    def execute(self, executor: Executor) -> None:
        """Let another image start at the next boot."""
        self.executor = executor

    def cut_power(self) -> None:
        """Stop the firmware; the servos keep their last pulse."""
        self.powered = False

    @property
    def beats(self) -> bool:
        """Whether a run of its processor takes the samples of the IMU by itself."""
        return self.powered and self._in_c

    def watch(self, start_us: int) -> None:
        """Start IMU and cameras, which run for ever."""
        self.events.set_beat(IMU_PERIOD_US, start_us + IMU_PERIOD_US, self._sample)
        self.events.every(self.config.mocap.period_us, start_us + MOCAP_PHASE_US, self._expose)
        if self.body.sensors:
            self.events.every(SENSORS_US, start_us + SENSORS_US, self._sense)

    def seen_by(self, see: See) -> None:
        """Pass every camera frame to `see` when the cameras' computer has it."""
        self._seen_by.append(see)

    @property
    def thief(self) -> CpuLoad:
        """The load that takes processor time from the board, created at first use; its share is 0 until set."""
        if self._thief is None:
            self._thief = CpuLoad()
            self._occupy(self._thief)
        return self._thief

    def _occupy(self, thief: CpuLoad) -> None:
        if self.firmware.scheduler is None:
            raise LabError("--hil: the processor time of a real board cannot be taken")
        self.firmware.scheduler.occupy("THIEF", thief.taken_us)

    @property
    def links(self) -> str:
        """The names of its links, radio and mavlink."""
        return " ".join(
            name for name, end in (("radio", self.air), ("mavlink", self.uart)) if end is not None
        )

    @property
    def resets(self) -> int:
        """How often the processor was reset."""
        flashed = self.firmware.flashed
        return self._resets + (0 if flashed is None else flashed.resets)

    @property
    def failures(self) -> tuple[str, ...]:
        """What stopped the firmware or one of its tasks, in order, each as one line; only images report it."""
        flashed = self.firmware.flashed
        return self._failures + (() if flashed is None else tuple(flashed.failures))

    # Time

    def run(self, now_us: int, until_us: int = 0) -> None:
        if self.powered:
            self.firmware.kernel.run(now_us - self.booted_us, until_us - self.booted_us)

    def advance(self, now_us: int) -> None:
        if self.powered and now_us - self.booted_us > self.firmware.kernel.now_us:
            self.firmware.kernel.advance(now_us - self.booted_us)

    # Body

    def push(self, force_W: Vector, torque_B: Vector) -> None:
        """Apply a force [N] and a torque [N m] until the next call."""
        self.pushes = (*force_W, *torque_B)
        self._apply()

    def touch(self, force_W: Vector) -> None:
        """Apply the force [N] of other robots until the next call."""
        self._contact = tuple(force_W)
        self._apply()

    def _apply(self) -> None:
        force_W = [push + contact for push, contact in zip(self.pushes[:3], self._contact, strict=True)]
        self.body.push(force_W, self.pushes[3:])

    def release(self) -> None:
        self.body.release()
        self.free = True

    def catch(self) -> None:
        """Take the body out of the flow."""
        self.free = False

    def put_back(self, now_us: int) -> None:
        """Return a caught body to the holder, as at the start; actuators, air and faults stay unchanged."""
        self.body.advance(now_us)
        self.body.put_back(self.start_W)

    def advance_truth(self, now_us: int) -> str | None:
        """Advance the truth and the battery to this time; return why the flight is over, None while it is not."""
        self.body.advance(now_us)
        self.battery.draw(now_us, self.body.draw(now_us, self.battery.voltage))
        self.board.supply(self.battery.millivolts)
        if not isfinite(sum(self.body.state.tolist())):
            return f"the body is nowhere: p_WB = {self.body.p_WB.tolist()}, q_WB = {self.body.q_WB.tolist()}"
        return self.body.lost

    # Interrupts

    def packet_received(self, now_us: int, data: bytes, broadcast: bool = False) -> None:
        """Interrupt: the radio chip has a packet."""
        if self.powered:
            self.firmware.radio_received(data, broadcast)

    def polled(self, now_us: int) -> None:
        if self.powered:
            self.firmware.radio_polled()

    def uart_ready(self, now_us: int) -> None:
        if self.powered:
            self.firmware.uart_ready()

    def _sample(self, now_us: int) -> None:
        if self._measured(now_us):
            self.firmware.imu_ready()

    def _take_beat(self) -> bool:
        return self._measured(self._beat_us[0])

    def _measured(self, now_us: int) -> bool:
        """Take a sample; return whether the IMU raises its interrupt."""
        self.body.advance(now_us)
        if not self.powered:
            return False
        self.imu.measure(self.body)
        if not self.imu.silent:
            self.board.measure(self.imu.count)
        return not self.imu.silent

    def _sense(self, now_us: int) -> None:
        self.body.advance(now_us)
        self.sensors.sample(now_us, self.events)

    def _expose(self, now_us: int) -> None:
        self.body.advance(now_us)
        frame, arrival_us = self.mocap.expose(now_us, self.body)
        sighting = self.mocap.sighting

        def deliver(now_us: int) -> None:
            for see in self._seen_by:
                see(frame, now_us, sighting)

        self.events.at(arrival_us, deliver)

    # Pins

    def _reset(self, now_us: int) -> None:
        def restart(now_us: int) -> None:
            if self.powered:
                self.note("board", "reset")
                self._resets += 1
                (self._ports.restart or self.boot)(now_us)

        self.events.at(now_us, restart)

    def _radio_command(self, now_us: int, kind: int, data: bytes) -> None:
        if kind in (syslink.SWITCH_OFF, syslink.STM32_OFF):
            self.note("board", "switched off by its firmware")
            self.events.at(now_us, lambda _: self.cut_power())
        elif kind == syslink.PEER_BROADCAST and data:
            self._ports.to_peers(now_us, peer_packet(data))


def with_system(config: LabConfig, system: int) -> LabConfig:
    """Return the configuration with another MAVLink system id. Raises `LabError` for an invalid one."""
    if system > MAX_SYSTEM:
        raise LabError(f"mavlink.system = {system}: ids end at {MAX_SYSTEM}")
    mavlink = config.mavlink.model_copy(update={"system": system})
    return config.model_copy(update={"mavlink": mavlink})


MAX_SYSTEM = 255


def nobody_listens(now_us: int, data: bytes) -> bool:
    """Drop a packet."""
    return True


LINKS: tuple[Literal["radio", "mavlink"], ...] = ("radio", "mavlink")


@cache
def probe(link: Literal["", "radio", "mavlink"], markers: bool) -> Robot:
    """Return a booted robot that never flies, to try a user's declarations; without a link it has both."""
    config, events = load_config(overrides=("markers.enabled=true",) if markers else ()), EventQueue()
    site = Site(config, events, Streams.of_seed(0), lambda *_: None)
    air = Air.of(config.radio) if link != "mavlink" else None
    uart = VirtualSerial(config.serial, events, site.streams.serial) if link != "radio" else None
    return Robot(site, Ports(nobody_listens, air, uart))


def attributes_of(part: object) -> list[str]:
    """Return the numeric attributes of a part that can be set."""
    found = []
    for name in dir(part):
        value = getattr(part, name)
        if not name.startswith("_") and isinstance(value, int | float):
            with suppress(AttributeError, TypeError):
                setattr(part, name, value)
                found.append(name)
    return found
