"""Float32 functions built from + - * / and sqrt only, so that every target gives the same bits.

The sin, cos and atan kernels are the classic single-precision minimax polynomials (degree 7, 8 and 9 on a quarter or
eighth turn) after Cody-Waite reduction; no libm is used because no two libms agree on all points. tanh is a rational
function of degree 4 over 4 in the square, fitted by linear programming for the least maximum relative error on 0..9.02.
"""

from firmware_py.core.subset import Integer, f32, i32, kernel, sqrt

PI = f32(3.14159265358979)
HALF_PI = f32(1.57079632679490)
TWO_PI = f32(6.28318530717959)
ONE = f32(1.0)
ZERO = f32(0.0)
HALF = f32(0.5)
TWO = f32(2.0)

QUARTERS_PER_RADIAN = f32(0.636619772367581)
QUARTER_1 = f32(1.5703125)  # pi/2 in three parts, the first two exact in few bits
QUARTER_2 = f32(4.83751296997070e-4)
QUARTER_3 = f32(7.54978995489188e-8)
ANGLE_LIMIT = f32(1000.0)  # [rad] reduction is accurate to 1e-7 up to here

SIN_3 = f32(-1.6666654611e-1)
SIN_5 = f32(8.3321608736e-3)
SIN_7 = f32(-1.9515295891e-4)
COS_4 = f32(4.166664568298827e-2)
COS_6 = f32(-1.388731625493765e-3)
COS_8 = f32(2.443315711809948e-5)
ATAN_3 = f32(-3.33329491539e-1)
ATAN_5 = f32(1.99777106478e-1)
ATAN_7 = f32(-1.38776856032e-1)
ATAN_9 = f32(8.05374449538e-2)
TAN_EIGHTH = f32(0.414213562373095)
QUARTER_PI = f32(0.785398163397448)
TANH_LIMIT = f32(9.02)  # from here on tanh rounds to 1
TANH_2 = f32(1.33797657e-1)  # over
TANH_4 = f32(3.49408947e-3)
TANH_6 = f32(2.05843183e-5)
TANH_8 = f32(1.33201119e-8)
TANH_UNDER_2 = f32(4.67130810e-1)
TANH_UNDER_4 = f32(2.58712866e-2)
TANH_UNDER_6 = f32(3.28317973e-4)
TANH_UNDER_8 = f32(7.76247022e-7)


@kernel
def clamp(x: f32, low: f32, high: f32) -> f32:
    """Return x inside [low, high]; NaN becomes low."""
    if not x >= low:
        return low
    if x > high:
        return high
    return x


@kernel
def finite(x: f32) -> bool:
    """Return whether x is neither NaN nor infinite."""
    return bool(x - x == ZERO)


@kernel
def quarter_turns(x: f32) -> i32:
    """Return the number of quarter turns nearest to x [rad]."""
    turns = x * QUARTERS_PER_RADIAN
    if turns >= ZERO:
        return i32(turns + HALF)
    return i32(turns - HALF)


@kernel
def sin_quarter(x: f32) -> f32:
    """Return sin x for |x| <= pi/4."""
    square = x * x
    return x + x * square * (SIN_3 + square * (SIN_5 + square * SIN_7))


@kernel
def cos_quarter(x: f32) -> f32:
    """Return cos x for |x| <= pi/4."""
    square = x * x
    return ONE - HALF * square + square * square * (COS_4 + square * (COS_6 + square * COS_8))


@kernel
def reduced(x: f32, turns: Integer) -> f32:
    """Return x minus that many quarter turns."""
    count = f32(turns)
    return ((x - count * QUARTER_1) - count * QUARTER_2) - count * QUARTER_3


@kernel
def sine_ahead(angle: f32, quarters: Integer) -> f32:
    """Return the sine of an angle [rad] plus that many quarter turns, 0 or 1."""
    x = clamp(angle, -ANGLE_LIMIT, ANGLE_LIMIT)
    turns = quarter_turns(x)
    rest = reduced(x, turns)
    quadrant = (turns + quarters + 4000) % 4
    if quadrant == 0:
        return sin_quarter(rest)
    if quadrant == 1:
        return cos_quarter(rest)
    if quadrant == 2:
        return -sin_quarter(rest)
    return -cos_quarter(rest)


@kernel
def sin(angle: f32) -> f32:
    """Return the sine of an angle [rad]; beyond +-1000 rad it saturates, NaN counts as -1000."""
    return sine_ahead(angle, 0)


@kernel
def cos(angle: f32) -> f32:
    """Return the cosine of an angle [rad]; beyond +-1000 rad it saturates, NaN counts as -1000."""
    return sine_ahead(angle, 1)


@kernel
def atan_unit(x: f32) -> f32:
    """Return the arc tangent for 0 <= x <= 1."""
    base = ZERO
    y = x
    if x > TAN_EIGHTH:
        base = QUARTER_PI
        y = (x - ONE) / (x + ONE)
    square = y * y
    return base + (y + y * square * (ATAN_3 + square * (ATAN_5 + square * (ATAN_7 + square * ATAN_9))))


@kernel
def atan2(y: f32, x: f32) -> f32:
    """Return the angle of (x, y) [rad] in [-pi, pi]; 0 for the zero vector and for NaN."""
    high = abs(x)
    low = abs(y)
    steep = low > high
    if steep:
        high = abs(y)
        low = abs(x)
    if not high > ZERO or not finite(low) or not finite(high):
        return ZERO
    angle = atan_unit(low / high)
    if steep:
        angle = HALF_PI - angle
    if x < ZERO:
        angle = PI - angle
    if y < ZERO:
        return -angle
    return angle


@kernel
def asin(x: f32) -> f32:
    """Return the arc sine [rad]; arguments outside [-1, 1] saturate."""
    y = clamp(x, -ONE, ONE)
    return atan2(y, sqrt((ONE - y) * (ONE + y)))


@kernel
def wrap(angle: f32) -> f32:
    """Return the angle [rad] inside [-pi, pi]; beyond +-1000 rad it saturates first."""
    x = clamp(angle, -ANGLE_LIMIT, ANGLE_LIMIT)
    turns = quarter_turns(x * f32(0.25))
    return clamp(x - f32(turns) * TWO_PI, -PI, PI)


@kernel
def tanh(x: f32) -> f32:
    """Return tanh x, within 4e-7 of the exact one and inside [-1, 1]; NaN stays NaN."""
    if x > TANH_LIMIT:
        return ONE
    if x < -TANH_LIMIT:
        return -ONE
    square = x * x
    over = ONE + square * (TANH_2 + square * (TANH_4 + square * (TANH_6 + square * TANH_8)))
    under = ONE + square * (
        TANH_UNDER_2 + square * (TANH_UNDER_4 + square * (TANH_UNDER_6 + square * TANH_UNDER_8))
    )
    y = x * over / under
    if y > ONE:
        return ONE
    if y < -ONE:
        return -ONE
    return y
