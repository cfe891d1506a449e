"""The servo mapping of the original firmware: flap angle to 16-bit word to timer compare count.

One radian is 31290 words (65535 for 120 deg); words 0..65535 are pulses of 1..2 ms, counted at 21 MHz.
"""

from firmware_py.core.maths import clamp
from firmware_py.core.structs import Control, Parameters
from firmware_py.core.subset import f32, i32, kernel

WORDS_PER_RADIAN = f32(31290.0)
WORD_CENTRE = f32(32767.0)
WORD_MAX = f32(65535.0)
COUNT_1MS = 21000  # timer counts of the shortest pulse, and of the range


@kernel
def word_of_angle(angle: f32, trim: f32) -> i32:
    """Return the servo word of a flap angle [rad] with the servo's trim [words]; NaN gives 0."""
    return i32(clamp(angle * WORDS_PER_RADIAN + WORD_CENTRE + trim, f32(0.0), WORD_MAX))


@kernel
def count_of_word(word: i32) -> i32:
    """Return the timer compare count of a servo word 0..65535."""
    return i32(COUNT_1MS + word * COUNT_1MS // 65535)


@kernel
def drive_servos(parameters: Parameters, control: Control) -> None:
    """Write the four words and timer counts of the commanded flap angles."""
    for flap in range(4):
        angle = parameters.direction[flap] * control.flap[flap]
        word = word_of_angle(angle, parameters.trim[flap])
        control.word[flap] = word
        control.count[flap] = count_of_word(word)
