"""A robot for clients outside: its radio chip with the power switch, dongles, its UDP port, the far end of its serial line.

Its EEPROM survives a restart of the server, in a file of a folder.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from firmware_py.wire import WireError
from firmware_py.wire.memories import CONFIG_SIZE, decode_config
from hil.board.clock import Readers
from hil.board.dongle import VirtualDongle
from hil.board.eeprom import address_of, factory_config
from hil.board.image_settings import APP_PARAMETER, NO_APP, stock_contents
from hil.board.pins import InjectFailure, new_eeprom, unsupported
from hil.board.radio import VirtualRadio
from hil.board.uart import VirtualSerial
from hil.emulator.crazyflie.nrf51 import RATES, AirSettings, Band, Nrf51, ToPeers
from hil.emulator.crazyflie.radio_line import POLL_PERIOD_US
from hil.emulator.crazyflie.shockburst import Air
from hil.errors import LabError
from hil.laboratory.channels import radio_channel, serial_channel
from hil.laboratory.files.whole_files import replacing
from hil.laboratory.robot import Ports, Robot, Site
from hil.servers.dongle_server import DongleServer
from hil.servers.serial_server import Address, Endpoint
from hil.servers.udp_server import UdpServer
from hil.world.body import Channel


class BoardFile:
    """`board-N.eeprom` is the bare bytes; `load` before the board boots, `keep` now and then."""

    def __init__(self, folder: Path, number: int, eeprom: bytearray) -> None:
        self._path, self._eeprom, self._kept = folder / f"board-{number}.eeprom", eeprom, b""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LabError(f"--state {folder}: {error.strerror}") from None

    def load(self) -> None:
        """Load the stored EEPROM. Raises `LabError` for a file that is none."""
        try:
            content = self._path.read_bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            raise LabError(f"{self._path}: {error.strerror}") from None
        if len(content) != len(self._eeprom):
            raise LabError(f"{self._path}: {len(content)} bytes; this memory has {len(self._eeprom)}")
        self._eeprom[:] = self._kept = content

    def keep(self) -> None:
        """Write a changed EEPROM; the file is never half written."""
        if self._eeprom == self._kept:
            return
        self._kept = bytes(self._eeprom)
        try:
            with replacing(self._path) as partial:
                partial.write_bytes(self._kept)
        except OSError as error:
            raise LabError(f"{self._path}: {error.strerror}") from None


RATE_NAMES = ("250K", "1M", "2M")  # in a URI
UDP_RETRY_US = 500_000
STAYS_US = 1_000_000  # a radio's new setting is reported once it has stayed this long
UDP_QUEUE = 1000  # packets of a program waiting at the host: cflib does not repeat over UDP


# Of each USB transfer: cflib and the dongle's socket, unpaced, reach 4500 exchanges per second.
HOST_SHARE_US = 110


class ServedRobot:
    """One robot and its connections; it is the `PoweredProcessor` of its radio chip, and boots the robot."""

    def __init__(
        self,
        number: int,
        site: Site,
        say: Callable[[str], None],
        mavlink: bool = False,
        state: Path | None = None,
        fail: InjectFailure = unsupported,
        to_peers: ToPeers = lambda *_: None,
    ) -> None:
        config, events, rng = site.config, site.events, site.streams.radio
        self._rng = rng
        eeprom = self._eeprom = new_eeprom()
        air, wire_us = Air.of(config.radio), site.executor.wire_us
        uart = VirtualSerial(config.serial, events, site.streams.serial) if mavlink else None
        self.number = number
        self.udp: UdpServer | None = None
        self._say = say
        self._udp_awaited = False  # another program has the port
        self._line_end: Endpoint | None = None
        self._dongles: DongleServer | None = None
        patient = config.radio.model_copy(update={"uplink_queue": UDP_QUEUE})
        self.udp_radio = VirtualRadio(patient, events, rng, air, wire_us)
        radio = config.radio
        settings = AirSettings(radio.channel, radio.bits_per_second, address_of(number, radio.address))
        chip = bytes((number, 0x10, 0xA7, 0xF1, 0x0A, 0xC0))
        band = Band(events, rng.random, to_peers)
        self.nrf51 = Nrf51(settings, chip, config.radio.downlink_queue, band, self, air, wire_us)
        eeprom[:CONFIG_SIZE] = factory_config(number, radio)
        self._file = BoardFile(state, number, eeprom) if state is not None else None
        if self._file is not None:
            self._file.load()
        self.nrf51.tune(self._settings_at_boot())
        self.robot = Robot(
            site, Ports(self._send, air, uart, True, self.start, self.nrf51.command, fail, eeprom)
        )
        self.udp_radio.connect(self.robot.packet_received, self._to_udp)
        if uart is not None:
            uart.connect(self.robot.uart_ready, self._from_line)
        self.nrf51.bootloader.load(self.robot.executor.in_flash)
        self._report_image()

    def _report_image(self) -> None:
        """Report what is known of the image; raises `LabError` for one that does not fit the profile."""
        flashed, config, say = self.robot.firmware.flashed, self.robot.config, self._say
        for text in flashed.notes if flashed is not None else ():
            say(text)
        if flashed is not None and config.pilot.enabled:
            stock_contents(flashed.parameters, self.robot.firmware.log_numbers, config.pilot)
        elif flashed is not None and APP_PARAMETER not in flashed.parameters:
            say(NO_APP)
        elif flashed is not None and (stays := flashed.differences(config)):
            say(f"the image has its own {stays}")

    def channels(self) -> tuple[Channel, ...]:
        """Return the counters of its serial line, else of its radio over UDP."""
        uart = self.robot.uart
        return (serial_channel(uart, self.robot.firmware, None) if uart else radio_channel(self.udp_radio),)

    @property
    def uri(self) -> str:
        """Its radio URI for cflib."""
        radio = self.nrf51.settings
        rate = RATE_NAMES[RATES.index(radio.bits_per_second)]
        return f"radio://0/{radio.channel}/{rate}/{radio.address.hex().upper()}"

    def serve_radio(
        self,
        port: int,
        readers: Readers,
        others: Sequence[int] = (),
        stood_still_us: Callable[[int], int] = lambda now_us: 0,
    ) -> int:
        """Offer Crazyradios on a port (0: any), which also reach the robots on the ports `others`; return the port.

        Programs sleep longer by what `stood_still_us` returns more at the end.
        """
        self._dongles = DongleServer(port, readers, self._new_dongle, self._report, others, stood_still_us)
        return self._dongles.port

    def _report(self, text: str) -> None:
        self._say(f"board {self.number}: {text}")

    def _new_dongle(self) -> VirtualDongle:
        """Return a dongle at a real host, which takes real time in every exchange."""
        radio = self.robot.config.radio
        at_real_host = radio.model_copy(
            update={"usb_us": max(0, radio.usb_us - HOST_SHARE_US), "usb_jitter_us": 0}
        )
        (rng,) = self._rng.spawn(1)
        return VirtualDongle(at_real_host, self.robot.events, rng, self.nrf51)

    def serve_udp(self, port: int, readers: Readers) -> str:
        """Serve it over UDP, too; return the URI."""
        self.udp = UdpServer(port, readers, self.udp_radio.uplink, self._report)
        if self.robot.executor.needs_polls:
            self.robot.events.every(POLL_PERIOD_US, self.robot.events.now_us, self._poll)
        return f"udp://127.0.0.1:{self.udp.port}"

    def _poll(self, now_us: int) -> None:
        """Fetch an image's packets, as a dongle would for a client on UDP: its polls are not modelled."""
        if self.udp is not None and self.udp.has_session(now_us):
            self.robot.polled(now_us)

    def serve_mavlink(self, address: Address, readers: Readers) -> str:
        """Open the serial line; return its name for MAVProxy. Only for a robot with a UART."""
        assert self.robot.uart is not None
        self._line_end = address.open(readers, self.robot.uart.uplink, self._report)
        return self._line_end.master

    def keep(self) -> None:
        """Write the memories that survive a restart of the server."""
        if self._file is not None:
            self._file.keep()

    def close(self) -> None:
        """Close the connections to clients."""
        self.keep()
        if self.udp is not None:
            self.udp.close()
        if self._line_end is not None:
            self._line_end.close()
            self._line_end = None
        if self._dongles is not None:
            self._dongles.close()

    # Processor

    @property
    def battery_V(self) -> float:
        return self.robot.board.battery_mv * 1e-3

    def start(self, now_us: int) -> None:
        self.nrf51.tune(self._settings_at_boot())
        if not self._boot_flashed(now_us):
            self.robot.boot(now_us)
        self._open_udp(now_us)

    def _boot_flashed(self, now_us: int) -> bool:
        """Start the image that was flashed since the last start; return whether there was one that can run."""
        before, flash = self.robot.executor, self.nrf51.bootloader.take_written()
        try:
            executor = before.flashed_with(flash) if flash else before
            if executor is before:
                return False
            self.robot.execute(executor)
            self.robot.boot(now_us)
            self._report_image()
        except LabError as error:
            self._report(f"the flashed image cannot run: {error}; the one before it starts instead")
            self.robot.execute(before)
            return False
        self._report("starts the flashed image")
        return True

    def stop(self, now_us: int) -> None:
        """Lose power: clients get no answers."""
        self.robot.cut_power()
        if self.udp is not None:
            self.udp.close()

    def greet(self, now_us: int) -> None:
        """Switch to the radio: its client is newer than that on UDP."""
        if self.udp is not None:
            self.udp.end_session()

    def received(self, now_us: int, data: bytes, broadcast: bool) -> None:
        self.robot.packet_received(now_us, data, broadcast)

    def polled(self, now_us: int) -> None:
        self.robot.polled(now_us)

    def retuned(self, now_us: int) -> None:
        """Report the radio's setting once it is stable: a scanning program changes it a hundred times."""
        settings = self.nrf51.settings

        def report(now_us: int) -> None:
            if self.nrf51.settings is not settings:
                return
            where = f"a client moved the radio to {self.uri}; restart moves it back"
            if settings == self._settings_at_boot():
                where = f"a client moved the radio back to {self.uri}"
            self._say(f"board {self.number}: {where}")

        self.robot.events.at(now_us + STAYS_US, report)

    def _open_udp(self, now_us: int) -> None:
        """Listen again; if another program took the port while the board was off, try until it is free."""
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

    def _settings_at_boot(self) -> AirSettings:
        """Return the radio setting at boot, from the configuration block; unchanged without a valid one."""
        try:
            block = decode_config(bytes(self._eeprom[:CONFIG_SIZE]))
            return AirSettings(block.channel, RATES[block.data_rate], block.address.to_bytes(5))
        except (WireError, IndexError):
            return self.nrf51.settings

    # Packets of the board

    def _send(self, now_us: int, data: bytes) -> bool:
        """Send a packet of the firmware to its client: the UDP session if there is one, else the radio."""
        if self.udp is not None and self.udp.has_session(now_us):
            return self.udp_radio.downlink(now_us, data)
        return self.nrf51.send(now_us, data)

    def _to_udp(self, now_us: int, data: bytes) -> None:
        if self.udp is not None:
            self.udp.send(data)

    def _from_line(self, now_us: int, data: bytes) -> None:
        if self._line_end is not None:
            self._line_end.send(data)
