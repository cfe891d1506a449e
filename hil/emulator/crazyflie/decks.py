"""The decks on a Crazyflie: the contents of their one-wire memories, and their chips on the board's buses.

The radio chip reads the memories and hands them on over syslink. Products and pins: Bitcraze's drivers and deck memory
format; weights: its data sheets. Where a sensor is on a deck is chosen, to about 5 mm.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from firmware_py.wire.memories import encode_one_wire
from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.flow_sensor import PERIOD_US, FlowSensor
from hil.emulator.crazyflie.ranger import Ranger
from hil.emulator.stm32f405.chip import Chip
from hil.emulator.stm32f405.processor import ChipProcessor
from hil.world.body import Carrier, Vector
from hil.world.fixed_order import normal
from hil.world.room import to_world

BITCRAZE = 0xBC
DECK_BUS, SPI_BUS = 1, 1
IO_3 = ("B", 4)  # the pin of the expansion port that selects the flow sensor
FAMILY = 0x0D  # of the one-wire memories, DS28E05
NOBODY = 0xFF
COS_CONE = 0.97237  # of 13.5 degrees: half of what a VL53L1X sees, by its data sheet
FLOW_PLACE: Vector = (0.0, 0.0, -0.008)  # [m] in B
EXPANDER_ADDRESS = 0x20
OUTPUT, DIRECTION = 1, 3  # registers of the expander, PCA9554; in DIRECTION a 1 is an input
# Of the Multi-ranger: its sensors' pins at the expander, and where they look from and to, in B.
RANGERS: tuple[tuple[int, Vector, Vector], ...] = (
    (4, (0.015, 0.0, 0.01), (1.0, 0.0, 0.0)),
    (1, (-0.015, 0.0, 0.01), (-1.0, 0.0, 0.0)),
    (6, (0.0, 0.015, 0.01), (0.0, 1.0, 0.0)),
    (2, (0.0, -0.015, 0.01), (0.0, -1.0, 0.0)),
    (0, (0.0, 0.0, 0.015), (0.0, 0.0, 1.0)),
)


@dataclass(frozen=True, slots=True)
class DeckHost:
    """The microcontroller to which decks are connected, its time, and the quantities that they measure."""

    chip: Chip
    processor: ChipProcessor
    carrier: Carrier

    def draw(self) -> float:
        """Return a unit normal number."""
        return float(normal(self.carrier.rng, 1)[0])

    def ranger(self, place_B: Vector, direction_B: Vector) -> Ranger:
        """Return a ranger that is off."""
        measure = partial(self._distance, place_B, direction_B)
        return Ranger(self.chip, DECK_BUS, self.processor.later, measure, self.draw)

    def _distance(self, place_B: Vector, direction_B: Vector) -> float:
        motion = self.carrier.motion
        q_WB = motion.q_WB.tolist()
        place = [a + b for a, b in zip(motion.p_WB.tolist(), to_world(q_WB, place_B), strict=True)]
        return self.carrier.room.distance(place, to_world(q_WB, direction_B), COS_CONE)


def _connect_flow(board: DeckHost) -> None:
    board.ranger(FLOW_PLACE, (0.0, 0.0, -1.0)).switch(True)
    motion, room = board.carrier.motion, board.carrier.room
    sensor = FlowSensor(board.chip, SPI_BUS, IO_3, motion, room, FLOW_PLACE, board.draw)
    board.processor.every(PERIOD_US, sensor.expose)


def _connect_rangers(board: DeckHost) -> None:
    """Let the expander switch five rangers; a pin that it does not drive is pulled low."""
    registers = np.array((0xFF, 0xFF, 0, 0xFF), np.uint8)
    rangers = [(1 << pin, board.ranger(place, direction)) for pin, place, direction in RANGERS]

    def drive() -> None:
        high = int(registers[OUTPUT] & ~registers[DIRECTION])
        for bit, ranger in rangers:
            ranger.switch(bool(high & bit))

    board.chip.on_write(board.chip.add_device(DECK_BUS, EXPANDER_ADDRESS, registers), drive)


@dataclass(frozen=True, slots=True)
class Deck:
    """A kind of deck."""

    product: int
    name: str
    mass: float  # [kg]
    connect: Callable[[DeckHost], None]


DECKS = {
    "flow2": Deck(0x0F, "bcFlow2", 0.0016, _connect_flow),
    "multiranger": Deck(0x0C, "bcMultiranger", 0.0023, _connect_rangers),
}


class Decks:
    """The connected decks of one board."""

    def __init__(self, chip: Chip, processor: ChipProcessor, carrier: Carrier | None) -> None:
        decks = [] if carrier is None else [DECKS[name] for name in carrier.decks]
        self._memories = [
            bytearray(encode_one_wire(BITCRAZE, deck.product, deck.name, "C")) for deck in decks
        ]
        for deck in decks:
            if carrier is not None:
                deck.connect(DeckHost(chip, processor, carrier))

    def answer(self, kind: int, data: bytes) -> bytes:
        """Return the radio chip's answer to a syslink packet about the memories."""
        if kind == syslink.SCAN_MEMORIES:
            return bytes((len(self._memories),))
        number, at = data[0], int.from_bytes(data[1:3], "little")
        if number >= len(self._memories):
            return bytes((NOBODY,)) + data[1:]
        memory = self._memories[number]
        if kind == syslink.MEMORY_INFO:
            serial = bytes((FAMILY, number, 0, 0, 0, 0, 0))
            return bytes((number,)) + serial + bytes((_crc8(serial),))
        if kind == syslink.READ_MEMORY:
            return data[:3] + memory[at : at + len(data) - 3]
        written = data[5 : 5 + int.from_bytes(data[3:5], "little")]
        if at + len(written) <= len(memory):
            memory[at : at + len(written)] = written
        return data


def _crc8(data: bytes) -> int:
    """Return the sum of a one-wire serial number (x8 + x5 + x4 + 1, the low bit first)."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8C if crc & 1 else 0)
    return crc
