"""Serves a robot to real clients: its laboratory follows the wall clock and answers sockets in between."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from firmware_py.rtos import WatchdogError
from firmware_py.wire.mavlink_numbers import CommandResult
from firmware_py.wire.supervisor import State
from ground_station.trajectory import Goal, Hold
from hil.board.board_firmware import Executor
from hil.board.clock import Paced
from hil.board.markers import NO_POINTS
from hil.config import LabConfig
from hil.emulator.crazyflie.nrf51 import AirSettings, Power, ToPeers
from hil.laboratory.channels import flight_channels
from hil.laboratory.faults import Fault, Switchboard
from hil.laboratory.files.recorder import Observer, Recorder
from hil.laboratory.flight import RECORD_PERIOD_US, RECORD_PHASE_US
from hil.laboratory.laboratory import NEVER_US, Laboratory
from hil.laboratory.robot import PYTHON_BOARD, Robot, Site, Streams, with_system
from hil.servers.built_in_station import fly_built_in
from hil.servers.failures import Failures
from hil.servers.motive import Streaming, VirtualMotive
from hil.servers.serial_server import Address
from hil.servers.served_robot import ServedRobot
from hil.servers.shared_room import SharedRoom
from hil.world.body import Channel

BUTTON_US = 5_000_000  # off, or in the bootloader without a client: then the button is pressed
HOLD_US = 1_000_000  # flying in the holder before the release
PUT_BACK_US = 1_000_000  # after a loss
WATCH_PERIOD_US = 10_000


def open_motive(settings: Streaming, robot: Robot, clock: Paced, count: int = 1) -> VirtualMotive:
    """Open a Motive that tracks `count` bodies, and a robot as the first."""
    markers = robot.body.markers.places if robot.config.markers.enabled else NO_POINTS
    motive = VirtualMotive(settings, count, clock.readers, markers, robot.config.mocap.period_us)
    show(robot, clock, partial(motive.stream_frame, 1))
    return motive


def show(robot: Robot, clock: Paced, take: Callable[..., None]) -> None:
    """Pass a robot's frames of the cameras to `VirtualMotive.stream_frame`."""
    robot.seen_by(lambda frame, now_us, sighting: take(frame, now_us, sighting, clock.began_us))


class LaunchClamp:
    """Holds one robot. Calls `let_go` when it has flown in its holder for a second, or stands on the floor."""

    def __init__(self, robot: Robot, let_go: Callable[[int], None]) -> None:
        self._robot = robot
        self._let_go = let_go
        self._flying_since_us: int | None = None
        robot.events.every(WATCH_PERIOD_US, WATCH_PERIOD_US, self._watch)

    def put_back_later(self, now_us: int) -> None:
        """Return the robot to the holder after a delay."""
        self._robot.catch()
        self._robot.events.at(now_us + PUT_BACK_US, self._put_back)

    def _put_back(self, now_us: int) -> None:
        self._robot.put_back(now_us)
        self._flying_since_us = None

    def _watch(self, now_us: int) -> None:
        robot = self._robot
        if robot.free or robot.body.lost is not None:
            return
        if robot.config.pilot.enabled:  # it stands on the floor
            self._let_go(now_us)
            return
        if not robot.powered or robot.firmware.signals.supervisor.state is not State.FLYING:
            self._flying_since_us = None
        elif self._flying_since_us is None:
            self._flying_since_us = now_us
        elif now_us - self._flying_since_us >= HOLD_US:
            self._let_go(now_us)


@dataclass(frozen=True, slots=True)
class Endpoints:
    """What to open to clients; ports are those of robot 1, 0: any."""

    udp: int | None = None
    radio: int | None = None
    mavlink: Sequence[Address] = ()  # of all robots
    station: str | None = None  # what the built-in ground station sends: corrections, poses
    motive: bool = False


@dataclass(frozen=True, slots=True)
class OpenEndpoints:
    """Where clients find a robot; what is not open is empty or 0."""

    radio: str  # its URI
    dongles: int  # the port of its Crazyradios
    udp: str  # its URI
    mavlink: str  # the name for MAVProxy


@dataclass(frozen=True, slots=True)
class Service:
    """What to serve: robot `number` of a swarm of a profile's robots, and its faults.

    Each robot has its own place, radio address, seed and MAVLink system. `faults` act from its first release on. The
    folder `state` stores the EEPROMs; `executor` executes the firmware.
    """

    config: LabConfig
    number: int = 1
    seed: int = 1  # of robot 1; the next robots have the next seeds
    mavlink: bool = False
    faults: Sequence[Fault] = ()
    state: Path | None = None
    executor: Executor = PYTHON_BOARD


