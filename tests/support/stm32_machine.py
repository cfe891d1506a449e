"""The tests' own firmware on the emulated microcontroller."""

from collections.abc import Sequence
from struct import pack, unpack

import numpy as np
import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.emulator.stm32f405.chip import CYCLES_PER_US, SOFTWARE, Chip, StopReason, build_machine
from hil.emulator.stm32f405.cpu_profile import CpuProfile, Reader, functions_of
from hil.emulator.stm32f405.debugged_chip import DebuggedChip
from hil.emulator.stm32f405.freertos import FreeRtos
from hil.emulator.stm32f405.gdb import GdbServer
from hil.emulator.stm32f405.image import Image
from hil.emulator.stm32f405.processor import ChipProcessor
from support.stm32_firmware import build


class FirmwareOnChip:
    """One image on one chip with an EEPROM, from power-on; variables are read and written by name."""

    def __init__(self, compiler: str = "clang", flags: Sequence[str] = ("-g",), **variables: int) -> None:
        self.image = Image(build(compiler, flags))
        self.chip = Chip(self.image.code, self.image.base, build_machine())
        self.eeprom = np.full(8192, 0xFF, np.uint8)
        self.chip.add_device(1, 0x50, self.eeprom, 2)
        for name, value in variables.items():
            self.poke(name, value)

    def processor(self) -> ChipProcessor:
        """Return the chip as the laboratory's time line sees it."""
        return ChipProcessor(
            self.chip, FreeRtos.of(self.image, self.chip.read), lambda why: None, self.chip.run
        )

    def run(self, us: int) -> StopReason:
        """Run until that long after power-on, or until something stops the chip."""
        return self.chip.run(us * CYCLES_PER_US)

    def run_debugged(self, server: GdbServer, end_us: int = 1000) -> None:
        """Run until that long after power-on, or until it resets, as a debugger wants."""
        chip = DebuggedChip(self.chip, server, FreeRtos(self.image, self.chip.read))
        why = int(StopReason.TIME)
        while self.chip.now_us < end_us and why in (StopReason.TIME, StopReason.SERIAL, StopReason.COMPARE):
            why = chip.run(end_us * CYCLES_PER_US)

    def peek(self, name: str, index: int = 0) -> int:
        return self.peek_all(name, index + 1)[index]

    def peek_all(self, name: str, count: int) -> list[int]:
        return list(unpack(f"<{count}I", self.chip.read(self.image.symbol(name).address, 4 * count)))

    def poke(self, name: str, value: int) -> None:
        self.chip.write(self.image.symbol(name).address, pack("<I", value))


class Profiled(FirmwareOnChip):
    """The tests' firmware, its cycles charged from power-on."""

    def __init__(self, compiler: str, flags: Sequence[str] = ("-g",), **variables: int) -> None:
        super().__init__(compiler, flags, **variables)
        self.on_time_line = self.processor()
        self.chip.record()
        self.chip.profile([(one.address, one.address + one.size) for one in functions_of(self.image)])

    def run_with_samples(self, us: int) -> CpuProfile:
        for now_us in range(1_000, us + 1, 1_000):
            while self.chip.now_us < now_us:
                if self.run(now_us) & StopReason.RESET:
                    self.chip.reset(SOFTWARE)
            self.chip.pin("C", 14, True)
            self.chip.pin("C", 14, False)
        return Reader(self.image, self.chip, self.on_time_line.task_names, 0).read()
