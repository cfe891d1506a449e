"""Flap angle to servo word to timer count: every recorded row of the original firmware, and no angle breaks out."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.config import parameters_of
from firmware_py.core import servo
from firmware_py.core.structs import MODE_MANUAL
from firmware_py.core.subset import Block
from firmware_py.core_runner import CoreBlocks, default_runner
from hil.config import load_config
from support.paths import VECTORS

ANGLES = json.loads((VECTORS / "servo_angles.json").read_text())["rows"]
WORDS = json.loads((VECTORS / "servo_word_to_count.json").read_text())

CONFIG = load_config()

any_number = st.floats(width=32)
any_four = st.tuples(*4 * (any_number,))


def drive(angles: tuple[float, ...], parameters: Block | None = None) -> Block:
    """Return the control block after one step with flap angles [rad] from outside."""
    parameters = parameters or parameters_of(CONFIG)
    core = CoreBlocks(parameters, default_runner)
    core.data.fields.mode = MODE_MANUAL
    core.data.fields.manual[:] = angles
    core.run.call("control")
    return core.control


@pytest.mark.long
def test_words_and_counts_of_300_flap_positions_are_the_original_firmwares() -> None:
    parameters = parameters_of(CONFIG)
    for row in ANGLES:
        fields = drive(row["flaps_rad"], parameters).fields
        assert fields.word.tolist() == row["words"]
        assert fields.count.tolist() == row["counts"]


def test_a_word_from_outside_is_that_of_its_servo_whatever_its_trim_and_direction() -> None:
    core = CoreBlocks(parameters_of(CONFIG), default_runner)
    core.parameters.fields.trim[:], core.parameters.fields.direction[:] = (0, 300, -700, 0), (1, -1, 1, -1)
    core.data.fields.mode, core.data.fields.by_words = MODE_MANUAL, 1
    for word in range(0, 65_536, 97):
        core.data.fields.words[:] = words = (word, 65_535 - word, (word + 20_000) % 65_536, word)
        core.run.call("control")
        assert core.control.fields.word.tolist() == list(words)


def test_every_word_has_the_count_of_the_original_firmwares_timer() -> None:
    got = [int(servo.count_of_word(np.int32(word))) for word in WORDS["words"]]
    assert got == WORDS["counts"]
    assert [WORDS["words"][0], WORDS["words"][-1]] == [0, 65535]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("angle", [math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-45])
@pytest.mark.parametrize("trim", [0.0, 12000.0, -12000.0])
def test_word_of_a_senseless_angle_is_a_word(angle: float, trim: float) -> None:
    assert 0 <= servo.word_of_angle(np.float32(angle), np.float32(trim)) <= 65535


@pytest.mark.long
@settings(deadline=None)
@given(any_four, any_four, any_four)
def test_no_angle_trim_or_direction_leaves_the_range_of_the_pulse(
    angles: tuple[float, ...], trim: tuple[float, ...], direction: tuple[float, ...]
) -> None:
    parameters = parameters_of(CONFIG)
    parameters.fields.trim[:] = trim
    parameters.fields.direction[:] = direction
    assert all(21_000 <= count <= 42_000 for count in drive(angles, parameters).fields.count)


def test_a_reversed_servo_turns_the_other_way_about_its_trimmed_centre() -> None:
    parameters = parameters_of(load_config(overrides=["servo.trim=[0, 100, 0, 0]"]))
    there = drive((0.1, 0.2, -0.3, 0.4), parameters).fields.word.tolist()
    parameters.fields.direction[:] = (1, -1, -1, -1)
    back = drive((0.1, 0.2, -0.3, 0.4), parameters).fields.word.tolist()
    assert back[0] == there[0] == 32767 + 3129
    for flap, centre in ((1, 32867), (2, 32767), (3, 32767)):
        assert abs((there[flap] - centre) + (back[flap] - centre)) <= 1
        assert there[flap] != back[flap]
