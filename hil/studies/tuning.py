"""`floaty tune`: a hover measures the flow, the design computes gains, and hovers test them, also on the worst robots.

A round of `--repeat` begins one step earlier: it flies the excitations and identifies the model. All of it takes telemetry
and a link alone; the plant's truth is used only to fly other robots.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import sqrt
from pathlib import Path
from typing import get_args

from rich.console import Console

from hil.config import LabConfig, base_name, load_config
from hil.design.loop import (
    ANGLE,
    AXES,
    Axis,
    Loop,
    Margins,
    Matrix,
    Timing,
    build,
    gains_in,
    margins,
    pose_delay_margin,
    worst,
)
from hil.design.tune import Motion, Task, design, motion, regulator
from hil.errors import LabError, writing
from hil.experiments import find_experiment
from hil.identify.flow import flow_of
from hil.identify.identify import identify
from hil.identify.profile_out import write_profile
from hil.identify.record import KEPT, load_record
from hil.identify.robots import FLAP_RATE, Robots, robots_of
from hil.laboratory.result import Result
from hil.laboratory.robot import Streams
from hil.laboratory.run import Request
from hil.studies.sweep import Job, fly_all
from hil.world.config import ConstantName
from hil.world.plant import Plant

HOVER_S = 60.0
EXCITATIONS = tuple(f"identify-u{number}" for number in range(1, 5))
FLOWN = 3  # of the worst robots
WORSE = 10  # robots whose margin for late poses is computed, the worst of an axis
FACTOR_MAX = 4.0  # of plant.constant_factors
BETTER = 0.95  # of the last round's rms, or it is the last


@dataclass(frozen=True, slots=True)
class Flights:
    """The settings that all flights share."""

    seed: int
    board: str
    folder: Path
    notices: Console

    def hover(self, name: str, profile: str, *others: tuple[str, ...]) -> list[Result]:
        """Fly a hover of a profile's robot, and of robots that differ by settings. Raises `LabError` for an error."""
        experiment = find_experiment("hover")
        return self._fly(
            Job(
                Request.of(experiment, profile, settings, self.seed, HOVER_S, board=self.board),
                self.folder / (f"{name}-{number}" if number else name),
                KEPT,
            )
            for number, settings in enumerate([(), *others])
        )

    def excitations(self, profile: str) -> list[Result]:
        """Fly an excitation of each input."""
        return self._fly(
            Job(
                Request.of(find_experiment(name), profile, (), self.seed + number, board=self.board),
                self.folder / name,
                KEPT,
            )
            for number, name in enumerate(EXCITATIONS)
        )

    def _fly(self, jobs: Iterator[Job]) -> list[Result]:
        results, interrupted = fly_all(list(jobs), self.notices)
        if interrupted:
            raise KeyboardInterrupt
        for result in results:
            if result.outcome == "error":
                raise LabError(f"{result.folder}: {result.cause}")
        return results


@dataclass(frozen=True, slots=True)
class TunedAxis:
    """One axis before and after."""

    axis: Axis
    old: Matrix
    new: Matrix
    old_margins: Margins
    margins: Margins
    least: Margins  # of all robots
    late: float  # [s] by which poses may be older than they state, for the robot
    least_late: float  # of the worst robots
    old_motion: Motion | None  # None: not stable by the model
    motion: Motion

    @property
    def metric(self) -> str:
        """The metric of its motion in a flight's result, empty for yaw, which has none."""
        return {0: "rms_y", 1: "rms_x", 3: "rms_z"}.get(self.axis.input, "")


@dataclass(frozen=True, slots=True)
class Tuned:
    """The result of tuning."""

    axes: tuple[TunedAxis, ...]
    robots: Robots
    age_s: float
    jitter_s: float  # by which the oldest of a hundred poses is older than the mean
    config: LabConfig  # with the new gains
    before: Result

    @property
    def least_delay_s(self) -> float:
        """The least delay margin of all loops and robots."""
        return min(min(one.least.delay, one.least_late) for one in self.axes)


