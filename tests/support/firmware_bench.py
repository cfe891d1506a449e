"""The firmware as a whole on a board of plain numbers, in simulated time."""

from contextlib import suppress

from firmware_py.firmware import Firmware
from firmware_py.wire import WireError, crtp
from firmware_py.wire.telemetry import Sample
from ground_station.links.log_blocks import LogBlocks
from hil.board.pins import Requests, VirtualBoard
from hil.config import load_config
from hil.emulator.events import EventQueue

HOVER_COUNTS = [
    21000 + int(sign * 0.436332 * 31290 + 32767 + shift) * 21000 // 65535  # the original's mapping, +-25 deg
    for sign, shift in zip((1, -1, 1, -1), (-3600, -5000, -9000, 6200), strict=True)
]
LEVEL = (1.0, 0.0, 0.0, 0.0)


class FirmwareBench(VirtualBoard):
    """A board without a world: still IMU, pins that remember, and the loop of the harness."""

    now_us = 0  # of the hardware, which the test leads

    def __init__(self, *overrides: str, mavlink: bool = False) -> None:
        self.writes: list[tuple[int, list[int]]] = []
        self.console: list[str] = []
        super().__init__(
            lambda now_us, counts: self.writes.append((self.now_us, list(counts))),
            lambda now_us, data: True,
            lambda now_us, text: self.console.append(text),
            requests=Requests(reset=lambda now_us: self.resets_us.append(self.now_us)),
        )
        self.events = EventQueue()
        self.measure((3, -2, 1, 0, 0, 1365))
        self.imu_alive = True
        self.imu_noise = 1  # of the last bit; 0: frozen
        self.radio_open = True
        self.polling = True  # the dongle asks all the time, as every real one
        self.sent: list[tuple[int, bytes]] = []
        self.samples: list[Sample] = []  # of telemetry, once `stream` has asked for it
        self.resets_us: list[int] = []
        self.firmware = Firmware(load_config(overrides=overrides), self, mavlink=mavlink)
        self._to_station: list[bytes] = []
        self._logs = LogBlocks(
            lambda now_us, data: self.firmware.radio_received(data), lambda: self.firmware.log_numbers
        )
        self.events.at(1000, self._sample)

    def radio_send(self, data: bytes) -> bool:
        if self.radio_open:
            self.sent.append((self.now_us, data))
            self._to_station.append(data)
        return self.radio_open

    def _sample(self, now_us: int) -> None:
        if self.imu_alive:
            self.imu[2] ^= self.imu_noise
            self.firmware.imu_ready()
        if self.polling:
            self.firmware.radio_polled()
        self.events.at(now_us + 1000, self._sample)

    def pose(
        self, at_us: int, p: tuple[float, float, float] = (0.0, 0.0, 0.0), age_us: int | None = 40_000
    ) -> None:
        data = crtp.encode_ext_pose(p, LEVEL, age_us)
        self.events.at(at_us, lambda now_us: self.firmware.radio_received(data))

    def poses(self, start_us: int, end_us: int, p: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        for at_us in range(start_us, end_us, 20_000):
            self.pose(at_us, p)

    def stream(self, at_us: int) -> None:
        """Let a station ask for the telemetry of a flight."""
        self.events.at(at_us, self._logs.request)

    def run(self, end_us: int) -> None:
        while self.now_us < end_us:
            wakes = [end_us, self.events.next_us, self.firmware.next_wake_us]
            self.now_us = min(wake for wake in wakes if wake is not None)
            self.events.run(self.now_us)
            self.firmware.run(self.now_us)
            while self._to_station:
                packet = crtp.decode(self._to_station.pop(0))
                if packet.port == crtp.PORT_LOG:
                    with suppress(WireError):  # blocks of another client
                        self.samples += self._logs.receive(self.now_us, packet)
                    self.firmware.run(self.now_us)
