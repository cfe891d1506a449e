"""What the research tools compute of random robots, flows and logs, to five digits.

If a change is meant: make approve.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from ground_station.trajectory import Goal
from hil import fly
from hil.config import LabConfig, load_config
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.research.design import optimise
from hil.research.design.authority import QUANTITIES, authorities, single
from hil.research.design.axes import AXES, DELAY, HEIGHT, NUISANCES, PITCH, ROLL, gains_in, robot_of
from hil.research.design.linear import point_of
from hil.research.design.loop import FREQUENCIES, Timing, build
from hil.research.design.margins import margins, pose_delay_margin, worst
from hil.research.design.sweeps import updrafts
from hil.research.design.tune import Flow, GainTask, by_regulator, cost, delay_margin, design, judged, motion
from hil.research.identify.flow import flow_of
from hil.research.identify.record import Array, Record
from hil.research.identify.response import LAG, one_step, outputs, response
from hil.research.identify.robots import KnownModel, beside, robots_of
from hil.research.identify.two_controllers import closed_loop, input_constant, two_controllers
from support.approved import approve, skip_unless, tiers, versions

NUMBERS = Path(__file__).with_name("research.json")
PACKAGES = ("numpy", "scipy", "control")
AGES_S = {"floaty": (0.0, 0.0433), "original": (0.028,)}  # of poses, by profile


def flat(value: Any) -> list[float]:
    """Return the numbers in anything, complex ones as two."""
    if isinstance(value, dict):
        return [number for one in value.values() for number in flat(one)]
    if isinstance(value, list | tuple):
        return [number for one in value for number in flat(one)]
    if hasattr(value, "__dataclass_fields__"):
        return flat([getattr(value, name) for name in value.__dataclass_fields__])
    if value is None or isinstance(value, str):
        return []
    array = np.asarray(value)
    pairs = np.stack([array.real, array.imag], -1) if np.iscomplexobj(array) else array
    return [float(f"{number:.7g}") for number in np.asarray(pairs, float).ravel().tolist()]


def noise(rng: np.random.Generator, *shape: int) -> NDArray[np.float64]:
    """Return numbers in -1..1 that are the same everywhere."""
    return np.asarray(rng.integers(-1000, 1001, shape) / 1000.0)


def spectrum(rng: np.random.Generator, width: int) -> NDArray[np.complex128]:
    """Return a spectrum (L, W, W) of accelerations, falling with the frequency."""
    columns = noise(rng, len(FREQUENCIES), width, width) + 1j * noise(rng, len(FREQUENCIES), width, width)
    both = np.einsum("lwk,lxk->lwx", columns, columns.conj())
    return np.asarray(both * (0.02 / (1.0 + FREQUENCIES**2))[:, None, None])


def task_of(number: int, config: LabConfig, timing: Timing) -> GainTask:
    """Return the requirements on an axis in a random flow."""
    axis, rng = AXES[number], np.random.default_rng(number)
    flow = Flow(spectrum(rng, len(axis.states) // 2), 0.01 * (number + 1), 0.03 * (number < 2))
    return GainTask(axis, flow, config, timing, 0.012)


def loops(number: int) -> dict[str, Any]:
    """Return what an axis' loop does with two profiles, three ages of poses and other robots than the model on board."""
    axis, found = AXES[number], {}
    for name in AGES_S:
        config, rng = load_config(name), np.random.default_rng(10 + number)
        robot = {key: value * (1.0 + 0.1 * noise(rng)) for key, value in robot_of(config).items()}
        robot |= dict.fromkeys(NUISANCES, 0.02)
        for age_s in AGES_S[name]:
            timing = Timing.of(config, age_s)
            task = task_of(number, config, timing)
            loop = build(axis, robot, config, timing)
            for gains in (gains_in(config, axis), by_regulator(axis, robot)):
                L = loop.open_loop(gains)
                found[f"{name} {age_s} {len(found)}"] = (
                    timing, loop.radius(gains), L[::60], margins(loop, gains), delay_margin(L), cost(loop, task, gains),
                    task.offset(gains), task.flap_range, task.error_limit,
                    motion(loop, task, gains), pose_delay_margin(axis, robot, config, timing, gains),
                )  # fmt: skip
    return found


def tuned(number: int) -> dict[str, Any]:
    """Return the gains for two robots of an axis, and what they are worth."""
    config, axis = load_config(), AXES[number]
    timing = Timing.of(config, 0.04)
    task, robots = task_of(number, config, timing), [robot_of(config), robot_of(config) | {DELAY: 0.006}]
    built = [build(axis, robot, config, timing) for robot in robots]
    gains = design(task, built, [gains_in(config, axis)])
    found = judged(task, robots, built, gains_in(config, axis), gains)
    return {
        "gains": gains,
        "judged": replace(found, axis=None),
        "worst": worst([found.margins, found.old_margins]),
    }  # type: ignore[arg-type]


