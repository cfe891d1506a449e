"""Decks on a chip whose code sleeps: transfers on I2C 1 and SPI 1 by hand, a body where a test puts it."""

from types import SimpleNamespace

import numpy as np

from hil.emulator.crazyflie.decks import Decks
from hil.emulator.stm32f405.chip import StopReason
from hil.emulator.stm32f405.processor import ChipProcessor
from hil.world.body import Carrier
from hil.world.room import Room
from support.stm32_bench import Bench

I2C1, SPI1, GPIOB = 0x4000_5400, 0x4001_3000, 0x4002_0400
SB, ADDR, AF = 1, 2, 1 << 10
SELECT = 4  # pin of port B


class DeckBench(Bench):
    """`decks` connected; `place` moves what carries them, in a room of 2 m to each side and 2.5 m in height."""

    def __init__(self, *decks: str) -> None:
        super().__init__()
        self.processor = ChipProcessor(self.chip, None, self._act, self.chip.run)
        self.motion = SimpleNamespace(p_WB=np.zeros(3), q_WB=np.array((1.0, 0.0, 0.0, 0.0)))
        carrier = Carrier(self.motion, np.random.default_rng(1), Room(0.0, 2.0, 2.5), decks)  # type: ignore[arg-type]
        self.decks = Decks(self.chip, self.processor, carrier)
        self[I2C1 + 0x1C], self[I2C1] = 35, 1
        self[GPIOB + 0x18], self[GPIOB] = 1 << SELECT, 1 << 2 * SELECT
        self[SPI1] = 1 << 6 | 5 << 3 | 1 << 2

    def _act(self, why: int) -> None:
        if why & StopReason.DEVICE:
            self.chip.tell_devices()

    def place(self, p_WB: tuple[float, ...], q_WB: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)) -> None:
        self.motion.p_WB, self.motion.q_WB = np.array(p_WB), np.array(q_WB)

    def wait(self, us: int) -> StopReason:
        self.us += us
        self.processor.run(self.us)
        self.chip.tell_devices()  # of what the test wrote between two runs
        return StopReason.TIME

    # I2C

    def answers(self, address: int, reading: bool = False) -> bool:
        """Address a device; the transfer goes on if it is there."""
        self[I2C1 + 0x14] = 0
        self[I2C1] = 1 << 10 | 1 << 8 | 1  # ACK, START
        self.until(I2C1 + 0x14, SB)
        self[I2C1 + 0x10] = address << 1 | reading
        self.until(I2C1 + 0x14, ADDR | AF)
        there = bool(self[I2C1 + 0x14] & ADDR)
        self[I2C1 + 0x18]  # clears ADDR
        if not there:
            self.stop()
        return there

    def stop(self) -> None:
        self[I2C1] = 1 << 9 | 1
        self.wait(100)

    def write(self, address: int, data: bytes) -> None:
        assert self.answers(address)
        for byte in data:
            self[I2C1 + 0x10] = byte
            self.wait(40)
        self.stop()

    def read(self, address: int, register: bytes, count: int) -> bytes:
        assert self.answers(address)
        for byte in register:
            self[I2C1 + 0x10] = byte
            self.wait(40)
        assert self.answers(address, reading=True)
        data = []
        for _ in range(count):
            self.wait(40)
            data.append(self[I2C1 + 0x10])
        self.stop()
        return bytes(data)

    # SPI

    def transfer(self, data: bytes) -> bytes:
        """Exchange bytes with what PB4 selects."""
        received = []
        self[GPIOB + 0x18] = 1 << SELECT + 16
        for byte in data:
            self[SPI1 + 0xC] = byte
            self.wait(7)
            received.append(self[SPI1 + 0xC])
        self[GPIOB + 0x18] = 1 << SELECT
        self.wait(1)
        return bytes(received)
