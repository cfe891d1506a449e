"""The parts around the chip by the registers of their data sheets."""

import struct

import numpy as np
import pytest

pytest.importorskip("unicorn")

from hil.crazyflie.parts import Parts
from support.stm32_bench import Bench

SYSCFG, EXTI, PORT_C = 0x4001_3800, 0x4001_3C00, 2


def test_a_sample_is_in_the_bmi088s_registers_when_its_interrupt_comes() -> None:
    bench = Bench()
    parts = Parts(bench.chip, np.zeros(8192, np.uint8))
    bench[SYSCFG + 0x14] = PORT_C << 8  # EXTI14
    bench[EXTI], bench[EXTI + 8] = 1 << 14, 1 << 14  # IMR, RTSR
    assert not bench[EXTI + 0x14]
    parts.sample((1, -2, 300, -4, 500, -6))
    assert bench[EXTI + 0x14] == 1 << 14
    assert struct.unpack_from("<3h", parts.gyro, 0x02) == (1, -2, 300)
    assert struct.unpack_from("<3h", parts.accel, 0x12) == (-4, 500, -6)
    assert (parts.gyro[0x00], parts.accel[0x00], parts.accel[0x03] >> 7) == (
        0x0F,
        0x1E,
        1,
    )  # identities, ready
    assert not parts.accel[0x18:].any()