def robots() -> dict[str, Any]:
    """Return what robots of other openings and shapes can do."""
    reference, found = point_of(load_config()), {}
    for aside, kink in ((0.0, 0.0), (0.1, 0.0), (-0.08, 0.2)):
        geometry = reference.geometry.model_copy(update={"kink_angle": reference.geometry.kink_angle + kink})
        point = replace(reference, geometry=geometry, opening=reference.opening + aside)
        model, share = point.linear, authorities(reference)
        shapes = optimise.Shapes(reference, "speed-range")
        found[f"{aside} {kink}"] = (
            model.A, model.B, model.constants, [model.poles(axis) for axis in AXES], model.growth(ROLL), model.steady(PITCH),
            authorities(point), single(point), optimise.held(point), optimise.conditions(point),
            optimise.least_authority(point, share), optimise.speed_range(point, share), updrafts(point),
            [shapes.loss(shapes.first + 0.01 * k * (optimise.HIGH - optimise.LOW)) for k in (-3, 0, 4)],
            len(shapes.tried), shapes.begin(3)[::7], point.speed, point.reach,
        )  # fmt: skip
    best = optimise.Candidate(replace(reference, opening=reference.opening + 0.05), -20.0, 1.2, 1.3)
    own = optimise.Candidate(reference, -10.0, 1.0, 1.1)
    lines = optimise.exercise(optimise.Optimum(best, own, True, (best, own)), 9.5, 10.0)
    found["words"] = [
        float(word) for word in " ".join(lines).replace(",", "").replace(";", "").split() if word[0].isdigit()
    ]
    found["front"] = [optimise.front((best, own), one) for one in optimise.FIGURES]
    assert set(QUANTITIES) == set(share)
    return found


