"""A chip on the bench: registers are read and written from outside, while its code sleeps or does what a test gives it."""

from struct import pack

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.emulator.stm32f405.chip import CYCLES_PER_US, FLASH, RAM, Chip, StopReason, build_machine

SLEEP = bytes.fromhex("30bffde7")  # wfi; b to it
PENDING = 0xE000_E200  # of the interrupts, NVIC_ISPR


class Bench:
    """A chip that executes `code` from FLASH + 8 on and then sleeps, and its registers."""

    def __init__(self, code: bytes = b"") -> None:
        code = pack("<II", RAM + 0x1000, (FLASH + 8) | 1) + code + SLEEP
        self.chip = Chip(code, FLASH, build_machine())
        self.us = 0

    def __getitem__(self, address: int) -> int:
        return int.from_bytes(self.chip.read(address, 4), "little")

    def __setitem__(self, address: int, value: int) -> None:
        self.chip.write(address, pack("<I", value))

    def wait(self, us: int) -> StopReason:
        self.us += us
        why = StopReason.TIME
        while self.chip.state.now < self.us * CYCLES_PER_US:
            why |= self.chip.run(self.us * CYCLES_PER_US)
        return why

    def until(self, address: int, mask: int) -> None:
        for _ in range(1000):
            if self[address] & mask:
                return
            self.wait(1)
        raise AssertionError(f"0x{address:08x} never has {mask:#x}: {self[address]:#x}")

    def is_pending(self, irq: int) -> bool:
        """Whether an interrupt waits to be served; none is enabled."""
        return bool(self[PENDING + irq // 32 * 4] >> irq % 32 & 1)
