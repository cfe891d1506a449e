"""Identification of planted robots: linear ones that scipy simulates, in coloured gusts, as telemetry.csv."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter, ss2tf

from firmware_py.config import parameters_of
from firmware_py.core.controller import allocate
from firmware_py.core.servo import drive_servos
from firmware_py.core.structs import Control
from ground_station.telemetry_log import POSE_COLUMNS, TIME_COLUMN
from hil.config import LabConfig, load_config
from hil.errors import LabError
from hil.research.design.axes import PITCH as PITCH_AXIS
from hil.research.identify.identify import IDENTIFIED, UNKNOWN, Identification, check_held_out, identify
from hil.research.identify.record import BOARD_COLUMN, EXCITATIONS, INPUTS, RATES, load_record
from hil.research.identify.response import one_step
from hil.research.identify.robots import write_profile
from hil.research.identify.two_controllers import closed_loop
from support.command import Cli

PITCH = {
    "pitch_u2": -900.0, "pitch_rate": -22.0, "pitch_pitch": -1300.0, "pitch_vx": -130.0, "x_u2": -0.9, "x_pitch": 2.7,
    "x_vx": -0.7, "lag": 0.045,
}  # fmt: skip
Array = NDArray[np.float64]
MS = 1e-3
BEGIN_MS, REALISATION_TICKS = 3000, 2200
ACTUATION_MS = 4
JUMP = (
    0.2  # of the inputs from tick to tick: a pose arrives in every second one, and rows show always the same
)
Change = Callable[[dict[str, Array]], dict[str, Array]]


def simulated(inputs: Array, matrix: Array, column: Array) -> Array:
    """The states (N, 5), flap, pitch, rate, x, vx, of inputs at 1 kHz."""
    A, B, *_ = cont2discrete((matrix, column, np.eye(5), np.zeros((5, 1))), MS)
    numerators, denominator = ss2tf(A, B, np.eye(5), np.zeros((5, 1)))
    return np.stack([lfilter(row, denominator, inputs) for row in numerators], axis=1)


@cache
def flown(
    seed: int, seconds: float = 136.0, rms: float = 0.05, disturbance: float = 1.0, **changed: float
) -> dict[str, Array]:
    """The columns of telemetry.csv of a robot that a multisine on u2 excites and gusts of 30 ms disturb."""
    rng = np.random.default_rng(seed)
    k = PITCH | changed
    matrix = np.array([
        [-1 / k["lag"], 0, 0, 0, 0],
        [0, 0, 1, 0, 0],
        [k["pitch_u2"], k["pitch_pitch"], k["pitch_rate"], 0, k["pitch_vx"]],
        [0, 0, 0, 0, 1],
        [k["x_u2"], k["x_pitch"], -0.04, 0, k["x_vx"]],
    ])  # fmt: skip
    tick = np.arange(round(seconds * 100))
    lines = np.array([5 + 8 * index for index in range(19)]) / 20
    t = 0.01 * tick
    realisation = np.maximum(tick - BEGIN_MS // 10, 0) // REALISATION_TICKS
    phase = 2 * np.pi * rng.random((realisation.max() + 1, 19))
    r = np.cos(2 * np.pi * np.outer(t, lines) + phase[realisation]).sum(axis=1)
    r = np.where(tick >= BEGIN_MS // 10, r, 0.0)
    r *= rms * np.sqrt(2 / len(lines))
    u = r * (1.0 + JUMP * (-1.0) ** tick)
    held = np.repeat(u, 10)
    late = np.concatenate([np.zeros(ACTUATION_MS), held[:-ACTUATION_MS]])
    states = simulated(late, matrix, np.array([[1 / k["lag"]], [0], [0], [0], [0]]))
    gust = lfilter([1 - np.exp(-1 / 30)], [1, -np.exp(-1 / 30)], rng.normal(0, 60 * disturbance, len(held)))
    states = states + simulated(gust, matrix, np.array([[0.0], [0], [1], [0], [0]]))
    rate = lfilter(np.ones(10) / 10, [1.0], states[:, 2])
    rows = np.arange(20, len(held), 20)
    zero = np.zeros(len(rows))
    columns = {BOARD_COLUMN: rows.astype(float), TIME_COLUMN: MS * rows + 0.0016}
    pose = [MS * (rows - 40), states[rows - 40, 3], zero, zero + 1.15, zero, states[rows - 40, 1], zero]
    noise = [0.0, 5e-4, 5e-4, 5e-4, 4e-3, 4e-3, 4e-3]
    columns |= {
        name: value + rng.normal(0, spread, len(rows))
        for name, value, spread in zip(POSE_COLUMNS, pose, noise, strict=True)
    }
    columns |= dict.fromkeys((*INPUTS, *EXCITATIONS, *RATES), zero)
    columns |= {
        INPUTS[1]: 0.5 * (u[rows // 10] + u[rows // 10 - 1]),
        EXCITATIONS[1]: r[rows // 10],
        RATES[1]: rate[rows] + rng.normal(0, 0.02, len(rows)),
    }
    return columns | {"supervisor.state []": zero + 2}


def flight(seed: int, seconds: float = 136.0, **changed: float) -> dict[str, Array]:
    """The columns of a flight that may be changed."""
    return dict(flown(seed, seconds, **changed))


def written(folder: Path, columns: dict[str, Array], *changes: Change) -> Path:
    for change in changes:
        columns = change(columns)
    path = folder / "telemetry.csv"
    header = ",".join(columns)
    np.savetxt(
        path, np.stack(list(columns.values()), axis=1), "%.9g", ",", header=header, comments="",
        encoding="utf-8",
    )  # fmt: skip
    return path


def identified(folder: Path, columns: dict[str, Array], *changes: Change) -> Identification:
    return identify([load_record(written(folder, columns, *changes), "floaty")])


def keep(chosen: Callable[[int], NDArray[np.bool_]]) -> Change:
    return lambda columns: {name: values[chosen(len(values))] for name, values in columns.items()}


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "kept"),
    [
        (1, lambda n: np.ones(n, bool)),
        (2, lambda n: np.random.default_rng(3).random(n) > 0.2),
        (4, lambda n: np.arange(n) % 2 == 0),
    ],
    ids=["all rows", "a fifth lost", "another rate"],
)
def test_a_planted_robot_is_found_in_coloured_gusts(
    tmp_path: Path, seed: int, kept: Callable[[int], NDArray[np.bool_]]
) -> None:
    found = identified(tmp_path, flight(seed), keep(kept))
    for name in ("pitch_u2", "pitch_rate", "pitch_pitch", "lag"):
        constant = found.constant(name)
        value, half = constant.joint
        assert constant.verdict == IDENTIFIED, (name, constant.why)
        assert abs(value - PITCH[name]) <= 1.5 * half, name
        assert value == pytest.approx(PITCH[name], rel=0.10), name


@pytest.mark.parametrize(
    ("seconds", "change", "reason"),
    [
        (40.0, keep(lambda n: np.ones(n, bool)), "1 realisations of 22 s; at least 4"),
        (136.0, lambda columns: columns | {EXCITATIONS[1]: 0 * columns[EXCITATIONS[1]]}, "no excitation.*, or identify"),
        (136.0, keep(lambda n: np.random.default_rng(3).random(n) > 0.5),
            r": (49|50|51)% of the telemetry's rows are missing; at most 30% may be$"),
        (136.0, lambda columns: columns | {BOARD_COLUMN: 0.5 * columns[BOARD_COLUMN]}, "not the same sum|realisations"),
        (136.0, lambda columns: columns | {BOARD_COLUMN: 1.02 * columns[BOARD_COLUMN]}, "not the same sum of lines"),
        (136.0, keep(lambda n: np.arange(n) % 8 == 0), "samples in a period|too far apart"),
    ],
    ids=["too short", "no excitation", "half the rows lost", "clock twice too slow", "clock 2 % fast", "6 rows a second"],
)  # fmt: skip
def test_a_poor_log_is_refused(tmp_path: Path, seconds: float, change: Change, reason: str) -> None:
    with pytest.raises(LabError, match=reason):
        identified(tmp_path, flight(5, seconds), change)


@pytest.mark.long
@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ("same", "it is one of the fitted flights; expected another"),
        ("free", "no excitation in it"),
        ("other", "it excites no input of the fit"),
    ],
)
def test_an_unsuitable_validation_flight_is_refused_at_once(tmp_path: Path, wrong: str, reason: str) -> None:
    for name, columns in (("fit", flight(1)), ("held", flight(1 if wrong == "same" else 2))):
        (tmp_path / name).mkdir()
        if name == "held" and wrong != "same":
            excitation = columns[EXCITATIONS[1]]
            columns[EXCITATIONS[1]] = 0 * excitation
            columns[EXCITATIONS[0]] = excitation if wrong == "other" else 0 * excitation
        written(tmp_path / name, columns)
    fitted, held_out = (load_record(tmp_path / name / "telemetry.csv", "floaty") for name in ("fit", "held"))
    with pytest.raises(LabError, match=reason):
        check_held_out(held_out, [fitted])


@pytest.mark.parametrize(
    ("name", "reason"), [("runs", "name ends in .toml"), ("no/x.toml", "no is not a folder")]
)
@pytest.mark.parametrize("command", ["identify", "tune"])
def test_unwritable_file_is_refused(cli: Cli, tmp_path: Path, command: str, name: str, reason: str) -> None:
    out = tmp_path / name
    call = ("identify", "missing", "--profile-out", out) if command == "identify" else ("tune", "--out", out)
    assert reason in cli.refusal(*call)


@pytest.mark.long
def test_saturated_flaps_make_no_constant_believable(tmp_path: Path) -> None:
    found = identified(tmp_path, flight(6, rms=0.4))
    assert {constant.verdict for constant in found.constants if constant.joint[0] == constant.joint[0]} <= {
        UNKNOWN,
        "weak",
    }
    assert "limits" in found.constant("pitch_u2").why
    assert found.constant("pitch_u2").verdict == UNKNOWN


@pytest.mark.long
def test_an_unexcited_input_is_not_identifiable(tmp_path: Path) -> None:
    found = identified(tmp_path, flight(7))
    assert {found.constant(name).why for name in ("roll_u1", "yaw_rate", "z_u4")} == {
        "its axis is not excited"
    }


def test_another_robot_is_identified_without_what_holds_for_plates(tmp_path: Path) -> None:
    profile = tmp_path / "profile.toml"
    profile.write_text('base = "floaty"\n[robot]\nbody = "robot.py"\n')
    columns = flight(1, pitch_vx=-60.0)  # plates have pitch_pitch over the airspeed, -130
    found = identify([load_record(written(tmp_path, columns), str(profile))])
    value, half = found.constant("pitch_vx").joint
    assert abs(value + 60.0) <= half < 40.0
    assert np.isnan([(*one.paper, one.truth) for one in found.constants]).all()


@pytest.mark.long
def test_the_intervals_hold_the_truth_of_most_constants(tmp_path: Path) -> None:
    hits = []
    for seed in range(10, 16):
        found = identified(tmp_path, flight(seed))
        for name in PITCH:
            value, half = found.constant(name).joint
            hits.append(abs(value - PITCH[name]) <= half)
    assert np.mean(hits) >= 0.85


def test_a_written_profile_has_what_was_identified_and_holds_the_mean_inputs_by_its_trim(
    tmp_path: Path,
) -> None:
    path, base, mean = tmp_path / "mine.toml", tmp_path / "base.toml", (0.02, -0.03, 0.05, 0.0)
    base.write_text('base = "floaty"\n[servo]\ndirection = [1, -1, -1, 1]\n')
    columns = flight(1)
    columns |= {name: columns[name] + value for name, value in zip(INPUTS, mean, strict=True)}
    found = identify([load_record(written(tmp_path, columns), str(base))])
    notice = write_profile(path, str(base), found)
    assert notice == "servo trim changed: the flights needed u1..u4 of 20, -30, 50, 0 mrad on the mean"
    before, after = load_config(str(base)), load_config(str(path))
    assert after.model.pitch_u2 == pytest.approx(-900, rel=0.1)
    assert after.model.flap_rate == pytest.approx(1 / 0.045, rel=0.1)
    assert after.model.roll_u1 == before.model.roll_u1
    assert "± " in path.read_text()
    estimate = found.estimate
    for (name, value), variance in zip(estimate.values.items(), np.diag(estimate.covariance), strict=True):
        curved = 0.0 if name == "delay" else 0.03 * abs(value)
        assert estimate.errors[name] == pytest.approx(1.96 * np.hypot(np.sqrt(variance), curved)), name
    known = json.loads(path.with_suffix(".json").read_text())
    spread = np.sqrt(np.diag(known["covariance"]))
    assert 1.96 * spread == pytest.approx(np.array([*known["half_widths"].values()]), rel=1e-6)
    assert servo_words(after, (0.0, 0.0, 0.0, 0.0)) == pytest.approx(servo_words(before, mean), abs=20)


def servo_words(config: LabConfig, u: tuple[float, ...]) -> list[int]:
    """Return the words that the core sends to the servos for four inputs."""
    parameters, control = parameters_of(config), Control.allocate()
    control.fields.u[:] = u
    allocate(parameters.fields, control.fields)
    drive_servos(parameters.fields, control.fields)
    return control.fields.word.tolist()


def test_the_papers_equations_find_no_damping_whatever_the_robot_has(tmp_path: Path) -> None:
    record = load_record(written(tmp_path, flight(8, 60.0)), "floaty")
    loop = closed_loop(record, PITCH_AXIS)
    assert abs(loop.starred[0]) < 0.1 * abs(PITCH["pitch_rate"])
    assert np.median((loop.acceleration / loop.angle).real / -(loop.w**2)) == pytest.approx(1.0, abs=0.15)


def test_the_true_constants_predict_the_next_row_best(tmp_path: Path) -> None:
    record = load_record(written(tmp_path, flight(3, 30.0)), "floaty")
    truth = PITCH | {"lag": PITCH["lag"], "delay": 1e-3 * ACTUATION_MS + 0.01}

    def error(**changed: float) -> float:
        _, measured, predicted = one_step(record, 1, truth | changed, 0.0)
        return float(np.std((measured - predicted)[200:]))

    _, measured, _ = one_step(record, 1, truth, 0.0)
    assert error() < 0.5 * np.std(np.diff(measured))  # of expecting no change
    assert error() < min(error(pitch_u2=-450.0), error(pitch_u2=-1800.0), error(lag=0.15))
