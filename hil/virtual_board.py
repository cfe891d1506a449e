"""The board's pins, joined to the virtual world: IMU registers, servo timers, radio chip, debug console."""

from collections.abc import Callable, Sequence

from firmware_py.board import DECK_MEMORY_SIZE, EEPROM_SIZE, ImuCounts
from firmware_py.firmware import Kernel
from hil.events import EventQueue

STILL: ImuCounts = (0, 0, 0, 0, 0, 0)


class VirtualBoard:
    """Implements `firmware_py.board.Board`; `servo`, `radio` and `console` are where the pins lead to.

    `run_on(kernel, events)` tells it whose time it is, and which hardware its pins may set going.
    """

    def __init__(
        self,
        servo: Callable[[int, Sequence[int]], None],
        radio: Callable[[int, bytes], bool],
        console: Callable[[int, str], None],
    ) -> None:
        self.imu: ImuCounts = STILL
        self.battery_mv = 3900
        self.eeprom = bytearray(b"\xff" * EEPROM_SIZE)
        self.deck_memory = bytearray(b"\xff" * DECK_MEMORY_SIZE)
        self._servo = servo
        self._radio = radio
        self._console = console
        self._kernel: Kernel | None = None
        self._events: EventQueue | None = None

    def run_on(self, kernel: Kernel, events: EventQueue) -> None:
        """Join the pins to a booted processor and to the queue of hardware events."""
        self._kernel, self._events = kernel, events

    @property
    def now_us(self) -> int:
        """The processor's present instant; 0 while it boots."""
        return self._kernel.now_us if self._kernel else 0

    def read_imu(self) -> ImuCounts:
        """Return the last sample."""
        return self.imu

    def read_battery_mv(self) -> int:
        """Return the supply voltage."""
        return self.battery_mv

    def write_compare(self, counts: Sequence[int]) -> None:
        """Hand the compare counts to the servo timers."""
        self._servo(self.now_us, counts)

    def radio_send(self, data: bytes) -> bool:
        """Hand a packet to the radio chip."""
        accepted = self._radio(self.now_us, data)
        if self._kernel and self._events and self._events.next_us is not None:
            self._kernel.until_us = min(
                self._kernel.until_us, self._events.next_us - 1
            )  # hardware goes first
        return accepted

    def debug_write(self, text: str) -> None:
        """Hand a line to the console."""
        self._console(self.now_us, text)
