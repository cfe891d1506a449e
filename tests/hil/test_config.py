"""Profiles: strict, typed, and every mistake is one line that names key, value and what is allowed."""

from pathlib import Path

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core.structs import Parameters
from firmware_py.logic.laws import SHIPPED_LAWS
from hil.config import LabConfig, load_config, profile_names, read_config, settings_of
from hil.errors import LabError


@pytest.mark.long
def test_shipped_profiles_load() -> None:
    assert profile_names() == [
        "as-flown", "cad", "crazyflie", "crazyflie-brushless", "crazyflie-decks", "design-best",
        "design-double", "design-flat", "design-half", "design-paper", "floaty", "lqr", "original",
    ]  # fmt: skip
    for name in profile_names():
        config = load_config(name)
        assert LabConfig.model_validate(config.model_dump()) == config, (
            "each value, also a default, is in its range"
        )


def test_as_flown_differs_from_floaty_in_gains_limits_and_tracker_only() -> None:
    floaty, flown = (load_config(name).model_dump() for name in ("floaty", "as-flown"))
    assert {key for key in floaty if floaty[key] != flown[key]} == {"controller", "limits", "tracker"}
    assert flown["controller"]["gain_roll"] == 0.2


def test_every_parameter_of_the_core_comes_from_the_profile() -> None:
    marked = load_config()
    block = parameters_of(marked)
    unset = {name for name in Parameters.dtype.names or () if not np.any(block.memory[name])}
    # `target` is the set-point, zero by design; the gains of pitch are zero in the tuned set; nothing is excited
    assert unset == {"target", "gain_pitch", "gain_q", "opening_min", "excite_kind", "excite_rms"}


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("tunnel.speed=9.5", lambda c: c.tunnel.speed == 9.5),
        ("predictor.enabled=false", lambda c: c.predictor.enabled is False),
        ("tunnel.turbulence=T1", lambda c: c.tunnel.turbulence == "T1"),
        ('tunnel.turbulence="none"', lambda c: c.tunnel.turbulence == "none"),
        ("servo.trim[1]=-4000", lambda c: c.servo.trim == (-3600, -4000, -9000, 6200)),
        ("tunnel.side_wind=[0.0, 1.5, 0.0]", lambda c: c.tunnel.side_wind == (0.0, 1.5, 0.0)),
        ("plant.limits.radius=0.3", lambda c: c.plant.limits.radius == 0.3),
    ],
)
def test_an_override_reaches_its_value(override: str, value: object) -> None:
    assert callable(value)
    assert value(load_config("floaty", [override]))


def test_a_profile_builds_on_another(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('base = "as-flown"\n[tunnel]\nspeed = 9.75\n')
    (tmp_path / "mine2.toml").write_text('base = "mine.toml"\n[controller]\ngain_z = 2.5\n')
    config = load_config(str(tmp_path / "mine2.toml"))
    assert (config.tunnel.speed, config.controller.gain_z, config.controller.gain_roll) == (9.75, 2.5, 0.2)
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "far.toml").write_text('base = "near.toml"\n')
    (tmp_path / "below" / "near.toml").write_text('base = "../mine2.toml"\n')
    assert load_config(str(tmp_path / "below" / "far.toml")) == config, (
        "each base is looked for beside its own file"
    )
    (tmp_path / "mine.toml").write_text('base = "below/near.toml"\n')
    with pytest.raises(LabError, match=r"leads back to itself$"):
        load_config(str(tmp_path / "below" / "far.toml"))


def test_own_files_lie_beside_the_profile_that_names_them_and_typed_ones_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("base", "mine", "here"):
        (tmp_path / folder).mkdir()
    own = 'controller = "law.py"\nestimator = "../far.py"\ngain = 2.0\n[robot]\nbody = "robot.py"\n'
    (tmp_path / "base" / "base.toml").write_text(f'base = "floaty"\n[logic]\n{own}')
    (tmp_path / "mine" / "mine.toml").write_text(
        'base = "../base/base.toml"\n[logic]\nestimator = "own.py"\n'
    )
    monkeypatch.chdir(tmp_path / "here")
    (shipped, law), *_ = SHIPPED_LAWS.items()

    def found(profile: str, *overrides: str) -> tuple[str, ...]:
        config = read_config(profile, overrides)
        files = config.logic.controller, config.logic.estimator, config.robot.body
        assert config.logic.values == {"gain": 2.0}
        return tuple(one.removeprefix(f"{tmp_path}/") for one in files)

    assert found("../base/base.toml") == ("base/law.py", "far.py", "base/robot.py")
    mine = str(tmp_path / "mine" / "mine.toml")
    assert found(mine) == ("base/law.py", "mine/own.py", "base/robot.py")
    typed = "logic.controller=typed.py", "logic.estimator=", "robot.body=crazyflie"
    assert found(mine, *typed) == ("here/typed.py", "", "crazyflie")
    named = f"logic.controller={shipped}", f"logic.estimator={shipped}", "robot.body=sub/own.py"
    assert found(mine, *named) == (law, f"here/{shipped}", "here/sub/own.py")


def test_the_first_three_of_many_mistakes_are_named_and_values_that_no_profile_has_are_refused() -> None:
    wrong = [f"controller.{name}=nan" for name in ("gain_y", "gain_z", "gain_roll", "gain_p")]
    with pytest.raises(LabError) as refused:
        load_config(overrides=wrong)
    assert len({text.partition(" = ")[0] for text in str(refused.value).split("; ")} & {
        one.partition("=")[0] for one in wrong}) == 3  # fmt: skip
    for value, shown in ((None, "None"), ({1}, "{1}"), ([1, None], "None"), ({}, "{}")):
        with pytest.raises(LabError) as refused:
            settings_of({"a.b": value})  # type: ignore[dict-item]
        allowed = "expected a number, text, True, False, or a list of them"
        assert str(refused.value) == f"overrides: a.b = {shown}: {allowed}"
    with pytest.raises(
        LabError, match=r"^--set servo\.trim\[4\]=1: trim has no element \[4\] in this profile$"
    ):
        load_config(overrides=["servo.trim[4]=1"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[controller\n", "not TOML"),
        ('base = "self.toml"\n', "leads back to itself"),
        ("base = 3\n", "expected the name or path"),
        (f"base = {'[' * 5000}", "not TOML: maximum recursion depth"),
        ("[tunnel]\nspeed = 10\n", r"model: missing"),
    ],
)
def test_a_broken_profile_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "self.toml"
    path.write_text(text)
    with pytest.raises(LabError, match=message):
        load_config(str(path))
