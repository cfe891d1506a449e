"""From timer counts to the commanded angle of a servo: pulse length, PWM period, zero offsets.

The board's timer counts at 21 MHz; a PWM period is 52501 counts (2500.0476 us), a pulse 21000..42000 counts (1..2 ms).
New counts take effect at the start of the next period, here the first whole microsecond at or after it; the first period
starts at time 0. Source: the Crazyflie firmware's motors.c as the author changed it for servos.
"""

from collections.abc import Sequence

TIMER_MHZ = 21
PERIOD_COUNTS = 52501
OUTPUTS = ((4, 2), (2, 0), (2, 1), (4, 3))  # M1 to M4: TIM5_CH3, TIM3_CH1, TIM3_CH2, TIM5_CH4, counted from 0
MIDDLE_COUNTS = 31500.0  # 1.5 ms
WORDS_PER_RADIAN = 31290
RAD_PER_COUNT = 65535 / (WORDS_PER_RADIAN * 21000)  # 477.455 us/rad: 65535 words per millisecond
PULSE_MIN, PULSE_MAX = 10_500, 52_500  # counts, 0.5..2.5 ms: a servo ignores anything else


def next_period_us(now_us: int) -> int:
    """Return the first whole microsecond of the PWM period that starts after `now_us`."""
    period = now_us * TIMER_MHZ // PERIOD_COUNTS + 1
    return -(-period * PERIOD_COUNTS // TIMER_MHZ)


def commanded_angles(
    counts: Sequence[int], zero_offset: Sequence[float], before: Sequence[float]
) -> list[float]:
    """Return the flap angles [rad] that the pulses command; without a valid pulse a servo keeps the one `before`."""
    return [
        (count - MIDDLE_COUNTS) * RAD_PER_COUNT - offset if PULSE_MIN <= count <= PULSE_MAX else old
        for count, offset, old in zip(counts, zero_offset, before, strict=True)
    ]
