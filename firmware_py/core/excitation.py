"""The excitation: a known signal on top of the inputs, for identification; off unless a parameter switches it on.

The multisine's lines are the odd multiples of 0.05 Hz from the lower to the upper frequency. The four inputs take turns: u1
gets the first, u2 the second, and so on. So no two inputs share a line, and all can be excited at once. The effects of
squares and products of inputs fall on even multiples, which are not evaluated. The phases are pseudo-random and change
every 22 s: a realisation has 2 s in which the response settles and a period of 20 s, so that the nonlinear part of
the response varies between realisations. After 16 realisations the first one follows again. The chirp sweeps the
band every 20 s and excites one input at a time.
"""

from firmware_py.core.maths import HALF, TWO_PI, ZERO, clamp, cos, sin
from firmware_py.core.structs import EXCITE_CHIRP, EXCITE_OFF, Control, Parameters
from firmware_py.core.subset import Integer, f32, i32, kernel, sqrt

PERIOD = 2000  # ticks
REALISATION = 2200  # ticks: 2 s to settle, and a period
REALISATIONS = 16
PHASES = 8191  # a prime: squares of the remainders are well mixed
ODD_LINES_PER_HZ = f32(10.0)
INPUTS = 4
TICK = f32(0.01)
SWEEP = f32(0.025)  # half of 1 / period [1/s]
NYQUIST = f32(50.0)  # [Hz]; bounds the work of a tick for any parameters
ROOT_2 = f32(1.41421356)


@kernel
def phase(line: Integer, realisation: Integer) -> f32:
    """Return the phase [rad] of a line in a realisation: pseudo-random, and the same on every machine."""
    mixed = (37 * line + 101 * realisation + 17) % PHASES
    mixed = (mixed * mixed + line) % PHASES
    mixed = (mixed * mixed + realisation) % PHASES
    return f32(TWO_PI * f32(mixed) / f32(PHASES))


@kernel
def multisine(first: Integer, last: Integer, tick: Integer) -> f32:
    """Return the sum of every fourth odd line from `first` to `last`, of rms 1; line n is the multiple 2 n + 1."""
    if last < first:
        return ZERO
    lines = (last - first) // INPUTS + 1
    realisation = tick // REALISATION
    total = ZERO
    for index in range(lines):
        line = first + INPUTS * index
        turn = ((2 * line + 1) * (tick % REALISATION)) % PERIOD
        total = total + cos(TWO_PI * f32(turn) / f32(PERIOD) + phase(line, realisation))
    return f32(total * sqrt(f32(2.0) / f32(lines)))


@kernel
def chirp(low: f32, high: f32, tick: Integer) -> f32:
    """Return the sweep from `low` to `high` [Hz], of rms 1."""
    t = TICK * f32(tick)
    turns = t * (low + SWEEP * (high - low) * t)
    return ROOT_2 * sin(TWO_PI * (turns - f32(i32(turns))))


@kernel
def line_above(frequency: f32) -> i32:
    """Return the first line at or above a frequency [Hz]."""
    return i32(frequency * ODD_LINES_PER_HZ + HALF)


@kernel
def excite(parameters: Parameters, control: Control) -> None:
    """Add the excitation of this tick to the inputs u; call it once per tick."""
    tick = control.excite_tick
    if tick < 0 or tick >= REALISATION * REALISATIONS:
        tick = i32(0)
    low = clamp(parameters.excite_low, ZERO, NYQUIST)
    high = clamp(parameters.excite_high, ZERO, NYQUIST)
    first = line_above(low)
    last = i32(line_above(high) - 1)
    for i in range(INPUTS):
        control.excitation[i] = ZERO
        if parameters.excite_kind != EXCITE_OFF and parameters.excite_rms[i] > ZERO:
            wave = ZERO
            if parameters.excite_kind == EXCITE_CHIRP:
                wave = chirp(low, high, i32(tick % PERIOD))
            else:
                wave = multisine(first + i, last, tick)
            control.excitation[i] = parameters.excite_rms[i] * wave
            control.u[i] = control.u[i] + control.excitation[i]
    control.excite_tick = i32((tick + 1) % (REALISATION * REALISATIONS))
    if parameters.excite_kind == EXCITE_OFF:
        control.excite_tick = i32(0)
