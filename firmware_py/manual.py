"""Flap positions from outside: angles (the original's `extCtrl.*`) or servo words (`motorPowerSet.*`, which win)."""

import numpy as np
from numpy.typing import NDArray

from firmware_py.core.servo import WORD_CENTRE, WORDS_PER_RADIAN
from firmware_py.core.structs import Input, Parameters
from firmware_py.core.subset import i32
from firmware_py.supervisor import Manual


class ManualFlaps:
    """Keeps the requested angles and words; `apply` brings them into force after a change."""

    def __init__(self, parameters: Parameters, data: Input) -> None:
        self.mode = Manual.OFF
        self.angles = np.zeros(4)  # (4,) [rad] of flaps 1..4, before the servos' trims
        self.words = np.zeros(4)  # (4,) [1/65535 of the servo range]
        self.use_words = False
        self._parameters = parameters  # the core's parameters and input, as fields
        self._data = data

    def apply(self) -> None:
        """Hand flap angles and mode to the core."""
        self._data.manual_mode = i32(Manual.ANGLES if self.use_words else self.mode)
        self._data.manual[:] = self._angles_of_words() if self.use_words else self.angles

    def _angles_of_words(self) -> NDArray[np.float64]:
        """Return the angles which the core's servo mapping, which truncates, turns into just these words."""
        untrimmed = self.words + 0.5 - float(WORD_CENTRE) - self._parameters.trim
        return self._parameters.direction * untrimmed / float(WORDS_PER_RADIAN)
