"""The board's pins, connected to the virtual world: IMU registers, servo timers, radio chip, UART, debug console."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import numpy as np

from firmware_py.board import EEPROM_SIZE, ImuCounts
from firmware_py.core.subset import F32s, I32s, i32
from firmware_py.rtos import TICK_US
from firmware_py.wire.mavlink_numbers import CommandResult
from hil.board.board_firmware import Processor
from hil.emulator.events import EventQueue

STILL: ImuCounts = (0, 0, 0, 0, 0, 0)

InjectFailure = Callable[[int, int, int, int], CommandResult]  # (now_us, unit, failing, instance)


class Uart(Protocol):
    """The board's end of a serial line."""

    @property
    def overruns(self) -> int:
        """Bytes lost because the receive buffer was full."""

    def read(self) -> bytes:
        """Return the bytes received since the last call."""

    def write(self, now_us: int, data: bytes) -> bool:
        """Send bytes; False when they do not fit into the transmit buffer."""


def new_eeprom() -> bytearray:
    """Return the contents of an EEPROM that nobody has written."""
    return bytearray(b"\xff" * EEPROM_SIZE)


def unsupported(now_us: int, unit: int, failing: int, instance: int) -> CommandResult:
    """Refuse every failure."""
    return CommandResult.UNSUPPORTED


@dataclass(frozen=True, slots=True)
class Requests:
    """The world's answers when the processor resets itself, commands its radio chip, or a client makes a part fail."""

    reset: Callable[[int], None] = lambda now_us: None
    # (now_us, kind, data), as in syslink
    radio_command: Callable[[int, int, bytes], None] = lambda now_us, kind, data: None
    fail: InjectFailure = unsupported


NO_REQUESTS = Requests()
NO_SENSORS: Mapping[str, F32s] = MappingProxyType({})


class VirtualBoard:
    """Implements `firmware_py.board.Board`; the pins lead to `servo`, `radio`, `console` and `uart`.

    These get times of the hardware's clock. `run_on` sets the processor that keeps time and the queue of hardware events.
    """

    def __init__(
        self,
        servo: Callable[[int, Sequence[int]], None],
        radio: Callable[[int, bytes], bool],
        console: Callable[[int, str], None],
        uart: Uart | None = None,
        requests: Requests = NO_REQUESTS,
        eeprom: bytearray | None = None,
        sensors: Mapping[str, F32s] = NO_SENSORS,
    ) -> None:
        self.sensors = sensors
        self.imu = np.array(STILL, i32)
        self.battery_mv = 3900
        self.eeprom = new_eeprom() if eeprom is None else eeprom
        self._servo, self._radio, self._console, self._uart = servo, radio, console, uart
        self._requests = requests
        self._kernel: Processor | None = None
        self._events: EventQueue | None = None
        self._booted_us = 0

    def measure(self, counts: Sequence[int] | I32s) -> None:
        self.imu[:] = counts

    def supply(self, millivolts: int) -> None:
        self.battery_mv = millivolts

    def boot(self, now_us: int) -> None:
        """Start a processor's clock at a hardware time; call `run_on` when it has booted."""
        self._kernel, self._booted_us = None, now_us

    def run_on(self, kernel: Processor, events: EventQueue) -> None:
        """Connect the pins to a booted processor and to the queue of hardware events."""
        self._kernel, self._events = kernel, events

    @property
    def now_us(self) -> int:
        """The processor's current time, by the hardware's clock."""
        return self._booted_us + (self._kernel.now_us if self._kernel else 0)

    def read_battery_mv(self) -> int:
        return self.battery_mv

    def write_compare(self, counts: Sequence[int]) -> None:
        self._servo(self.now_us, counts)

    def radio_send(self, data: bytes) -> bool:
        """Hand a packet to the radio chip; it is lost while the processor boots."""
        if self._kernel is None:
            return True
        accepted = self._radio(self.now_us, data)
        self._let_hardware_go_first()
        return accepted

    def radio_command(self, kind: int, data: bytes) -> None:
        self._requests.radio_command(self.now_us, kind, data)
        self._let_hardware_go_first()

    @property
    def uart_overruns(self) -> int:
        return self._uart.overruns if self._uart else 0

    def uart_read(self) -> bytes:
        return self._uart.read() if self._uart else b""

    def uart_write(self, data: bytes) -> bool:
        """Hand bytes to the UART; they are lost when nothing is connected."""
        if self._uart is None:
            return True
        accepted = self._uart.write(self.now_us, data)
        self._let_hardware_go_first()
        return accepted

    def _let_hardware_go_first(self) -> None:
        """Stop the tasks before the hardware's next event."""
        if self._kernel and self._events and self._events.other_us is not None:
            self._kernel.stop_before(self._events.other_us - self._booted_us)

    def debug_write(self, text: str) -> None:
        self._console(self.now_us, text)

    def reset(self) -> None:
        """Notify the owner, who reboots the processor before its tasks continue."""
        self._requests.reset(self.now_us)
        self._let_hardware_go_first()

    def inject_failure(self, unit: int, failing: int, instance: int) -> CommandResult:
        result = self._requests.fail(self.now_us, unit, failing, instance)
        self._let_hardware_go_first()
        return result


class CpuLoad:
    """A load on the processor: the share of every tick that it takes, 0..1; may change at any time."""

    __slots__ = ("share",)

    def __init__(self) -> None:
        self.share = 0.0

    def taken_us(self) -> int:
        """Return the time it takes from this tick."""
        return round(self.share * TICK_US)
