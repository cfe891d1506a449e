"""A robot for clients outside: its radio chip with the power switch, its UDP port, the far end of its serial line."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from firmware_py.wire import WireError
from firmware_py.wire.memories import CONFIG_SIZE, decode_config, encode_config
from firmware_py.wire.memories import RadioSettings as EepromSettings
from ground_station.links.loopback import LoopbackLink
from ground_station.station import GroundStation
from ground_station.tracker import tracker_of
from ground_station.trajectory import Goal, Hold
from hil.clock import Readers
from hil.devices.nrf51 import RATES, Nrf51, RadioSettings
from hil.devices.radio import VirtualRadio
from hil.devices.stm32f405.firmware import POLL_PERIOD_US, ImageFirmware
from hil.errors import LabError
from hil.laboratory.robot import Robot
from hil.servers.board_files import BoardFiles
from hil.servers.serial_server import Address, Endpoint
from hil.servers.udp_server import UdpServer

CHANNEL = 80
RATE_NAMES = ("250K", "1M", "2M")  # in a URI
UDP_RETRY_US = 500_000
UDP_QUEUE = 1000  # packets of a program that wait at the host: cflib does not repeat over UDP


def address_of(number: int) -> bytes:
    """Radio address of board 1, 2, ...: the Crazyflie's default, then E7E7E7E702 and on."""
    return bytes((0xE7, 0xE7, 0xE7, 0xE7, 0xE7 if number == 1 else number))


class _Wire(LoopbackLink):
    """Carries corrections only: telemetry belongs to the clients."""

    def start_telemetry(self, now_us: int) -> None:
        """Nothing."""


