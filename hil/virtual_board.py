"""The board's pins, joined to the virtual world: IMU registers, servo timers, radio chip, debug console."""

from collections.abc import Callable, Sequence

from firmware_py.board import ImuCounts

STILL: ImuCounts = (0, 0, 0, 0, 0, 0)


class VirtualBoard:
    """Implements `firmware_py.board.Board`.

    `now_us` is set by the harness before hardware or firmware act; `servo`, `radio` and `console` are where the pins
    lead to.
    """

    def __init__(
        self,
        servo: Callable[[int, Sequence[int]], None],
        radio: Callable[[int, bytes], bool],
        console: Callable[[int, str], None],
    ) -> None:
        self.now_us = 0
        self.imu: ImuCounts = STILL
        self._servo = servo
        self._radio = radio
        self._console = console

    def read_imu(self) -> ImuCounts:
        """Return the last sample."""
        return self.imu

    def write_compare(self, counts: Sequence[int]) -> None:
        """Hand the compare counts to the servo timers."""
        self._servo(self.now_us, counts)

    def radio_send(self, data: bytes) -> bool:
        """Hand a packet to the radio chip."""
        return self._radio(self.now_us, data)

    def debug_write(self, text: str) -> None:
        """Hand a line to the console."""
        self._console(self.now_us, text)
