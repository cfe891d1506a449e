"""The board's pins as the firmware sees them: raw counts and bytes, nothing in SI."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from firmware_py.core.subset import F32s, I32s
from firmware_py.wire.mavlink_numbers import CommandResult

# Gyro x y z, accelerometer x y z, int16, sensor frame.
ImuCounts = tuple[int, ...]

EEPROM_SIZE = 8192


class Board(Protocol):
    """The hardware below the drivers."""

    eeprom: bytearray  # (8192,) survives power cycles; all 0xFF when new
    imu: I32s  # (6,) the registers of the BMI088, as `ImuCounts`

    @property
    def sensors(self) -> Mapping[str, F32s]:
        """The last samples of the robot's own sensors, by name; NaN: there is none."""

    def read_battery_mv(self) -> int:
        """Return the supply voltage [mV]."""

    def write_compare(self, counts: Sequence[int]) -> None:
        """Load the four servo compare registers [timer counts of 1/21 us]; they act from the next PWM period on."""

    def radio_send(self, data: bytes) -> bool:
        """Hand a packet to the radio chip; False when its queue is full."""

    @property
    def uart_overruns(self) -> int:
        """Bytes lost because the UART's receive buffer was full."""

    def uart_read(self) -> bytes:
        """Return all that the UART's receiver has gathered, and make room."""

    def uart_write(self, data: bytes) -> bool:
        """Hand bytes to the UART; False when they do not fit into its transmit buffer, which then takes none."""

    def debug_write(self, text: str) -> None:
        """Write a line to the debug console."""

    def reset(self) -> None:
        """Reset the processor, as its own instruction does; EEPROM and deck memory keep their content."""

    def inject_failure(self, unit: int, failing: int, instance: int) -> CommandResult:
        """Make a part of the robot fail, by MAVLink's numbers; hardware that cannot do that answers UNSUPPORTED."""