class Server:
    """Releases a robot when it flies and puts it back when it is lost; serve it to clients, then `run`.

    `say` gets lines for the user, `observer` sees the robot, `to_peers` gets the board's packets to those of other robots,
    with which it shares `room`.
    """

    def __init__(
        self,
        plan: Service,
        say: Callable[[str], None],
        observer: Observer | None = None,
        to_peers: ToPeers = lambda *_: None,
        room: SharedRoom | None = None,
    ) -> None:
        number, config = plan.number, plan.config
        config = config.model_copy(update={"flight": config.flight.beside(number)})
        if plan.mavlink:
            config = with_system(config, config.mavlink.system + number - 1)
        room = room or SharedRoom(config)
        self.clock = Paced(room.pauses, number - 1)
        self.lab = Laboratory(self.clock)
        self.number = number
        self._plan, self._say, self._observer = plan, say, observer
        self._planned = False  # its faults
        streams = Streams.of_seed(plan.seed + number - 1)
        site = Site(config, self.lab.events, streams, self._note, plan.executor)
        self.served = ServedRobot(number, site, say, plan.mavlink, plan.state, self._fail, to_peers)
        robot = self.robot = self.served.robot
        self.lab.add(robot)
        room.join(number, robot)
        self.switchboard = Switchboard(robot)
        self._clamp = LaunchClamp(robot, self._let_go)
        robot.watch(0)
        self._shown = None if observer is None else self._shown_to(observer)
        self.lab.events.every(RECORD_PERIOD_US, RECORD_PHASE_US, self._look)

    def _shown_to(self, observer: Observer) -> Recorder:
        """Return what passes the robot's rows on, with home as its goal: the clients' goals are unknown here."""
        robot = self.robot
        if robot.firmware.flashed is None:
            # A fault may add this task later, but the columns must include all tasks.
            robot.thief.share = 0.0
        home = Hold(Goal(robot.config.flight.home, 0.0))
        metadata = {
            "request": json.dumps({"experiment": "served"}),
            "config": robot.config.model_dump_json(),
            "look": json.dumps(robot.body.look.stored()),
        }

        def channels() -> tuple[Channel, ...]:
            return flight_channels(robot, home, self.served.channels())

        recorder = Recorder(None, channels(), metadata, observer)
        robot.on_boot(lambda: recorder.read_from(channels()))
        return recorder

    def open(self, endpoints: Endpoints, others: Sequence[int] = ()) -> OpenEndpoints:
        """Open the robot to clients; `others` are the ports of the other robots' Crazyradios. Raises `LabError`."""
        served, readers, later = self.served, self.clock.readers, self.number - 1
        dongles, udp, mavlink = 0, "", ""
        if endpoints.radio is not None:
            port = 0 if later else endpoints.radio
            dongles = served.serve_radio(port, readers, others, self.clock.standstill_us)
        if endpoints.udp is not None:
            udp = served.serve_udp(endpoints.udp and endpoints.udp + later, readers)
        if endpoints.mavlink:
            mavlink = served.serve_mavlink(endpoints.mavlink[later], readers)
        if endpoints.station is not None:
            fly_built_in(self.robot, endpoints.station == "poses")
        return OpenEndpoints(served.uri, dongles, udp, mavlink)

    def hear_peer(self, settings: AirSettings, packet: bytes) -> None:
        """Let the board hear a packet of another robot's board."""
        self.served.nrf51.hear_peer(self.lab.now_us, settings, packet)

    def close(self) -> None:
        """Close what is open to clients."""
        self.served.close()

    def run(self, stopping: Callable[[], bool]) -> None:
        """Run until `stopping` returns true; may be called again."""

        def progress(now_us: int) -> None:
            for line in self.clock.notices() if self.number == 1 else ():  # all clocks stand still together
                self._say(line)
            if stopping():
                self.lab.stop()

        self.lab.end_at(NEVER_US)
        self.lab.run(progress)

    def _note(self, source: str, text: str) -> None:
        self._say(f"board {self.number}: {text}")
        if self._observer is not None:
            self._observer.note(self.lab.now_us, source, text)

    def _fail(self, now_us: int, unit: int, failing: int, instance: int) -> CommandResult:
        return Failures(self.robot, self.switchboard).inject(now_us, unit, failing, instance)

    def _let_go(self, now_us: int) -> None:
        self.robot.release()
        self._note("lab", "released")
        if not self._planned:
            self.switchboard.plan(self._plan.faults, now_us, NEVER_US)
        self._planned = True

    def _look(self, now_us: int) -> None:
        robot, nrf51 = self.robot, self.served.nrf51
        lost = robot.advance_truth(now_us)
        self.served.keep()
        if self._shown is not None:
            self._shown.row(now_us)
        if nrf51.power in (Power.OFF, Power.BOOTLOADER) and now_us - nrf51.heard_us > BUTTON_US:
            robot.note("lab", "power button pressed")
            nrf51.press_button(now_us)
        if robot.powered:
            try:
                robot.firmware.check_watchdog()
            except WatchdogError as error:
                robot.note("lab", str(error))
                self.served.start(now_us)
        if lost is not None and robot.free:
            robot.note("lab", f"lost: {lost}; it is put back")
            self._clamp.put_back_later(now_us)
