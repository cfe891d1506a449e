"""Flights through another core, open loop: `floaty replay`."""

import json
from math import nan
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pyarrow as pa
import pytest

from firmware_py.config import parameters_of
from firmware_py.core.structs import MODE_FLY
from firmware_py.core.subset import f32, i32
from firmware_py.core_runner import CoreBlocks
from hil import LabError, Run, fly, load_run
from hil.config import load_config
from hil.laboratory.replay import WRAP_US, Shadowed, _with_replay, misses, replay
from support.command import Cli

STATES = [*"xyz", "vx", "vy", "vz", "roll", "pitch", "yaw", *"pqr", *(f"flap_{n}" for n in (1, 2, 3, 4))]
COUNTS = ["fused", "refused", "jumps", "too_old", "invalid", "bounded", "resets"]
FAULTS = (
    "mocap.outlier@0.3", "mocap.dropout@0.5:0.1", "imu.bias.r@0.2:0.4=10", "push.y@0.6=2", "imu.silent@0.9:0.1",
)  # fmt: skip


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return fly("hover", tmp_path_factory.mktemp("replay") / "run", duration_s=1.6, faults=FAULTS)


def replayed(run: Run, folder: Path, *overrides: str, profile: str = "floaty") -> Run:
    replay(run.request, run.hash, load_config(profile, (*run.request.overrides, *overrides)), folder)
    return load_run(folder)


@pytest.mark.long
def test_the_core_that_flew_is_replayed_exactly(flown: Run, tmp_path: Path) -> None:
    run = replayed(flown, tmp_path / "again")
    assert run.hash == flown.hash
    log = {name: run.log.column(name).to_numpy() for name in run.log.column_names}
    known = np.isfinite(log["replay.x"])
    assert (~known).sum() < 3
    for names, group in ((STATES, "estimate"), (COUNTS, "estimator"), (["u1", "u2", "u3", "u4"], "control")):
        for name in names:
            assert (log[f"replay.{name}"] == log[f"{group}.{name}"])[known].all(), name
    assert log["replay.fused"].max() > 30
    assert run.units["replay.vx"] == "m/s"
    assert misses(run.folder)[0] == misses(run.folder)[1]


@pytest.mark.long
def test_another_core_gets_the_inputs_of_the_flight_and_moves_nothing(flown: Run, tmp_path: Path) -> None:
    gates = ("estimator.gate_sigma=1", "estimator.gate_position=0.001", "estimator.gate_attitude=0.01")
    strict = replayed(flown, tmp_path / "strict", *gates)
    original = {name: flown.log.column(name) for name in flown.log.column_names}
    assert all(strict.log.column(name).equals(values) for name, values in original.items())
    by, of_strict = misses(strict.folder)
    assert of_strict.refused > by.refused + 5
    assert of_strict.fused < by.fused
    lqr = replayed(flown, tmp_path / "lqr", "logic.controller=lqr")
    assert misses(lqr.folder)[0] == misses(lqr.folder)[1]  # the commands that flew moved the flaps
    assert not np.array_equal(lqr.log.column("replay.u1"), lqr.log.column("control.u1"))


def test_the_second_core_keeps_its_own_commands_and_estimates_with_those_that_flew() -> None:
    beside = load_config(overrides=("logic.controller=lqr",))
    made = CoreBlocks(parameters_of(load_config()), lambda blocks: Shadowed(blocks, beside))
    shadow = made.run._shadow  # type: ignore[attr-defined]
    for name in ("reset", "estimate", "control", "estimate"):
        made.data.fields.mode, made.data.fields.pose_quaternion[0] = i32(MODE_FLY), 1.0
        made.estimator.fields.now[:3] = shadow.estimator.fields.now[:3] = (0.02, -0.03, 0.05)
        own = shadow.control.bytes()
        made.run.call(name)
    assert shadow.control.bytes() == own != made.control.bytes()
    assert shadow.estimator.bytes() == made.estimator.bytes()


def test_a_row_shows_what_the_second_core_knew_then_through_the_clock_s_wrap_and_boots() -> None:
    def core(*ticks: tuple[int, int]) -> Shadowed:
        rows = [
            (us % WRAP_US, np.full(16, n, f32), np.full(4, -n, f32), (n,) * len(COUNTS)) for us, n in ticks
        ]
        return cast(Shadowed, SimpleNamespace(rows=rows))

    made = [core(*((WRAP_US + 10_000 * n, n + 3) for n in (-2, -1, 0, 1))), core((WRAP_US + 20_000, 7))]
    seen = {-25_000: nan, -20_000: 1, -10_001: 1, -10_000: 2, 0: 3, 15_000: 4, 20_000: 7, 99_000: 7}
    log = _with_replay(made, pa.table({"t": [WRAP_US + at_us for at_us in seen]}))
    for name, sign in (("x", 1), ("u4", -1), ("resets", 1)):
        assert log.column(f"replay.{name}").to_pylist() == pytest.approx(
            [sign * n for n in seen.values()], nan_ok=True
        )


@pytest.mark.long
def test_the_command_shows_both_and_the_report_draws_them(flown: Run, cli: Cli, tmp_path: Path) -> None:
    assert cli("replay", flown.folder, "--set", "predictor.enabled=false", "--out", tmp_path / "late") == 0
    assert "Replay" in (tmp_path / "late" / "report.html").read_text(encoding="utf-8")
    flew, other = misses(tmp_path / "late")
    assert f"{100 * flew.position:.4g}" in cli.out
    assert f"{100 * other.position:.4g}" in cli.out
    assert flew.attitude < other.attitude  # the predictor was worth it
    assert cli("replay", flown.folder, "--out", tmp_path / "late") == 2
    assert "exists and is not empty" in cli.err


def test_what_is_not_flown_again_is_refused(flown: Run, cli: Cli, tmp_path: Path) -> None:
    with pytest.raises(LabError, match=r"flown again, its hash is \w{16}, not 0{16}: another version"):
        replay(flown.request, "0" * 64, load_config(), tmp_path / "other")
    result = json.loads((flown.folder / "result.json").read_text(encoding="utf-8"))
    copy = tmp_path / "real"
    copy.mkdir()
    (copy / "log.parquet").write_bytes((flown.folder / "log.parquet").read_bytes())
    (copy / "result.json").write_text(json.dumps({**result, "board": "real"}), encoding="utf-8")
    assert cli("replay", copy) == 2
    assert "only flights in lockstep on c or python are replayed" in cli.err
    assert cli("replay", flown.folder, "--set", "predictor.enabeld=true") == 2
    assert "did you mean" in cli.err
