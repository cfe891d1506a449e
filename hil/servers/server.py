"""Serves robots to real clients: one laboratory follows the wall clock and answers sockets in between."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from firmware_py.rtos import WatchdogError
from firmware_py.wire.mavlink_numbers import CommandResult
from ground_station.trajectory import Goal, Hold
from hil.clock import Paced, Readers
from hil.config import LabConfig
from hil.crazyflie.nrf51 import Band, Power
from hil.devices.board_firmware import Executor
from hil.devices.dongle import VirtualDongle
from hil.devices.markers import NO_POINTS
from hil.errors import LabError
from hil.laboratory.channels import (
    battery_channel,
    board_channels,
    flight_channels,
    marker_channel,
    radio_channel,
    serial_channel,
)
from hil.laboratory.faults import Fault, Switchboard
from hil.laboratory.flight import RECORD_PERIOD_US, RECORD_PHASE_US
from hil.laboratory.laboratory import NEVER_US, Laboratory
from hil.laboratory.recorder import Onlooker, Recorder
from hil.laboratory.robot import PYTHON_BOARD, Site, Streams, with_system
from hil.servers.dongle_server import DongleServer
from hil.servers.failures import Failures
from hil.servers.holder import Holder
from hil.servers.motive import Streaming, VirtualMotive
from hil.servers.serial_server import Address
from hil.servers.served_robot import ServedRobot
from hil.world.body import Channel

DONGLE_SEED = 10_000  # random streams of dongles: separate from those of the robots
# Of each USB transfer: cflib and the dongle's socket, unpaced, reach 4500 exchanges per second.
HOST_SHARE_US = 110
BUTTON_US = 5_000_000  # off, or in the bootloader without a client: then the button is pressed


class Ends:
    """The connections of a laboratory's robots; open those you need, `close` at the end."""

    def __init__(self, lab: Laboratory, readers: Readers, config: LabConfig, seed: int) -> None:
        self.robots: list[ServedRobot] = []
        self.motive: VirtualMotive | None = None
        self._lab = lab
        self._readers = readers
        self._config = config
        self._seed = seed + DONGLE_SEED
        self.band = Band(lab.events, Streams.of_seed(self._seed).radio.random)
        self._dongles: DongleServer | None = None

    def serve_radio(self, port: int) -> str:
        """Offer Crazyradios on a port (0: any); returns the address for FLOATY_DONGLE."""
        self._dongles = DongleServer(port, self._readers, self._new_dongle)
        return self._dongles.address

    def serve_udp(self, port: int) -> list[str]:
        """Offer every robot on UDP, from this port on; return their URIs."""
        return [
            robot.serve_udp(port + robot.number - 1 if port else 0, self._readers) for robot in self.robots
        ]

    def serve_mavlink(self, addresses: Sequence[Address]) -> list[str]:
        """Open the serial line of every robot; return their names for MAVProxy."""
        try:
            return [
                robot.serve_mavlink(address, self._readers)
                for robot, address in zip(self.robots, addresses, strict=True)
            ]
        except LabError:
            self.close()
            raise

    def serve_motive(self, settings: Streaming) -> VirtualMotive:
        """Stream every robot from Motive, under its number."""
        names = {robot.number: name_of(robot.number) for robot in self.robots}
        markers = self.robots[0].robot.body.markers.places if self._config.markers.enabled else NO_POINTS
        self.motive = VirtualMotive(settings, names, self._readers, markers)
        for served in self.robots:
            served.robot.seen_by(partial(self.motive.take, served.number))
        return self.motive

    def close(self) -> None:
        for robot in self.robots:
            robot.close()
        if self._dongles is not None:
            self._dongles.close()
        if self.motive is not None:
            self.motive.close()

    def _new_dongle(self) -> VirtualDongle:
        """Return a dongle at a real host, which takes real time in every exchange."""
        self._seed += 1
        rng = Streams.of_seed(self._seed).radio
        radio = self._config.radio
        at_real_host = radio.model_copy(
            update={"usb_us": max(0, radio.usb_us - HOST_SHARE_US), "usb_jitter_us": 0}
        )
        return VirtualDongle(at_real_host, self._lab.events, rng, self.band.boards)


def name_of(number: int) -> str:
    """Return Motive's name for a body."""
    return "floaty" if number == 1 else f"floaty{number}"


