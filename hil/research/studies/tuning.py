"""`floaty tune`: a hover measures the flow, the design computes gains, and hovers test them, also on the worst robots.

A round of `--repeat` first flies the excitations and identifies the model. Everything needs only telemetry and a link;
the plant's truth is used only to fly other robots.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import get_args

from hil.config import LabConfig, base_name, load_config
from hil.errors import LabError, writing
from hil.laboratory.files.result import read_result
from hil.laboratory.files.whole_files import write_whole
from hil.laboratory.request import Options
from hil.research.campaigns.jobs import Row
from hil.research.campaigns.run import Runner
from hil.research.design.axes import AXES, gains_in
from hil.research.design.gains import changes, toml_text
from hil.research.design.loop import Timing, build
from hil.research.design.margins import peak_of
from hil.research.design.tune import GainTask, TunedAxis, by_regulator, design, judged, refuse_late
from hil.research.identify.flow import flow_of
from hil.research.identify.identify import identify
from hil.research.identify.plates import plant_of
from hil.research.identify.record import load_record
from hil.research.identify.robots import FLAP_RATE, Robots, robots_of, write_profile
from hil.research.studies.study import distance
from hil.world.config import ConstantName

HOVER_S = 60.0
EXCITATIONS = tuple(f"identify-u{number}" for number in range(1, 5))
FLOWN = 3  # of the worst robots
FACTOR_MAX = 4.0  # of plant.constant_factors
BETTER = 0.95  # of the old gains' rms, else the round is the last


@dataclass(frozen=True, slots=True)
class TuningFlights:
    """The common settings of all flights."""

    seed: int
    board: str
    folder: Path
    runner: Runner

    def hover(self, name: str, profile: str, *others: tuple[str, ...]) -> list[Row]:
        """Fly a hover of a profile's robot, and of robots that differ by settings. Raises `LabError` for an error."""
        flights = {}
        for number, settings in enumerate([(), *others]):
            options = Options(profile=profile, overrides=settings, seed=self.seed, duration_s=HOVER_S)
            flights[f"{name}-{number}" if number else name] = ("hover", options)
        return self._fly(name, flights)

    def excitations(self, profile: str) -> list[Row]:
        flights = {
            name: (name, Options(profile=profile, seed=self.seed + number))
            for number, name in enumerate(EXCITATIONS)
        }
        return self._fly("excitations", flights)

    def _fly(self, name: str, flights: Mapping[str, tuple[str, Options]]) -> list[Row]:
        on_board = {
            folder: (one, options | Options(board=self.board)) for folder, (one, options) in flights.items()
        }
        rows = self.runner.log(name, on_board, self.folder)
        if not rows:
            raise KeyboardInterrupt
        return rows


@dataclass(frozen=True, slots=True)
class Tuned:
    axes: tuple[TunedAxis, ...]
    robots: Robots
    age_s: float
    jitter_s: float  # extra age of the oldest of a hundred poses, over the mean
    config: LabConfig  # with the new gains
    before: Row

    @property
    def least_delay_s(self) -> float:
        """The least delay margin of all loops and robots."""
        return min(min(one.least.delay, one.least_late) for one in self.axes)


def tune(profile: str, flights: TuningFlights, count: int) -> Tuned:
    """Return gains for a profile's robot and `count` others within its intervals. Raises `LabError` if none exist."""
    config = _tunable(profile)
    robots = robots_of(profile, config, count)
    (before,) = flights.hover("before", profile)
    if before.outcome == "lost":
        raise LabError(
            f"{profile}: its own gains lose the robot ({before.error}): no hover to measure the flow with"
        )
    pose = read_result(before.folder).ages[0]
    age_s, jitter_s = 1e-6 * pose.mean_us, 1e-6 * (pose.p99_us - pose.mean_us)
    timing = Timing.of(config, age_s)
    record = load_record(before.folder, profile)
    axes, every = [], [robots.nominal, *robots.drawn]
    for axis in AXES:
        task = GainTask(axis, flow_of(record, axis, robots.nominal), config, timing, jitter_s)
        loops = [build(axis, robot, config, timing) for robot in every]
        old = gains_in(config, axis)
        new = design(task, loops, [by_regulator(axis, robots.nominal), old])
        axes.append(judged(task, every, loops, old, new))
    refuse_late(axes, jitter_s)
    return Tuned(tuple(axes), robots, age_s, jitter_s, _with_gains(config, axes), before)