def record(seed: int, profile: str, excited: bool = False) -> Record:
    """Return a flight of 36 s of slow random motions."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 36.0, 0.01)
    lines = 2 * np.pi * np.array([0.3, 0.7, 1.1, 1.9, 3.1])

    def wave(size: float, columns: int, at: Array) -> Array:
        amplitudes, phases = size * noise(rng, 5, columns), 3.0 * noise(rng, 5, columns)
        return np.asarray(np.sum(amplitudes * np.sin(lines[:, None] * at[:, None, None] + phases), axis=1))

    pose_t = t[::2] + 0.003
    u, rates = wave(0.02, 4, t), wave(0.3, 3, t)
    pose = np.hstack([wave(0.02, 3, pose_t), wave(0.05, 3, pose_t)])
    pose[:, 2] += 1.15
    return Record(
        f"flight {seed}", t, t - 0.01, u, 0.01 * excited * np.ones_like(u), rates, pose_t, pose, 0.0, 0.0,
        load_config(profile), True,
    )  # fmt: skip


def logs() -> dict[str, Any]:
    """Return what telemetry says of the flow and of the robot."""
    found: dict[str, Any] = {}
    flights = [record(1, "floaty"), record(2, "floaty", excited=True), record(3, "original")]
    values = robot_of(load_config()) | dict.fromkeys(NUISANCES, 0.01) | {LAG: 0.05, DELAY: 0.013}
    for number, axis in enumerate(AXES):
        flow = flow_of(flights[0], axis, robot_of(load_config()))
        found[f"flow {axis.name}"] = flow.spectrum[::80], flow.input, flow.angle
        t, seen, predicted = one_step(flights[0], number, values, 0.004)
        found[f"step {axis.name}"] = t[:2], len(t), seen[::900], predicted[::900]
        found[f"response {axis.name}"] = (
            response(axis, values, np.array([1.0, 9.0, 50.0]), 0.004),
            outputs(axis),
        )
    for axis in (ROLL, PITCH):
        loop = closed_loop(flights[0], axis)
        found[f"closed {axis.name}"] = (
            loop.starred,
            loop.errors,
            loop.w[:3],
            loop.angle[:3],
            loop.acceleration[:3],
        )
    found["two"] = (
        two_controllers(flights),
        two_controllers(flights[:1]),
        input_constant((3.0, 1.0), (2.0, -2.0)),
    )
    found["record"] = flights[0].flap_angle, flights[0].mean_t[:2], flights[0].period_s
    short = replace(flights[0], t=flights[0].t[:1500], pose_t=flights[0].pose_t[:700])
    with pytest.raises(LabError, match=r"flight 1: 12\.0 s of flight: 15 s"):
        flow_of(short, HEIGHT, robot_of(load_config()))
    return found


def drawn(folder: Path) -> dict[str, Any]:
    """Return robots within the uncertainty of a profile, and of an identified one."""
    path, config = folder / "mine.toml", load_config()
    path.write_text('base = "floaty"\n', encoding="utf-8")
    names = ["roll_u1", LAG, DELAY, "z_vz"]
    root = np.diag([0.5, 0.002, 0.001, 0.01]) @ (np.eye(4) + 0.2 * noise(np.random.default_rng(4), 4, 4))
    known = KnownModel(
        values=config.model.model_dump(),
        half_widths=dict.fromkeys(names, 0.1),
        covariance=(root @ root.T).tolist(),
        delay=0.02,
    )
    found: dict[str, Any] = {}
    for count in (0, 5, 8):
        beside(str(path)).unlink(missing_ok=True)
        found[f"unknown {count}"] = robots_of(str(path), config, count).drawn
        beside(str(path)).write_text(known.model_dump_json(), encoding="utf-8")
        own = robots_of(str(path), config, count)
        found[f"known {count}"] = own.drawn, own.nominal[DELAY]
    return found


def flights(folder: Path) -> dict[str, Any]:
    """Return the metrics of experiments, flown near the goal with errors that are now and then large, or not to the end."""
    run = fly("hover", folder / "run", duration_s=5.0)
    log, release_us, found = run.log, 1_000_000, {}
    for number, (name, experiment) in enumerate(EXPERIMENTS.items()):
        if name == "overload":  # its log has another task's time
            continue
        rng, rows = np.random.default_rng(number), log.num_rows
        end_us = release_us + experiment.duration_s * 1e6 * (1.0 if number % 5 else 0.8)
        t = np.linspace(0, end_us, rows).astype(np.int64)
        course = experiment.trajectory(Goal((0.0, 0.0, 1.15), 0.0), release_us)
        goals = np.array([(*goal.p_WG, goal.yaw) for goal in map(course.at, t.tolist())])
        walk = np.cumsum(noise(rng, rows, 4), axis=0) / rows**0.5 * 0.05
        flown = np.roll(goals, 3, axis=0) + walk + 0.2 * (noise(rng, rows, 4) > 0.995)
        yaw = flown[:, 3]
        changed = {
            "t": t, "flight.free": t >= release_us, "battery.power": 3.4 + walk[:, 0], "truth.r": np.gradient(yaw),
            "truth.qw": np.cos(yaw / 2), "truth.qx": 0.0 * t, "truth.qy": 0.0 * t, "truth.qz": np.sin(yaw / 2),
            **dict(zip(("truth.x", "truth.y", "truth.z"), flown.T, strict=False)),
            **dict(zip(("goal.x", "goal.y", "goal.z", "goal.yaw"), goals.T, strict=True)),
        }  # fmt: skip
        columns = [
            pa.array(changed.get(one.name, log[one.name].to_numpy())).cast(one.type, safe=False)
            for one in log.schema
        ]
        metrics = experiment.metrics_of(pa.table(columns, schema=log.schema), lost=number % 7 == 0)
        found[name] = [value for key, value in metrics.items() if "age" not in key]
    return found


FOUND: dict[str, Callable[[Path], Any]] = {
    **{f"loops {axis.name}": lambda folder, number=n: loops(number) for n, axis in enumerate(AXES)},  # type: ignore[misc]
    "tuned yaw": lambda folder: tuned(2),
    "robots": lambda folder: robots(),
    "logs": lambda folder: logs(),
    "drawn": drawn,
    "flights": flights,
}


def texts(find: Callable[[Path], Any], folder: Path) -> dict[str, str]:
    """Return the numbers as the file has them."""
    return {key: " ".join(map(str, flat(one))) for key, one in find(folder).items()}


# They reach no line that the others do not.
LONG = ["loops pitch", "loops height", "loops yaw"]


@pytest.mark.parametrize("name", tiers(FOUND, LONG))
def test_research_computes_the_numbers_that_it_computed(name: str, tmp_path: Path) -> None:
    known = json.loads(NUMBERS.read_text(encoding="utf-8"))
    now = {key: flat(one) for key, one in FOUND[name](tmp_path).items()}
    then = {key: [float(number) for number in text.split()] for key, text in known[name].items()}
    share = 5e-3 if name.startswith("tuned") else 1e-5  # a search, whose gains are rounded to four digits
    close = {key: pytest.approx(one, rel=share, abs=1e-9, nan_ok=True) for key, one in then.items()}
    if now != close:
        skip_unless(known["versions"], versions(*PACKAGES))
    assert now == close


if __name__ == "__main__":
    with TemporaryDirectory() as place:
        approve(NUMBERS, {name: partial(texts, find, Path(place)) for name, find in FOUND.items()}, *PACKAGES)
