"""The number types that log variables and parameters have on the wire, with their numbers in both tables of contents.

Numbers are little-endian. A value that does not fit is cast as in C: integers wrap, floats become
infinite; where C leaves the result undefined, for NaN or infinity as an integer, it is 0.
"""

import struct
from enum import Enum
from math import copysign, inf, isfinite

from firmware_py.wire import WireError


class Scalar(Enum):
    """`struct` format, type number in the log TOC, type number in the parameter TOC."""

    U8 = ("B", 1, 0x08)
    U16 = ("H", 2, 0x09)
    U32 = ("I", 3, 0x0A)
    I8 = ("b", 4, 0x00)
    I16 = ("h", 5, 0x01)
    I32 = ("i", 6, 0x02)
    F32 = ("f", 7, 0x06)
    F16 = ("e", 8, 0x05)

    def __init__(self, format: str, log_number: int, parameter_number: int) -> None:
        self.format = format
        self.log_number = log_number
        self.parameter_number = parameter_number
        self.layout = struct.Struct("<" + format)
        self.size = self.layout.size
        self.is_float = format in "fe"

    def cast(self, value: float) -> int | float:
        """Return the value that this type holds in place of `value`."""
        if self.is_float:
            try:
                return float(self.layout.unpack(self.layout.pack(float(value)))[0])
            except OverflowError:
                return copysign(inf, value)
        if not isfinite(value):
            return 0
        bits = 8 * self.size
        wrapped = int(value) % (1 << bits)
        return wrapped - (1 << bits) if self.format.islower() and wrapped >> (bits - 1) else wrapped

    def pack(self, value: float) -> bytes:
        """Return the bytes of `cast(value)`."""
        return self.layout.pack(self.cast(value))

    def unpack(self, data: bytes) -> float:
        """Return the value of exactly `size` bytes; `WireError` for any other number of them."""
        if len(data) != self.size:
            raise WireError(f"{self.name}: {len(data)} bytes instead of {self.size}")
        value: float = self.layout.unpack(data)[0]
        return value


LOG_SCALARS = {scalar.log_number: scalar for scalar in Scalar}
PARAMETER_SCALARS = {scalar.parameter_number: scalar for scalar in Scalar}