def tune(profile: str, flights: Flights, count: int) -> Tuned:
    """Return gains for a profile's robot and `count` others within its intervals. Raises `LabError` when there are none."""
    config = load_config(profile)
    if config.logic.controller:
        raise LabError(
            f"{profile}: tune makes gains for the built-in control law, not for {config.logic.controller}"
        )
    robots = robots_of(profile, config, count)
    (before,) = flights.hover("before", profile)
    if before.outcome == "lost":
        raise LabError(
            f"{profile}: its own gains lose the robot ({before.cause}): no hover to measure the flow with"
        )
    pose = before.ages[0]
    age_s, jitter_s = 1e-6 * pose.mean_us, 1e-6 * (pose.p99_us - pose.mean_us)
    timing = Timing.of(config, age_s)
    record = load_record(before.folder, profile)
    axes = []
    for axis in AXES:
        every = [robots.nominal, *robots.drawn]
        loops = [build(axis, robot, config, timing) for robot in every]
        flow = flow_of(record, axis, robots.nominal)
        task = Task(
            axis, flow.spectrum, flow.input, flow.angle, _flap_range(config), _error_limit(config, axis), jitter_s
        )  # fmt: skip
        old = gains_in(config, axis)
        new = design(task, loops, [regulator(axis, robots.nominal), old])
        axes.append(judged(task, loops, every, config, timing, old, new))
    refuse_late(axes, jitter_s)
    return Tuned(tuple(axes), robots, age_s, jitter_s, _with_gains(config, axes), before)


def refuse_late(axes: Sequence[TunedAxis], jitter_s: float) -> None:
    """Raise `LabError` for loops that tolerate less delay than the link has."""
    for one in axes:
        least = min(one.least.delay, one.least_late)
        if least < jitter_s:
            raise LabError(
                f"refused: {one.axis.name} tolerates {1e3 * least:.1f} ms of delay, and poses arrive up to "
                f"{1e3 * jitter_s:.1f} ms later than on the mean"
            )


def judged(
    task: Task,
    loops: Sequence[Loop],
    every: Sequence[Mapping[str, float]],
    config: LabConfig,
    timing: Timing,
    old: Matrix,
    new: Matrix,
) -> TunedAxis:
    """Return an axis with the margins and the motion of old and new gains; the first loop is the profile's robot."""
    axis = task.axis
    before, found = margins(loops[0], old), [margins(loop, new) for loop in loops]
    late = [
        pose_delay_margin(axis, every[place], config, timing, new)
        for place in [0, *sorted(range(1, len(every)), key=lambda place: -found[place].peak)[:WORSE]]
    ]
    return TunedAxis(
        axis, old, new, before, found[0], worst(found), late[0], min(late),
        motion(loops[0], task, old) if before.stable else None, motion(loops[0], task, new),
    )  # fmt: skip


def _flap_range(config: LabConfig) -> float:
    allocation = config.allocation
    return min(
        allocation.opening_max - allocation.hover_angle, allocation.hover_angle - allocation.opening_min
    )


def _error_limit(config: LabConfig, axis: Axis) -> float:
    """Return the largest error of the main state for which the flaps alone should suffice."""
    return config.controller.limit_xy if ANGLE in axis.states else 0.0


def _with_gains(config: LabConfig, axes: Sequence[TunedAxis]) -> LabConfig:
    gains = {name: float(gain) for one in axes for name, gain in zip(one.axis.gains, one.new, strict=True)}
    return config.model_copy(update={"controller": config.controller.model_copy(update=gains)})


def write_tuned(path: Path, base: str, config: LabConfig, about: str) -> None:
    """Write a profile based on another one, with the values of `config` that differ: model, trim, gains."""
    old = load_config(base)
    lines = [f"# {about}", f'base = "{base_name(base)}"']
    for section in ("model", "servo", "controller"):
        own, usual = getattr(config, section).model_dump(), getattr(old, section).model_dump()
        changed = {key: value for key, value in own.items() if value != usual[key]}
        if changed:
            lines += ["", f"[{section}]"]
            lines += [
                f"{key} = {list(value) if isinstance(value, tuple) else value}"
                for key, value in changed.items()
            ]
    with writing("--out", path):
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    load_config(str(path))


