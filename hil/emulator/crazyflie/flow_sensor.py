"""A PMW3901, PixArt's optical flow sensor, that looks down: from image to image the shift of what it saw on the floor.

Registers on SPI, of which a burst read takes the motion since the last one. It compares images, so a turn of the body shifts
them as well. Sources: PixArt's data sheet, and the drivers of Bitcraze and PX4.
"""

from collections.abc import Callable

import numpy as np

from hil.emulator.stm32f405.chip import Chip
from hil.world.body import Motion, Vector
from hil.world.room import Room, to_body, to_world

PERIOD_US = 8_264  # of its images: 121 per second
PRODUCT, MOTION, DELTAS, BURST, RESET, INVERSE = 0x00, 0x02, 0x03, 0x16, 0x3A, 0x5F  # registers
IDENTITY, WRITE, RESETS = 0x49, 0x80, 0x5A
MOVED, STILL = 0xB0, 0x30  # in MOTION
# [m] Nearer the image is blurred. Chosen: features and shifts shrink in proportion. Bitcraze's Kalman filter takes no height
# below 0.1 m: a sensor that followed the floor at 1 cm would be believed to move ten times as fast, and would not take off.
FOCUS = 0.08
FASTEST = 7.4  # [rad/s]
# Per radian: 35 pixels over 0.717 rad, in tenths, by Bitcraze's measurement; PX4 has 385.
COUNTS = 10.0 * 35.0 / 0.71674
NOISE = 1.0  # counts of an image, per axis; chosen: Bitcraze's Kalman filter assumes 2
TEXTURE, SHUTTER = 100, 2000  # of the floor, what it counts of features; how long it is exposed
DOWN_B: Vector = (0.0, 0.0, -1.0)


class FlowSensor:
    """`select` is the pin that selects it, `place_B` where it is [m]; `draw` returns unit normal numbers."""

    def __init__(
        self,
        chip: Chip,
        bus: int,
        select: tuple[str, int],
        motion: Motion,
        room: Room,
        place_B: Vector,
        draw: Callable[[], float],
    ) -> None:
        self._chip, self._motion, self._room, self._place_B, self._draw = chip, motion, room, place_B, draw
        self._registers = np.zeros(128, np.uint8)
        self._device = chip.add_selected(bus, select, self._registers)
        chip.on_write(self._device, self._obey)
        self._spot_W: Vector | None = None  # on the floor, in the middle of the last image
        self._sharpness = 0.0  # 1: of what is far enough away
        self._shift = [0, 0]  # counts since the last read, along its own axes
        self._show()

    def expose(self, now_us: int) -> None:
        """Take an image and compare it with the last one."""
        p, q = self._motion.p_WB, self._motion.q_WB.tolist()
        place = tuple(float(a) + b for a, b in zip(p, to_world(q, self._place_B), strict=True))
        ahead = to_world(q, DOWN_B)
        distance = (place[2] - self._room.floor) / -ahead[2] if ahead[2] < 0.0 else 0.0
        self._sharpness = min(max(distance / FOCUS, 0.0), 1.0)
        if self._sharpness == 0.0:
            self._spot_W = None
            self._show()
            return
        if self._spot_W is not None:
            x, y, z = to_body(q, tuple(a - b for a, b in zip(self._spot_W, place, strict=True)))
            most = COUNTS * FASTEST * PERIOD_US * 1e-6
            for axis, angle in enumerate((y / -z, x / -z)):  # its x axis is that of B's y
                counts = self._sharpness * min(max(COUNTS * angle, -most), most)
                self._shift[axis] += round(counts + NOISE * self._draw())
        self._spot_W = tuple(a + distance * b for a, b in zip(place, ahead, strict=True))
        self._show()

    def _obey(self) -> None:
        """Begin to add up anew once the motion was read, or as a reset does."""
        first = self._chip.first_byte(self._device)
        if first == BURST or (first == RESET | WRITE and self._registers[RESET] == RESETS):
            self._shift = [0, 0]
        self._show()

    def _show(self) -> None:
        """Put what it would return now into the registers."""
        x, y = (min(max(shift, -0x8000), 0x7FFF) for shift in self._shift)
        motion = MOVED if x or y else STILL
        deltas = x.to_bytes(2, "little", signed=True) + y.to_bytes(2, "little", signed=True)
        burst = (
            bytes((motion, 0))
            + deltas
            + bytes((round(TEXTURE * self._sharpness), 80, 120, 40))
            + SHUTTER.to_bytes(2)
        )
        self._registers[BURST : BURST + len(burst)] = np.frombuffer(burst, np.uint8)
        self._registers[MOTION : DELTAS + 4] = np.frombuffer(bytes((motion,)) + deltas, np.uint8)
        self._registers[[PRODUCT, INVERSE]] = IDENTITY, IDENTITY ^ 0xFF
