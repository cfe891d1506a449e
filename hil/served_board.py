"""A board in its own virtual tunnel, for clients outside: powered by its radio chip, rebooted, flown and put back.

The robot is held at home until the firmware has flown it in the holder for a second, then released. When it is lost
(no corrections, a bad controller) it is put back after a second; when it is off, or left in its bootloader, somebody
presses its power button after five. The firmware's clock begins at its boot; every other time here is the server's.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import partial

from firmware_py.firmware import Firmware
from firmware_py.wire import WireError
from firmware_py.wire.memories import CONFIG_SIZE, decode_config, encode_config
from firmware_py.wire.memories import RadioSettings as EepromSettings
from ground_station.links.loopback import LoopbackLink
from ground_station.mocap import MocapFrame
from ground_station.station import GroundStation
from ground_station.tracker import tracker_of
from ground_station.trajectory import Goal, Hold
from hil.config import LabConfig
from hil.dongle_server import Readers
from hil.errors import LabError
from hil.events import EventQueue
from hil.harness import IMU_PERIOD_US, Streams
from hil.markers import Sighting, make_markers
from hil.nrf51 import Nrf51, Power, RadioSettings
from hil.plant.plant import Plant
from hil.serial_server import Address, Endpoint
from hil.udp_server import UdpServer
from hil.virtual_board import VirtualBoard
from hil.virtual_imu import VirtualImu
from hil.virtual_mocap import VirtualMocap
from hil.virtual_serial import VirtualSerial

CHANNEL = 80
RATES = (250_000, 1_000_000, 2_000_000)  # by number in the configuration block
RATE_NAMES = ("250K", "1M", "2M")  # in a URI
HOLD_US = 1_000_000  # flying in the holder before the release
BUTTON_US = 5_000_000  # off, or in the bootloader with nobody talking to it: then somebody presses the button
PUT_BACK_US = 1_000_000  # after a loss
WATCH_PERIOD_US = 100_000
UDP_RETRY_US = 500_000
MAX_SYSTEM = 255  # MAVLink
FLYING = "FLYING"  # the supervisor's state

Publish = Callable[[MocapFrame, int], None]  # (frame, now_us)
Show = Callable[[MocapFrame, int, Sighting | None], None]  # with what was seen of the markers


def address_of(number: int) -> bytes:
    """Radio address of board 1, 2, ...: the Crazyflie's default, then E7E7E7E702 and on."""
    return bytes((0xE7, 0xE7, 0xE7, 0xE7, 0xE7 if number == 1 else number))


class _Wire(LoopbackLink):
    """Carries corrections only: telemetry belongs to the clients."""

    def start_telemetry(self, now_us: int) -> None:
        """Nothing."""


class _Uart:
    """The board's end of a serial line that lives on the server's clock."""

    def __init__(self, line: VirtualSerial, events: EventQueue) -> None:
        self._line = line
        self._events = events
        self.read = line.read
        self.read()  # a booted processor begins empty

    @property
    def overruns(self) -> int:
        return self._line.overruns

    def write(self, local_us: int, data: bytes) -> bool:
        """Send bytes, now: a board that catches up is some microseconds behind."""
        return self._line.write(self._events.now_us, data)