def worst_settings(tuned: Tuned, config: LabConfig) -> list[tuple[str, ...]]:
    """Return the settings that make the plant the worst of the drawn robots, as far as the plant can represent them."""
    if config.plant.variant == "plate":
        return []
    plant = Plant(config.geometry, config.plant, config.tunnel, config.actuators, Streams.of_seed(1).gusts)
    truth, factors = asdict(plant.linearise()), config.plant.constant_factors
    timing = Timing.of(config, tuned.age_s)
    ranked = []
    for robot in tuned.robots.drawn:
        of = {name: robot[name] / truth[name] * factors.get(name, 1.0) for name in get_args(ConstantName)}
        if min(of.values()) < 0.0 or max(of.values()) > FACTOR_MAX:
            continue
        peak = max(
            margins(build(one.axis, robot, tuned.config, timing), one.new).peak / one.margins.peak
            for one in tuned.axes
        )
        text = ", ".join(f"{name}={factor:.5f}" for name, factor in of.items())
        ranked.append(
            (peak, (f"plant.constant_factors={{{text}}}", f"actuators.tau={1 / robot[FLAP_RATE]:.5f}"))
        )
    return [settings for _, settings in sorted(ranked, reverse=True)[:FLOWN]]


def rms(result: Result) -> float:
    """Return the rms distance from the goal [m], infinite for a robot that was lost."""
    if result.outcome != "completed":
        return float("inf")
    return sqrt(sum(result.metrics[f"rms_{axis}"] ** 2 for axis in "xyz"))


@dataclass(frozen=True, slots=True)
class Round:
    """One round: tuned gains and their flights, the profile's robot first, then the worst."""

    tuned: Tuned
    flown: tuple[Result, ...]
    given: str  # the profile that was tuned
    written: Path  # the one with the new gains

    @property
    def better(self) -> bool:
        """Whether the new gains hover no worse than the old ones."""
        return rms(self.flown[0]) <= rms(self.tuned.before)

    @property
    def rms(self) -> float:
        """The rms of the better gains, for the profile's robot."""
        return min(rms(self.flown[0]), rms(self.tuned.before))

    @property
    def profile(self) -> str:
        """The profile that flies the better gains."""
        return str(self.written) if self.better else self.given


def fly_round(profile: str, flights: Flights, count: int) -> Round:
    """Tune a profile and fly the result. Raises `LabError` when nothing can be flown."""
    tuned = tune(profile, flights, count)
    path = flights.folder / "tuned.toml"
    write_tuned(path, profile, tuned.config, "Gains by floaty tune.")
    flown = flights.hover("after", str(path), *worst_settings(tuned, tuned.config))
    return Round(tuned, tuple(flown), profile, path)


def rounds(profile: str, flights: Flights, count: int, most: int) -> Iterator[Round]:
    """Yield rounds of excitation, identification and tuning, `most` of them or until one is no better than the last.

    Raises `LabError` when a robot is lost, or nothing is identified.
    """
    last = float("inf")
    for number in range(1, most + 1):
        folder = flights.folder / f"round-{number}"
        own = replace(flights, folder=folder, seed=flights.seed + 10 * (number - 1))
        for result in own.excitations(profile):
            if result.outcome != "completed":
                raise LabError(f"round {number} ends: {result.experiment} lost the robot: {result.cause}")
        model = folder / "model.toml"
        records = [load_record(folder / name, profile) for name in EXCITATIONS]
        write_profile(model, profile, identify(records))
        one = fly_round(str(model), own, count)
        yield one
        if one.flown[0].outcome != "completed":
            raise LabError(f"round {number} ends: the new gains lose the robot: {one.flown[0].cause}")
        if one.rms > BETTER * last:
            return
        last, profile = one.rms, one.profile