class ServedRobot:
    """One robot and its ends; it implements `hil.devices.nrf51.Processor` towards its radio chip, and boots the robot."""

    def __init__(
        self,
        number: int,
        robot: Robot,
        rng: np.random.Generator,
        say: Callable[[str], None],
        state: Path | None = None,
    ) -> None:
        config, events = robot.config, robot.events
        assert robot.air is not None
        self.number = number
        self.robot = robot
        self.udp: UdpServer | None = None
        self._say = say
        self._udp_awaited = False  # somebody else has the port
        self._line_end: Endpoint | None = None
        if robot.uart is not None:
            robot.uart.connect(robot.uart_ready, self._from_line)
        patient = config.radio.model_copy(update={"uplink_queue": UDP_QUEUE})
        self.udp_radio = VirtualRadio(patient, events, rng, robot.air, robot.wire_us)
        self.udp_radio.connect(robot.packet_received, self._to_udp)
        settings = RadioSettings(CHANNEL, config.radio.bits_per_second, address_of(number))
        chip = bytes((number, 0x10, 0xA7, 0xF1, 0x0A, 0xC0))
        self.nrf51 = Nrf51(
            settings, chip, config.radio.downlink_queue, events, self, robot.air, robot.wire_us
        )
        robot.send_packet = self._send
        robot.polled_by_host = True
        robot.restart = self.start
        robot.board.eeprom[:CONFIG_SIZE] = self._factory_config()
        self._files = BoardFiles(state, number, robot.board) if state is not None else None
        if self._files is not None:
            self._files.load()
        self.start(0)
        if isinstance(robot.firmware, ImageFirmware) and (stays := robot.firmware.differences(config)):
            say(f"the image has its own {stays}")

    @property
    def uri(self) -> str:
        """Where cflib finds it on the radio."""
        radio = self.nrf51.settings
        rate = RATE_NAMES[RATES.index(radio.bits_per_second)]
        return f"radio://0/{radio.channel}/{rate}/{radio.address.hex().upper()}"

    def serve_udp(self, port: int, readers: Readers) -> str:
        """Be reachable over UDP, too; returns the URI."""
        self.udp = UdpServer(port, readers, self.udp_radio.uplink)
        if self.robot.executes_image:
            self.robot.events.every(POLL_PERIOD_US, self.robot.events.now_us, self._poll)
        return f"udp://127.0.0.1:{self.udp.port}"

    def _poll(self, now_us: int) -> None:
        """Fetch what an image has to say, as the dongle of a client on UDP would: no poll of it is modelled."""
        if self.udp is not None and self.udp.has_session(now_us):
            self.robot.polled(now_us)

    def serve_mavlink(self, address: Address, readers: Readers) -> str:
        """Lead the serial line out; returns what MAVProxy calls its end. Only for a robot with a UART."""
        assert self.robot.uart is not None
        self._line_end = address.open(readers, self.robot.uart.uplink)
        return self._line_end.master

    def keep(self) -> None:
        """Write down what survives a restart of the server."""
        if self._files is not None:
            self._files.keep()

    def close(self) -> None:
        """Close what was opened for clients."""
        self.keep()
        if self.udp is not None:
            self.udp.close()
        if self._line_end is not None:
            self._line_end.close()
            self._line_end = None

    def fly(self) -> None:
        """Fly at home with a ground station of its own, on a wire that no client sees."""
        config = self.robot.config
        link = _Wire(self._wire, config.station.link_latency_us)
        tracker = tracker_of(config.tracker, config.mocap.period_us)
        home = Hold(Goal(config.flight.home, 0.0))
        ground = GroundStation(link, home, None, config.station, tracker)
        self.robot.seen_by(lambda frame, now_us, _: ground.on_frame(frame, now_us))

    def _wire(self, now_us: int, data: bytes) -> None:
        def arrive(now_us: int) -> None:
            self.robot.packet_received(now_us, data)

        self.robot.events.at(now_us + self.robot.config.station.link_latency_us, arrive)

    # Processor

    @property
    def battery_V(self) -> float:
        """Supply voltage."""
        return self.robot.board.battery_mv * 1e-3

    def start(self, now_us: int) -> None:
        """Boot the firmware."""
        self._tune()
        self.robot.boot(now_us)
        self._open_udp(now_us)

    def stop(self, now_us: int) -> None:
        """Lose power: clients get no answers."""
        self.robot.cut_power()
        if self.udp is not None:
            self.udp.close()

    def greet(self, now_us: int) -> None:
        """Talk to the radio from now on: its client is newer than that on UDP."""
        if self.udp is not None:
            self.udp.end_session()

    def received(self, now_us: int, data: bytes, broadcast: bool) -> None:
        """Take a packet from the radio chip."""
        self.robot.packet_received(now_us, data, broadcast)

    def polled(self, now_us: int) -> None:
        """Notice an empty packet from the radio chip."""
        self.robot.polled(now_us)

    def _open_udp(self, now_us: int) -> None:
        """Listen again; while the board was off, another program may have taken the port: then try until it is free."""
        if self.udp is None or not self.robot.powered:
            return
        try:
            self.udp.open()
        except LabError as error:
            if not self._udp_awaited:
                self._say(f"board {self.number}: {error}; trying again")
            self._udp_awaited = True
            self.robot.events.at(now_us + UDP_RETRY_US, self._open_udp)
            return
        if self._udp_awaited:
            self._udp_awaited = False
            self._say(f"board {self.number}: udp port {self.udp.port} is open again")

    def _factory_config(self) -> bytes:
        """Return the configuration block with this board's own address and the profile's data rate."""
        rate = RATES.index(self.robot.config.radio.bits_per_second)
        return encode_config(EepromSettings(CHANNEL, rate, int.from_bytes(address_of(self.number))))

    def _tune(self) -> None:
        """Set the radio to what the configuration block says, as the firmware does at boot; keep it when that is none."""
        with suppress(WireError, IndexError):
            block = decode_config(bytes(self.robot.board.eeprom[:CONFIG_SIZE]))
            address = block.address.to_bytes(5)
            self.nrf51.settings = RadioSettings(block.channel, RATES[block.data_rate], address)

    # Packets of the board

    def _send(self, now_us: int, data: bytes) -> bool:
        """Send a packet of the firmware to who talked to it: the UDP session if there is one, else the radio."""
        if self.udp is not None and self.udp.has_session(now_us):
            return self.udp_radio.downlink(now_us, data)
        return self.nrf51.send(now_us, data)

    def _to_udp(self, now_us: int, data: bytes) -> None:
        if self.udp is not None:
            self.udp.send(data)

    def _from_line(self, now_us: int, data: bytes) -> None:
        if self._line_end is not None:
            self._line_end.send(data)
