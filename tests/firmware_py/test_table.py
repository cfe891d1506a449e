"""Every number that clients see is declared once, at its field."""

import re

import numpy as np
import pytest

from firmware_py.core.structs import Parameters
from firmware_py.table import BLOCKS, CORE_PARAMETERS, CORE_VARIABLES, OF_PROFILE, on_board, value_in
from firmware_py.wire.toc import MAX_NAME
from hil.config import load_config

PARAMETERS = {parameter.name: parameter for parameter in CORE_PARAMETERS}
VARIABLES = {variable.name: variable for variable in CORE_VARIABLES}


@pytest.mark.parametrize("table", [CORE_PARAMETERS, CORE_VARIABLES], ids=["parameters", "variables"])
def test_names_are_unique_and_fit_a_table_of_contents(table: tuple[object, ...]) -> None:
    names = [one.name for one in table]
    assert len(set(names)) == len(names)
    assert max(map(len, names)) <= MAX_NAME + 1  # with the dot


def test_only_hardware_parameters_of_the_core_are_not_settable() -> None:
    settable = {parameter.place.field for parameter in CORE_PARAMETERS}
    assert set(Parameters.dtype.names or ()) - settable == {"age_measured", "direction", "gyro_scale", "home"}


ORDER = ("w x y z", "x y z", "X Y Z", "1 2 3 4", "roll pitch yaw")


def test_a_name_maps_to_its_own_element() -> None:
    families: dict[tuple[str, str], dict[str, int]] = {}
    shapes = {
        name: kind.shape for fields in BLOCKS.values() for name, (kind, *_) in fields.dtype.fields.items()
    }
    for one in (*CORE_VARIABLES, *CORE_PARAMETERS):
        found = re.fullmatch(r"(.*?)(roll|pitch|yaw|[wxyzXYZ]|[1-4])((?:_\w+|Variance)?)", one.name)
        if found and one.place.index and one.place.field != "target":
            number = int(np.ravel_multi_index(one.place.index, shapes[one.place.field]))
            families.setdefault((one.place.field, found[1] + found[3]), {})[found[2]] = number
    families = {key: members for key, members in families.items() if len(members) > 1}
    assert len(families) > 15
    for key, members in families.items():
        order = [name for listed in ORDER if set(members) == set(listed.split()) for name in listed.split()]
        steps = np.diff([members[name] for name in order]).tolist()
        assert steps in ([1] * len(steps), [17] * len(steps)), (key, members)
    first = {key[1]: min(members.values()) for key, members in families.items()}
    assert (first["controller.u"], first["extCtrl.m"], first["stateEstimate._rate"]) == (0, 0, 9)
    assert [VARIABLES[f"kalman.var{axis}"].place.index for axis in ("X", "PZ")] == [(0, 0), (5, 5)]
    assert VARIABLES["Uncertainty.P_x_vx"].place.index == (0, 3)
    assert VARIABLES["stateEstimate.yaw_rate"].place.index == (11,)
    assert PARAMETERS["setpoint.Yaw"].place == PARAMETERS["extCtrl.target_yaw"].place


def test_bounds_of_a_client_are_those_of_the_profile_in_its_unit_and_sign() -> None:
    timeout, gain = PARAMETERS["supervisor.poseTimeout"], PARAMETERS["extCtrl.y_P"]
    assert (timeout.low, timeout.high, timeout.unit, on_board(timeout.key)) == (
        20, 5000, "ms", ("supervisor.poseTimeout", 1e-3),
    )  # fmt: skip
    assert (gain.low, gain.high, gain.unit, on_board(gain.key)) == (-20, 20, "rad/m", ("extCtrl.y_P", -1))
    assert on_board("extCtrl.y_P") == ("extCtrl.y_P", 1)


def test_every_key_of_the_table_has_a_value_inside_its_bounds_in_the_default_profile() -> None:
    config = load_config()
    for key, parameter in OF_PROFILE.items():
        assert parameter.low <= value_in(config, key) / parameter.scale <= parameter.high, key
    assert value_in(config, "servo.trim[2]") == config.servo.trim[2]