def _tunable(profile: str) -> LabConfig:
    """Return the configuration of a profile. Raises `LabError` for one that flies without the built-in control law."""
    config = load_config(profile)
    other = "the Crazyflie's own firmware" if config.pilot.enabled else config.logic.controller
    if other:
        raise LabError(f"{profile}: tune makes gains for the built-in control law, not for {other}")
    return config


def _with_gains(config: LabConfig, axes: Sequence[TunedAxis]) -> LabConfig:
    gains = {name: float(gain) for one in axes for name, gain in zip(one.axis.gains, one.new, strict=True)}
    return config.model_copy(update={"controller": config.controller.model_copy(update=gains)})


def write_tuned(path: Path, base: str, config: LabConfig, about: str) -> None:
    """Write a profile based on another one, with the different values of `config`: model, trim, gains."""
    old = load_config(base)
    sections = {
        name: changes(getattr(config, name), getattr(old, name)) for name in ("model", "servo", "controller")
    }
    with writing("--out", path):
        write_whole(path, toml_text(about, base_name(base), sections))
    load_config(str(path))


def worst_settings(tuned: Tuned, config: LabConfig) -> list[tuple[str, ...]]:
    """Return the settings that make the plant the worst drawn robot, as far as it can represent it."""
    if config.plant.variant == "plate" or not config.robot.has_plates:
        return []
    truth, factors = asdict(plant_of(config).linearise()), config.plant.constant_factors
    timing = Timing.of(config, tuned.age_s)
    ranked = []
    for robot in tuned.robots.drawn:
        of = {name: robot[name] / truth[name] * factors.get(name, 1.0) for name in get_args(ConstantName)}
        if min(of.values()) < 0.0 or max(of.values()) > FACTOR_MAX:
            continue
        peak = max(
            peak_of(build(one.axis, robot, tuned.config, timing).open_loop(one.new)) / one.margins.peak
            for one in tuned.axes
        )
        text = ", ".join(f"{name}={factor:.5f}" for name, factor in of.items())
        ranked.append(
            (peak, (f"plant.constant_factors={{{text}}}", f"actuators.tau={1 / robot[FLAP_RATE]:.5f}"))
        )
    return [settings for _, settings in sorted(ranked, reverse=True)[:FLOWN]]


def rms(row: Row) -> float:
    """Return the rms distance from the goal [m], infinite for a lost robot."""
    if row.outcome != "completed":
        return float("inf")
    return distance(row.metrics)


@dataclass(frozen=True, slots=True)
class Round:
    """One round: tuned gains and their flights, the profile's robot first, then the worst."""

    tuned: Tuned
    flown: tuple[Row, ...]
    given: str  # the tuned profile
    written: Path  # the profile with the new gains

    @property
    def better(self) -> bool:
        """Whether the new gains hover at least as well as the old ones, with equal model on board and wind."""
        return rms(self.flown[0]) <= rms(self.tuned.before)

    @property
    def worth_another(self) -> bool:
        """Whether the new gains hover so much better that another round may help."""
        return rms(self.flown[0]) <= BETTER * rms(self.tuned.before)

    @property
    def profile(self) -> str:
        """The profile with the better gains."""
        return str(self.written) if self.better else self.given


def fly_round(profile: str, flights: TuningFlights, count: int) -> Round:
    """Tune a profile and fly the result. Raises `LabError` if it cannot be flown."""
    tuned = tune(profile, flights, count)
    path = flights.folder / "tuned.toml"
    write_tuned(path, profile, tuned.config, "Gains by floaty tune.")
    flown = flights.hover("after", str(path), *worst_settings(tuned, tuned.config))
    return Round(tuned, tuple(flown), profile, path)


def rounds(profile: str, flights: TuningFlights, count: int, most: int) -> Iterator[Round]:
    """Yield rounds of excitation, identification and tuning, at most `most`, until new gains are hardly better.

    Raises `LabError` when a robot is lost, or nothing is identified.
    """
    _tunable(profile)
    for number in range(1, most + 1):
        folder = flights.folder / f"round-{number}"
        own = replace(flights, folder=folder, seed=flights.seed + 10 * (number - 1))
        rows = own.excitations(profile)
        for row in rows:
            if row.outcome != "completed":
                raise LabError(f"round {number} ends: {row.job.experiment} lost the robot: {row.error}")
        model = folder / "model.toml"
        records = [load_record(row.folder, profile) for row in rows]
        write_profile(model, profile, identify(records))
        one = fly_round(str(model), own, count)
        yield one
        if one.flown[0].outcome != "completed":
            raise LabError(f"round {number} ends: the new gains lose the robot: {one.flown[0].error}")
        if not one.worth_another:
            return
        profile = one.profile