class Shown:
    """Shows a served robot to onlookers, with home as its goal: the clients' goals are unknown here."""

    def __init__(self, served: ServedRobot, onlooker: Onlooker) -> None:
        self._served = served
        if served.robot.firmware.flashed is None:
            # A fault may add this task later, but the columns must include all tasks.
            served.robot.thief.share = 0.0
        self._firmware = served.robot.firmware
        config = served.robot.config
        metadata = {
            "request": json.dumps({"experiment": "served"}),
            "config": config.model_dump_json(),
            "look": json.dumps(served.robot.body.look.stored()),
        }
        self._recorder = Recorder(None, self._channels(), metadata, onlooker)

    def row(self, now_us: int) -> None:
        """Take a sample of it."""
        if self._served.robot.firmware is not self._firmware:  # it has booted
            self._firmware = self._served.robot.firmware
            self._recorder.read_from(self._channels())
        self._recorder.row(now_us)

    def _channels(self) -> tuple[Channel, ...]:
        robot = self._served.robot
        if robot.uart is not None:
            line = serial_channel(robot.uart, robot.firmware, None)
        else:
            line = radio_channel(self._served.udp_radio)
        home = Hold(Goal(robot.config.flight.home, 0.0))
        markers = (marker_channel(robot.mocap),) if robot.mocap.markers else ()
        own = board_channels(robot.firmware)
        return (*flight_channels(robot, home), line, battery_channel(robot.battery), *markers, *own)


@dataclass(frozen=True, slots=True)
class Service:
    """What to serve: `count` robots of a profile, and their faults.

    `faults` act from the first release of each robot on. The folder `state` stores EEPROM and deck memories; `executor`
    executes the firmware.
    """

    config: LabConfig
    count: int = 1
    seed: int = 1
    mavlink: bool = False
    faults: Sequence[Fault] = ()
    state: Path | None = None
    executor: Executor = PYTHON_BOARD


class Server:
    """Releases robots when they fly and returns lost ones; open ends, then `run`.

    `say` gets lines for the user, `onlooker` sees the first robot.
    """

    def __init__(self, plan: Service, say: Callable[[str], None], onlooker: Onlooker | None = None) -> None:
        config = plan.config
        self.clock = Paced()
        self.lab = Laboratory(self.clock)
        self.ends = Ends(self.lab, self.clock.readers, config, plan.seed)
        self.switchboards: list[Switchboard] = []
        self._plan, self._say, self._onlooker = plan, say, onlooker
        self._shown: Shown | None = None
        for number in range(1, plan.count + 1):
            own = config.model_copy(update={"flight": config.flight.beside(number)})
            own = with_system(own, config.mavlink.system + number - 1) if plan.mavlink else own
            self._add(number, own, Streams.of_seed(plan.seed + number - 1))

    def _add(self, number: int, config: LabConfig, streams: Streams) -> None:
        def say(source: str, text: str) -> None:
            self._say(f"board {number}: {text}")
            if number == 1 and self._onlooker is not None:
                self._onlooker.note(self.lab.now_us, source, text)

        def fail(now_us: int, unit: int, failing: int, instance: int) -> CommandResult:
            return Failures(robot, switchboard).inject(now_us, unit, failing, instance)

        site = Site(config, self.lab.events, streams, say, self._plan.executor)
        served = ServedRobot(
            number, site, self._say, self._plan.mavlink, self._plan.state, fail, self.ends.band
        )
        robot = served.robot
        robot.body.hold()
        self.lab.robots.append(robot)
        self.ends.robots.append(served)
        switchboard = Switchboard(robot)
        self.switchboards.append(switchboard)
        planned = False

        def let_go(now_us: int) -> None:
            nonlocal planned
            robot.release()
            say("lab", "released")
            if not planned:
                switchboard.plan(self._plan.faults, now_us, NEVER_US)
            planned = True

        holder = Holder(robot, let_go)
        robot.watch(0)
        if number == 1 and self._onlooker is not None:
            self._shown = Shown(served, self._onlooker)
        self.lab.events.every(RECORD_PERIOD_US, RECORD_PHASE_US, partial(self._look, served, holder))

    def run(self, stopping: Callable[[], bool]) -> None:
        """Run until `stopping` returns true; may be called again."""

        def progress(now_us: int) -> None:
            for line in self.clock.notices():
                self._say(line)
            if stopping():
                self.lab.stop()

        self.lab.end_at(NEVER_US)
        self.lab.run(progress)

    def _look(self, served: ServedRobot, holder: Holder, now_us: int) -> None:
        robot, nrf51 = served.robot, served.nrf51
        lost = robot.look(now_us)
        served.keep()
        if self._shown is not None and served.number == 1:
            self._shown.row(now_us)
        if nrf51.power in (Power.OFF, Power.BOOTLOADER) and now_us - nrf51.heard_us > BUTTON_US:
            robot.say("lab", "power button pressed")
            nrf51.press_button(now_us)
        if robot.powered:
            try:
                robot.firmware.check_watchdog()
            except WatchdogError as error:
                robot.say("lab", str(error))
                served.start(now_us)
        if lost is not None and robot.free:
            robot.say("lab", f"lost: {lost}; it is put back")
            holder.put_back_later(now_us)
