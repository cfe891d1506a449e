"""A whole Crazyflie with the tests' own firmware, and nothing around it."""

from collections.abc import Sequence
from functools import cache
from struct import pack
from typing import Any

from hil.emulator.crazyflie.crazyflie import Crazyflie
from hil.emulator.stm32f405.chip import build_machine
from hil.emulator.stm32f405.image import Image
from support.stm32_firmware import build


@cache
def image() -> Image:
    return Image(build())


class Board:
    """A Crazyflie with nothing around it; `said` are the lines of its console."""

    def __init__(self, planted: int = 0, own: Image | None = None, **options: Any) -> None:
        """`own` is an image instead of the tests', or of it without names; `options` are the Crazyflie's."""
        self.eeprom, self.said = bytearray(b"\xff" * 8192), list[str]()
        self.counts: list[tuple[int, ...]] = []
        options = {"polls": False, "outputs": ((2, 0), (2, 1)), **options}
        self.crazyflie = Crazyflie(own or image(), build_machine(), self, **options)
        self.crazyflie.chip.write(image().symbol("planted").address, pack("<I", planted))  # in each build

    def run(self, begin_ms: int, end_ms: int) -> list[str]:
        """Return what it says until then."""
        before = len(self.said)
        for ms in range(begin_ms, end_ms):
            self.crazyflie.processor.run(1000 * (ms + 1))
        return self.said[before:]

    def read_battery_mv(self) -> int:
        return 3700

    def radio_send(self, data: bytes) -> bool:
        return True

    def radio_command(self, kind: int, data: bytes) -> None: ...

    def debug_write(self, text: str) -> None:
        self.said.append(text)

    def write_compare(self, counts: Sequence[int]) -> None:
        self.counts.append(tuple(counts))
