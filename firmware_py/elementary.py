"""Elementary functions from + - * / and square roots in a fixed order: the same bits on every processor.

The C library has separate code for processors with fused multiply-add, and the last bits differ; so has numpy. These power
series come within 5 units in the last place. `sine_ahead`, `exp` and `atan2` can be compiled, with the same bits: they call
none of our functions. The flight core has its own float32 functions.
"""

from math import copysign, factorial, floor, frexp, inf, ldexp, pi, sqrt

QUARTERS_PER_RADIAN = 2.0 / pi
# pi/2 and log 2 in parts of so few bits that a whole multiple of all but the last is exact
QUARTER_1 = float.fromhex("0x1.921fb544p+0")
QUARTER_2 = float.fromhex("0x1.0b4611a6p-34")
QUARTER_3 = float.fromhex("0x1.3198a2e037073p-69")
LOG_2_HIGH = float.fromhex("0x1.62e42feep-1")
LOG_2_LOW = float.fromhex("0x1.a39ef35793c76p-33")
EXP_MIN, EXP_MAX = -746.0, 710.0  # beyond, the result is 0 or infinite
SQRT_HALF = sqrt(0.5)

# Taylor coefficients, the highest powers first, as many as affect the result where the series are used
SIN = tuple((-1.0) ** k / factorial(2 * k + 1) for k in range(8, 0, -1))  # x^17 to x^3
COS = tuple((-1.0) ** k / factorial(2 * k) for k in range(8, 1, -1))  # x^16 to x^4
EXP = tuple(1.0 / factorial(k) for k in range(14, 1, -1))  # x^14 to x^2
ATAN = tuple((-1.0) ** k / (2 * k + 1) for k in range(12, 0, -1))  # x^25 to x^3
ATANH = tuple(1.0 / (2 * k + 1) for k in range(11, 0, -1))  # x^23 to x^3


def sine_ahead(angle: float, quarters: int) -> float:
    """Return the sine of an angle [rad], exact up to a million, plus that many quarter turns."""
    turns = floor(angle * QUARTERS_PER_RADIAN + 0.5)
    x = ((angle - turns * QUARTER_1) - turns * QUARTER_2) - turns * QUARTER_3
    square = x * x
    quadrant = (turns + quarters) % 4
    series = 0.0
    if quadrant % 2 == 0:
        for coefficient in SIN:
            series = series * square + coefficient
        value = x + x * (square * series)
    else:
        for coefficient in COS:
            series = series * square + coefficient
        value = 1.0 - (0.5 * square - square * square * series)
    return -value if quadrant >= 2 else value


def sin(angle: float) -> float:
    """Return the sine of an angle [rad]."""
    return sine_ahead(angle, 0)


def cos(angle: float) -> float:
    """Return the cosine of an angle [rad]."""
    return sine_ahead(angle, 1)


def tan(angle: float) -> float:
    """Return the tangent of an angle [rad]."""
    return sin(angle) / cos(angle)


def exp(x: float) -> float:
    """Return e^x; 0 or infinity beyond the range of a double."""
    if x < EXP_MIN:
        return 0.0
    if x > EXP_MAX:
        return inf
    doublings = floor(x / (LOG_2_HIGH + LOG_2_LOW) + 0.5)
    rest = (x - doublings * LOG_2_HIGH) - doublings * LOG_2_LOW
    series = 0.0
    for coefficient in EXP:
        series = series * rest + coefficient
    return ldexp(1.0 + (rest + rest * rest * series), doublings)


def log_1p(x: float) -> float:
    """Return the logarithm of 1 + x, also for x near 0; x > -1."""
    if abs(x) < 0.25:
        doublings, s = 0, x / (2.0 + x)
    else:
        mantissa, doublings = frexp(1.0 + x)
        if mantissa < SQRT_HALF:
            mantissa, doublings = 2.0 * mantissa, doublings - 1
        s = (mantissa - 1.0) / (mantissa + 1.0)
    series, square = 0.0, s * s
    for coefficient in ATANH:
        series = series * square + coefficient
    return doublings * LOG_2_HIGH + (2.0 * (s + s * (square * series)) + doublings * LOG_2_LOW)


def atan2(y: float, x: float) -> float:
    """Return the angle of (x, y) [rad] in -pi..pi, with the sign of y; 0 for the zero vector."""
    high, low = max(abs(x), abs(y)), min(abs(x), abs(y))
    if high == 0.0:
        return 0.0
    slope = low / high
    for _ in range(2):  # half the angle, to less than 11.25 degrees
        slope = slope / (1.0 + sqrt(1.0 + slope * slope))
    series, square = 0.0, slope * slope
    for coefficient in ATAN:
        series = series * square + coefficient
    angle = 4.0 * (slope + slope * (square * series))
    if abs(y) > abs(x):
        angle = 0.5 * pi - angle
    if x < 0.0:
        angle = pi - angle
    return copysign(angle, y)


def asin(x: float) -> float:
    """Return the arc sine [rad] of x in -1..1."""
    return atan2(x, sqrt((1.0 - x) * (1.0 + x)))


def power(base: float, exponent: int) -> float:
    """Return `base` to the power of a non-negative integer."""
    result = 1.0
    while exponent:
        if exponent & 1:
            result *= base
        base *= base
        exponent >>= 1
    return result
