"""`floaty identify` and `floaty tune`: the model's constants from flights, and gains from the constants."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import degrees, inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.table import Table

from hil.commands import options as common
from hil.commands.options import PATH, common_option, option, say, warn
from hil.errors import LabError, made_folder, reading, require, writing

if TYPE_CHECKING:
    from hil.research.design.margins import Margins
    from hil.research.identify.identify import Identification
    from hil.research.studies.tuning import Round


@click.command()
@click.argument("runs", metavar="RUN...", type=PATH, nargs=-1, required=True)
@click.option(
    "--profile", metavar="NAME|FILE",
    help="With which a bare telemetry.csv was flown, and the base of a written profile  [default: the first RUN's].",
)  # fmt: skip
@click.option("--validate", type=PATH, metavar="RUN", help="A flight to be predicted, which is not fitted.")
@click.option(
    "--profile-out", type=PATH, metavar="FILE.toml", help="A profile with the identified constants."
)
@click.option(
    "--out",
    type=PATH,
    default=Path("runs/identify"),
    show_default=True,
    metavar="DIR",
    help="Page and pictures.",
)
def identify(
    runs: tuple[Path, ...], profile: str | None, validate: Path | None, profile_out: Path | None, out: Path
) -> int:
    """Identify the robot from RUNs: run folders, also of `floaty station`, or telemetry.csv files.

    Exit code 0: at least one constant is identified; 1: none; 2: bad input.
    """
    require("floaty identify", "identify", "scipy")
    from hil.research.identify.identify import IDENTIFIED, check_held_out
    from hil.research.identify.identify import identify as identify_records
    from hil.research.identify.pages import write_pages
    from hil.research.identify.record import load_record, profile_of
    from hil.research.identify.robots import write_profile

    common.check_profile("--profile-out", profile_out)
    with reading(", ".join(map(str, (*runs, *filter(None, [validate]))))):
        profile = profile or profile_of(runs[0])
        records = [load_record(run, profile) for run in runs]
        held_out = None if validate is None else load_record(validate, profile)
        if held_out is not None:
            check_held_out(held_out, records)
        found = identify_records(records)
        _print_constants(found)
        if found.excited or found.free:
            with writing("--out", made_folder("--out", out)):
                say(f"  {write_pages(out, found, held_out)}")
    if profile_out is not None:
        if notice := write_profile(profile_out, profile, found):
            say(f"  {notice}")
        say(f"  {profile_out}   (floaty fly hover --profile {profile_out})")
    return 0 if any(constant.verdict == IDENTIFIED for constant in found.constants) else 1


def _print_constants(found: "Identification") -> None:
    from hil.research.identify.identify import rows_of

    table = Table(title="constants, with the half width of their 95 % interval")
    rows = rows_of(found.constants)
    for heading in rows[0]:
        table.add_column(heading, no_wrap=heading != "verdict")
    for row in rows:
        table.add_row(*row.values())
    common.wide_console().print(table)
    if found.excited:
        periods = ", ".join(
            f"u{one.axis.input + 1}: {one.spectra.periods} at {degrees(found.records[one.record].flap_angle):.1f} deg"
            for one in found.excited
        )
        say(
            f"realisations and mean flap angles, to which the constants refer: {periods}; the model misses the log by "
            f"{found.estimate.misfit**0.5:.2f} of its scatter"
        )


@dataclass(frozen=True, slots=True)
class Tuning:
    """What `floaty tune` is asked for."""

    workers: int | None
    cluster: str
    resume: bool
    profile: str = common_option(common.profile_option)
    repeat: int | None = option(
        "--repeat", type=click.IntRange(1, 10), metavar="N",
        help="Fly the excitations, identify and tune until nothing improves, N times at most.",
    )  # fmt: skip
    robots: int = option(
        "--robots", type=click.IntRange(0, 1000), default=100, show_default=True, metavar="N",
        help="Number of robots drawn from the intervals of the model; all must be stable.",
    )  # fmt: skip
    vary: tuple[str, ...] = option(
        "--vary", multiple=True, metavar="KEY=LOW..HIGH",
        help="Instead: search numbers of the profile, as logic.gain_y=-3..-0.5, that make --metric best; repeatable.",
    )  # fmt: skip
    metric: str = option("--metric", default="distance", show_default=True, metavar="NAME", help="Of --vary.")
    experiment: str = option(
        "--experiment", default="hover", show_default=True, metavar="NAME|FILE.py:NAME", help="Of --vary."
    )
    duration: float | None = option(
        "--duration", type=click.FloatRange(0.5, 600.0), metavar="S", help="Of each flight of --vary."
    )
    flights: int = option(
        "--flights",
        type=click.IntRange(10, 100_000),
        default=120,
        show_default=True,
        metavar="N",
        help="Of --vary.",
    )
    seeds: int = option(
        "--seeds",
        type=click.IntRange(1, 100),
        default=1,
        show_default=True,
        metavar="N",
        help="Flights for each choice.",
    )
    seed: int = common_option(common.seed_option)
    board: str = option(
        "--board", metavar="BOARD", default="c", show_default=True, help="As for `floaty fly`."
    )
    out: Path | None = option(
        "--out",
        type=PATH,
        metavar="FILE.toml",
        help="A profile with the gains; of rounds, of the last one that gained.",
    )
    runs: Path = option(
        "--runs", type=PATH, default=Path("runs/tune"), show_default=True, metavar="DIR", help="Of all flights."
    )  # fmt: skip

    @property
    def crew(self) -> dict[str, Any]:
        """Who flies."""
        return {"workers": self.workers, "cluster": self.cluster, "resume": self.resume}


@click.command()
@common.asked_as(Tuning)
@common.runner_options
def tune(asked: Tuning) -> int:
    """Compute gains of the paper's control law for the profile's model, and fly them in lockstep with its plant.

    With --vary, search the numbers of any profile, also of own logic, that make a metric of an experiment best.

    Exit code 0: the new gains hover at least as well as the old ones; 1: they do not, and the old ones are kept; 2: bad
    input, no gains, or a lost robot.
    """
    if asked.vary:
        return _search(asked)
    require("floaty tune", "design", "scipy", "control")
    from hil.config import load_config
    from hil.laboratory.request import Bench
    from hil.research.campaigns.run import Runner
    from hil.research.studies.tuning import TuningFlights, fly_round, rounds, write_tuned

    common.check_profile("--out", asked.out)
    Bench(board=asked.board).check()
    made_folder("--runs", asked.runs)
    common.announce_compilation()
    best: Round | None = None
    with Runner(common.notices, **asked.crew) as runner:
        flights = TuningFlights(asked.seed, asked.board, asked.runs, runner)
        flown: Iterable[Round] = (
            [fly_round(asked.profile, flights, asked.robots)]
            if asked.repeat is None
            else rounds(asked.profile, flights, asked.robots, asked.repeat)
        )
        try:
            for number, one in enumerate(flown, 1):
                if asked.repeat is not None:
                    say(f"round {number}")
                _print_round(one)
                if best is None or one.better:
                    best = one
        except LabError as error:
            if best is None:
                raise
            warn(f"{error}; the best earlier round counts")
    assert best is not None
    if asked.out is not None:
        write_tuned(asked.out, asked.profile, load_config(best.profile), "Model and gains by floaty tune.")
        say(f"  {asked.out}   (floaty fly hover --profile {asked.out})")
    return 0 if asked.repeat is not None or best.better else 1


def _search(asked: "Tuning") -> int:
    """Search the numbers of a profile by flights; write those that were better."""
    require("floaty tune --vary", "design", "scipy")
    from hil.config import base_name
    from hil.laboratory.files.whole_files import write_whole
    from hil.laboratory.request import Bench, Options
    from hil.research.campaigns.run import Runner
    from hil.research.design.gains import toml_text
    from hil.research.studies.search import Aim, intervals, search

    common.check_profile("--out", asked.out)
    Bench(board=asked.board).check()
    made_folder("--runs", asked.runs)
    varied = intervals(asked.vary, asked.profile)
    options = Options(profile=asked.profile, duration_s=asked.duration, board=asked.board)
    seeds = tuple(range(asked.seed, asked.seed + asked.seeds))
    aim = Aim(asked.experiment, options, asked.metric, seeds, asked.flights)
    common.announce_compilation()

    def report(number: int, rounds: int, best: float) -> None:
        say(f"round {number} of {rounds}: {aim.metric} {aim.cost_text(best)}")

    with Runner(common.notices, **asked.crew) as runner:
        found = search(varied, aim, runner, asked.runs, report)
    table = Table("", "before", "found", title=f"{aim.metric} of {aim.experiment}, on other seeds")
    for one, value in zip(varied, found.values, strict=True):
        table.add_row(one.key, f"{one.given:g}", f"{value:g}")
    table.add_row(aim.metric, aim.cost_text(found.before), aim.cost_text(found.after))
    common.wide_console().print(table)
    if not found.better:
        say("not better than before: nothing is written")
        return 1
    if asked.out is not None:
        sections: dict[str, dict[str, Any]] = {}
        for one, value in zip(varied, found.values, strict=True):
            section, _, key = one.key.partition(".")
            sections.setdefault(section, {})[key] = value
        with writing("--out", asked.out):
            about = f"By floaty tune --vary: {aim.metric} of {aim.experiment}."
            write_whole(asked.out, toml_text(about, base_name(asked.profile), sections))
        say(f"  {asked.out}   (floaty fly {aim.experiment} --profile {asked.out})")
    return 0


def _print_round(one: "Round") -> None:
    """Print a round: gains, margins, predicted and flown motion."""
    from hil.research.studies.tuning import rms

    tuned = one.tuned
    for table in (_gains(one), _edges(one), _motion(one)):
        common.wide_console().print(table)
    say(
        f"robots: {len(tuned.robots.drawn)} drawn, {tuned.robots.about}; poses are {1e3 * tuned.age_s:.1f} ms old, one in a "
        f"hundred {1e3 * tuned.jitter_s:.1f} ms older; the least delay margin is {1e3 * tuned.least_delay_s:.1f} ms"
    )
    say(
        f"rms distance from the goal: {_distance(rms(tuned.before))}, with the new gains {_distance(rms(one.flown[0]))}"
        + ("" if one.better else ": the old gains are kept")
    )


def _gains(one: "Round") -> Table:
    title = "u = gain (target - estimate) - gains (velocity, angle, rate)"
    table = Table("axis", "gains, old", "gains, new", title=title)
    for axis in one.tuned.axes:
        old, new = (", ".join(f"{gain:.4g}" for gain in own) for own in (axis.old, axis.new))
        table.add_row(axis.axis.label, f"{', '.join(axis.axis.gains)} = {old}", new)
    return table


def _edges(one: "Round") -> Table:
    headings = ("axis", "", "gain up", "gain down", "phase", "delay", "late poses", "peak of 1/(1+L)")
    table = Table(*headings, title="margins, with the loop opened between command and servo")
    least = f"least of {1 + len(one.tuned.robots.drawn)}"
    for axis in one.tuned.axes:
        table.add_row(axis.axis.label, "old", *_margins(axis.old_margins), end_section=False)
        table.add_row("", "new", *_margins(axis.margins, axis.late))
        table.add_row("", least, *_margins(axis.least, axis.least_late), end_section=True)
    return table


def _motion(one: "Round") -> Table:
    headings = ("old, predicted", "old, flown", "new, predicted", "new, flown", "worst robots, flown")
    table = Table("axis", *headings, title="rms of the hover")
    for axis in one.tuned.axes:
        scale, unit = (100.0, "cm") if axis.metric else (degrees(1.0), "deg")
        flown = [
            "lost" if result.outcome != "completed" else f"{scale * result.metrics[axis.metric]:.2f} {unit}"
            for result in (one.tuned.before, *one.flown)
            if axis.metric
        ] or ["", ""]
        before = "not stable" if axis.old_motion is None else f"{scale * axis.old_motion.main:.2f} {unit}"
        after = f"{scale * axis.motion.main:.2f} {unit}"
        table.add_row(axis.axis.label, before, flown[0], after, flown[1], ", ".join(flown[2:]))
    return table


def _margins(found: "Margins", late: float | None = None) -> list[str]:
    if not found.stable:
        return ["not stable", "", "", "", "", ""]
    return [
        f"{found.gain:.2f}", f"{found.least_gain:.2f}", f"{degrees(found.phase):.0f} deg", f"{1e3 * found.delay:.0f} ms",
        "" if late is None else f"{1e3 * late:.0f} ms", f"{found.peak:.2f}",
    ]  # fmt: skip


def _distance(metres: float) -> str:
    return "lost" if metres == inf else f"{100 * metres:.2f} cm"
