"""Own logic on its way to the board: checked, exported and compiled from a folder of the user's."""

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from firmware_py.config import LogicConfig, parameters_of
from firmware_py.core import model
from firmware_py.core.structs import MODE_FLY
from firmware_py.core_runner import CoreBlocks, CoreRunner, default_runner
from firmware_py.export.side_by_side import SideBySide
from firmware_py.logic.laws import SHIPPED_LAWS
from firmware_py.logic.loading import Logic, load_logic, translation_of
from hil.config import load_config
from support.command import Cli
from support.own_logic import LAW, make_project
from support.paths import ROOT, VECTORS

SHORT = ("hover", "--duration", "0.3", "--profile", "profile.toml")


@pytest.fixture
def project(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder outside the clone, with a law, in which the user stands."""
    make_project(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.long
def test_all_targets_are_equal_with_own_logic(cli: Cli, project: Path) -> None:
    assert cli("deploy", "check", *SHORT, "--set", "logic.after=60") == 0
    shown = cli.out
    assert "130 ticks, c beside plain, c-O0, c-O2, cortex-m4: no bit differs" in shown


@pytest.mark.long
def test_a_parameter_that_is_set_in_flight_reaches_every_target(project: Path) -> None:
    config, made = load_config("profile.toml"), []

    def side_by_side(blocks: CoreBlocks) -> CoreRunner:
        made.append(SideBySide(blocks, {"python": default_runner}))
        return made[0]

    core = CoreBlocks(parameters_of(config), side_by_side, load_logic(config.logic))
    core.data.fields.mode = MODE_FLY
    core.named["controller_own"].memory["gain_iy"] = 1.5
    core.parameters.fields.target[1] = 0.1
    core.run.call("control")
    assert made[0].targets[0].calls == 1
    assert made[0].targets[0].divergence is None


@pytest.mark.long
def test_exporting_from_a_user_s_folder_writes_the_c_that_is_checked(cli: Cli, project: Path) -> None:
    assert cli("deploy", "write", "app", "--profile", "profile.toml", "--set", "logic.gain_iy=0.5") == 0
    core = (project / "app" / "src" / "floaty_core.c").read_text(encoding="utf-8")
    assert core == translation_of(LogicConfig(controller=str(project / "controller.py"))).source
    assert str(project) not in core  # the same law is the same C wherever it lies
    assert ".gain_iy = 0.5f," in (project / "app" / "src" / "floaty_profile.c").read_text(encoding="utf-8")
    calls = (project / "app" / "src" / "floaty_calls.h").read_text(encoding="utf-8")
    hover = calls.partition("call_hover(")[2].partition("}")[0]
    assert re.findall(r"static \w+ (\w+);", hover) == ["guard", "controller_memory"], (
        "the gains are those in flight"
    )
    assert "&guard, &floaty_controller_own, &controller_memory)" in hover


# The laws that ship


def logic_of(profile: str, *overrides: str) -> Logic:
    logic = load_logic(load_config(profile, overrides).logic)
    assert logic is not None
    return logic


@pytest.mark.long
def test_the_original_law_is_the_original_firmwares_with_both_integrators_and_without_priorities() -> None:
    """All 300 recorded steps, each from reset: no state is left out, whether flaps saturate or not."""
    rows = json.loads((VECTORS / "original_controller.json").read_text())["rows"]
    overrides = ("allocation.hover_angle=0.393", "controller.limit_u=0.5895", "controller.limit_u3=0.5895")
    config = load_config("original", overrides)
    core = CoreBlocks(parameters_of(config), default_runner, load_logic(config.logic))
    for row in rows:
        core.data.fields.mode = 0
        core.run.call("control")
        core.data.fields.mode = MODE_FLY
        core.estimator.fields.now[:12] = row["state"]
        core.run.call("control")
        c = row["compound_c0_c3"]
        # the original interpolates a table of 512 sines: 1.9e-5, times the gains
        assert core.control.fields.u == pytest.approx((-c[1], -c[0], c[3], c[2]), abs=4e-5)
        assert core.control.fields.flap == pytest.approx(row["flaps_rad"], abs=2e-4)
    assert len(rows) == 300


def matrix(gains: dict[str, float]) -> np.ndarray:
    """Return K of u = -K x from the 16 numbers of the shipped law `lqr`."""
    K = np.zeros((4, 16))
    for row, names in enumerate((
        {1: "gain_y", 4: "gain_vy", 6: "gain_roll", 9: "gain_p"}, {0: "gain_x", 3: "gain_vx", 7: "gain_pitch", 10: "gain_q"},
        {8: "gain_yaw", 11: "gain_r"}, {2: "gain_z", 5: "gain_vz"},
    )):  # fmt: skip
        for state, name in names.items():
            K[row, state] = gains[name]
        K[row, 12:] = gains[f"gain_u{row + 1}"] * MIX[:, row] / 4
    return K


MIX = np.array([[1, 1, -1, -1], [1, -1, -1, 1], [-1, -1, -1, -1], [-1, 1, -1, 1]])


def discrete_model() -> tuple[np.ndarray, np.ndarray]:
    """Return the core's own model over one tick, column by column: the state, and inputs that hold."""
    parameters = parameters_of(load_config())
    one, none = np.float32(1.0), np.float32(0.0)

    def advanced(x: np.ndarray, command: np.ndarray) -> np.ndarray:
        x = x.astype(np.float32)
        work = [np.zeros(16, np.float32) for _ in range(2)]
        model.advance_state(parameters.fields, none, one, x, command[None, :].astype(np.float32), 0, *work)
        return x.astype(float)

    A = np.column_stack([advanced(column, np.zeros(4)) for column in np.eye(16)])
    B = np.column_stack([advanced(np.zeros(16), MIX[:, number]) for number in range(4)])
    return A, B


@pytest.mark.long
def test_the_lqr_s_gains_are_the_optimum_of_all_16_states_for_the_weights_that_its_tool_states() -> None:
    tool = runpy.run_path(str(ROOT / "tools" / "lqr_gains.py"))
    computed = tool["gains"](load_config())
    declared = logic_of("lqr").values
    assert declared == pytest.approx(computed, rel=1e-3)
    A, B = discrete_model()
    accepted = (0.05, 0.05, 0.03, 0.2, 0.2, 0.2, 0.15, 0.15, 0.1, 2.0, 2.0, 2.0)
    Q = np.diag([1 / limit**2 for limit in accepted] + [0.0] * 4)
    R = np.eye(4) / 0.1**2
    P = solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    assert matrix(dict(declared)) == pytest.approx(K, abs=2e-3 * np.abs(K).max())


@pytest.mark.parametrize("roll", [0.0, 0.05])
def test_the_lqr_feeds_all_16_states_back(roll: float) -> None:
    config = load_config("lqr")
    core = CoreBlocks(parameters_of(config), default_runner, load_logic(config.logic))
    core.data.fields.mode = MODE_FLY
    K = matrix(dict(logic_of("lqr").values))
    core.parameters.fields.opening_min, core.parameters.fields.opening_max = -10.0, 10.0
    for state in range(16):
        x = np.zeros(16)
        x[6] = roll
        x[state] += 0.03
        if state == 8:
            x[8] = 0.03
        core.estimator.fields.now[:] = x
        core.run.call("control")
        assert core.control.fields.u == pytest.approx(-K @ x, abs=2e-6), state
        assert core.control.fields.command == pytest.approx(MIX @ (-K @ x), abs=5e-6), state


@pytest.mark.long
def test_mypy_knows_the_types_in_a_module_of_the_users(tmp_path: Path) -> None:
    (tmp_path / "controller.py").write_text(LAW, encoding="utf-8")
    files = [tmp_path / "controller.py", *map(Path, SHIPPED_LAWS.values())]
    for file in files:
        done = subprocess.run(
            (sys.executable, "-m", "mypy", "--strict", "--config-file=", file), cwd=tmp_path, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout
    (tmp_path / "controller.py").write_text(LAW.replace("own.gain_iy *", "own.gain_jy *"), encoding="utf-8")
    done = subprocess.run(
        (sys.executable, "-m", "mypy", "--strict", "--config-file=", files[0]), cwd=tmp_path, check=False
    )
    assert done.returncode == 1