class ServedBoard:
    """One robot; it implements `hil.nrf51.Processor` towards its radio chip."""

    def __init__(
        self,
        number: int,
        config: LabConfig,
        events: EventQueue,
        streams: Streams,
        say: Callable[[str], None],
        mavlink: bool = False,
    ) -> None:
        self.number = number
        self.free = False
        self.udp: UdpServer | None = None
        self._udp_awaited = False  # somebody else has the port
        self._config = _with_system(config, config.mavlink.system + number - 1) if mavlink else config
        self._events = events
        self._say = say
        self._gusts = streams.gusts
        self._imu = VirtualImu(config.imu, streams.imu)
        self._mocap = VirtualMocap(
            config.mocap, streams.mocap, make_markers(config.markers, config.plant, streams.markers)
        )
        self.line = VirtualSerial(config.serial, events, streams.radio) if mavlink else None
        self._line_end: Endpoint | None = None
        if self.line is not None:
            self.line.connect(self._uart_ready, self._from_line)
        self._place(events.now_us)
        settings = RadioSettings(CHANNEL, config.radio.bits_per_second, address_of(number))
        chip = bytes((number, 0x10, 0xA7, 0xF1, 0x0A, 0xC0))
        self.nrf51 = Nrf51(settings, chip, config.radio.downlink_queue, events, self)
        self._firmware: Firmware | None = None
        self._board: VirtualBoard | None = None
        self._boot_us = 0
        self._flying_since_us: int | None = None
        self._show: list[Show] = []
        self.start(events.now_us)
        events.at(events.now_us + IMU_PERIOD_US, self._sample)
        events.at(events.now_us + config.mocap.period_us, self._expose)
        events.at(events.now_us + WATCH_PERIOD_US, self._watch)

    @property
    def uri(self) -> str:
        """Where cflib finds it on the radio."""
        radio = self.nrf51.settings
        rate = RATE_NAMES[RATES.index(radio.bits_per_second)]
        return f"radio://0/{radio.channel}/{rate}/{radio.address.hex().upper()}"

    def serve_udp(self, port: int, readers: Readers) -> None:
        """Be reachable over UDP, too."""
        self.udp = UdpServer(port, readers, self._events, self.received)

    def serve_mavlink(self, address: Address, readers: Readers) -> str:
        """Lead the serial line out; returns what MAVProxy calls its end. Only for a board made with `mavlink`."""
        assert self.line is not None
        self._line_end = address.open(readers, self.line.uplink)
        return self._line_end.master

    def _from_line(self, now_us: int, data: bytes) -> None:
        if self._line_end is not None:
            self._line_end.send(data)

    def close(self) -> None:
        """Close what was opened for clients."""
        if self.udp is not None:
            self.udp.close()
        if self._line_end is not None:
            self._line_end.close()
            self._line_end = None

    def publish(self, to: Publish) -> None:
        """Hand every mocap frame to `to` when the cameras' computer has it."""
        self.show(lambda frame, now_us, _: to(frame, now_us))

    def show(self, to: Show) -> None:
        """Hand every mocap frame to `to`, likewise, together with its markers."""
        self._show.append(to)

    def fly(self) -> None:
        """Fly at home with a ground station of its own, on a wire that no client sees."""
        config = self._config
        link = _Wire(self._wire, config.station.link_latency_us)
        tracker = tracker_of(config.tracker, config.mocap.period_us)
        home = Hold(Goal(config.flight.home, 0.0))
        ground = GroundStation(link, home, None, config.station, tracker)
        self.publish(ground.on_frame)

    def _wire(self, now_us: int, data: bytes) -> None:
        self._events.at(now_us + self._config.station.link_latency_us, partial(self._from_wire, data))

    def _from_wire(self, data: bytes, now_us: int) -> None:
        self.received(now_us, data)

    # Processor

    @property
    def battery_V(self) -> float:
        """Supply voltage."""
        return self._board.battery_mv * 1e-3 if self._board else 0.0

    def start(self, now_us: int) -> None:
        """Boot the firmware; its clock begins here."""
        self._boot_us = now_us
        board = VirtualBoard(
            lambda t_us, counts: self._plant.set_counts(self._boot_us + t_us - self._placed_us, counts),
            self._radio_send,
            lambda t_us, text: self._say(f"board {self.number}: {text}"),
            _Uart(self.line, self._events) if self.line is not None else None,
        )
        if self._board is not None:  # memories survive, whatever was in the processor does not
            board.eeprom, board.deck_memory = self._board.eeprom, self._board.deck_memory
            board.battery_mv = self._board.battery_mv
        else:
            board.eeprom[:CONFIG_SIZE] = self._factory_config()
        self._tune(board.eeprom)
        self._board = board
        self._firmware = Firmware(self._config, board, mavlink=self.line is not None)
        board.run_on(self._firmware.kernel, EventQueue())
        self._open_udp(now_us)

    def _open_udp(self, now_us: int) -> None:
        """Listen again; while the board was off, another program may have taken the port: then try until it is free."""
        if self.udp is None or self._firmware is None:
            return
        try:
            self.udp.open()
        except LabError as error:
            if not self._udp_awaited:
                self._say(f"board {self.number}: {error}; trying again")
            self._udp_awaited = True
            self._events.at(now_us + UDP_RETRY_US, self._open_udp)
            return
        if self._udp_awaited:
            self._udp_awaited = False
            self._say(f"board {self.number}: udp port {self.udp.port} is open again")

    def _factory_config(self) -> bytes:
        """Return the configuration block with this board's own address and the profile's data rate."""
        rate = RATES.index(self._config.radio.bits_per_second)
        return encode_config(EepromSettings(CHANNEL, rate, int.from_bytes(address_of(self.number))))

    def _tune(self, eeprom: bytearray) -> None:
        """Set the radio to what the configuration block says, as the firmware does at boot; keep it when that is none."""
        with suppress(WireError, IndexError):
            block = decode_config(bytes(eeprom[:CONFIG_SIZE]))
            address = block.address.to_bytes(5)
            self.nrf51.settings = RadioSettings(block.channel, RATES[block.data_rate], address)

    def stop(self, now_us: int) -> None:
        """Lose power: the servos keep their last pulse, clients get no answers."""
        self._firmware = None
        if self.udp is not None:
            self.udp.close()

    def catch_up(self, now_us: int) -> None:
        """Run the firmware by itself up to this instant, before hardware acts."""
        if self._firmware is None:
            return
        kernel, local_us = self._firmware.kernel, now_us - self._boot_us
        if local_us - 1 > kernel.now_us:
            kernel.run(local_us - 1)
        if local_us > kernel.now_us:
            kernel.advance(local_us)

    def greet(self, now_us: int) -> None:
        """Talk to the radio from now on: its client is newer than that on UDP."""
        if self.udp is not None:
            self.udp.end_session()

    def received(self, now_us: int, data: bytes) -> None:
        """Take a packet from radio, UDP or wire."""
        if self._firmware is None:
            return
        self.catch_up(now_us)
        self._firmware.radio_received(data)
        self._firmware.run(now_us - self._boot_us)

    def _uart_ready(self, now_us: int) -> None:
        if self._firmware is None:
            return
        self.catch_up(now_us)
        self._firmware.uart_ready()
        self._firmware.run(now_us - self._boot_us)

    def _radio_send(self, local_us: int, data: bytes) -> bool:
        """Send a packet of the firmware to who talked to it: the UDP session if there is one, else the radio."""
        if self.udp is not None and self.udp.send(self._boot_us + local_us, data):
            return True
        return self.nrf51.send(data)

    def parts(self) -> tuple[Plant, VirtualBoard, Firmware]:
        """Return what can be recorded, until the board reboots or is put back."""
        assert self._board is not None
        assert self._firmware is not None
        return self._plant, self._board, self._firmware

    def look(self, now_us: int) -> str | None:
        """Bring the truth up to this instant; returns why the flight is over, None while it is not."""
        self.catch_up(now_us)
        self._plant.advance(now_us - self._placed_us)
        return self._plant.lost

    # Hardware events

    def _sample(self, now_us: int) -> None:
        self._events.at(now_us + IMU_PERIOD_US, self._sample)
        self.catch_up(now_us)
        self._plant.advance(now_us - self._placed_us)
        if self._firmware is not None and self._board is not None:
            self._board.imu = self._imu.sample(self._plant)
            self._firmware.imu_ready()
            self._firmware.run(now_us - self._boot_us)

    def _expose(self, now_us: int) -> None:
        self._events.at(now_us + self._config.mocap.period_us, self._expose)
        if self._show:
            self.catch_up(now_us)
            self._plant.advance(now_us - self._placed_us)
            frame = self._mocap.expose(now_us, self._plant)
            arrival_us, sighting = self._mocap.arrival_us(now_us), self._mocap.sighting
            frame = self._mocap.stamped(frame, arrival_us)
            self._events.at(arrival_us, partial(self._deliver, frame, sighting))

    def _deliver(self, frame: MocapFrame, sighting: Sighting | None, now_us: int) -> None:
        for show in self._show:
            show(frame, now_us, sighting)

    # Holding and letting go

    def _watch(self, now_us: int) -> None:
        self._events.at(now_us + WATCH_PERIOD_US, self._watch)
        nrf51, firmware = self.nrf51, self._firmware
        if nrf51.power in (Power.OFF, Power.BOOTLOADER) and now_us - nrf51.heard_us > BUTTON_US:
            self._say(f"board {self.number}: power button pressed")
            nrf51.press_button(now_us)
        flying = firmware is not None and firmware.signals.supervisor.state.name == FLYING
        if self.free:
            if (cause := self._plant.lost) is not None:
                self.free = False
                self._say(f"board {self.number}: lost: {cause}; it is put back")
                self._events.at(now_us + PUT_BACK_US, self._put_back)
        elif not flying:
            self._flying_since_us = None
        elif self._flying_since_us is None:
            self._flying_since_us = now_us
        elif now_us - self._flying_since_us >= HOLD_US and self._plant.lost is None:
            self._plant.release()
            self.free = True
            self._say(f"board {self.number}: released")

    def _put_back(self, now_us: int) -> None:
        self.catch_up(now_us)
        self._place(now_us)
        self._flying_since_us = None

    def _place(self, now_us: int) -> None:
        """Put a robot into the holder, at home; the plant's clock begins here."""
        config = self._config
        self._placed_us = now_us
        self._plant = Plant(config.plant, config.tunnel, config.actuators, self._gusts, config.flight.home)
        self._plant.hold()


def _with_system(config: LabConfig, system: int) -> LabConfig:
    """Return the configuration with another MAVLink system id."""
    if system > MAX_SYSTEM:
        raise LabError(f"mavlink.system = {system}: ids end at {MAX_SYSTEM}")
    mavlink = config.mavlink.model_copy(update={"system": system})
    return config.model_copy(update={"mavlink": mavlink})
