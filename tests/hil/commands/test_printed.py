"""What commands print, whole: tables cell by cell and every line, from values that are all different."""

from contextlib import nullcontext
from dataclasses import replace
from math import inf, nan, radians
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import binomtest

from firmware_py.export.usage import EntryLoad
from hil.commands import compare, deploy, identify, listing, paper, pictures, serve, station, tables
from hil.commands import options as common
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.metric_pairs import MetricPair
from hil.laboratory.metrics import Verdict
from hil.pictures.compare import Apart, Comparison, FirstDifference
from hil.research.campaigns.dataset import Dataset
from hil.research.campaigns.jobs import Job, Row
from hil.research.campaigns.run import Runner
from hil.research.campaigns.sampling import draw
from hil.research.design.axes import PITCH, YAW
from hil.research.design.margins import Margins
from hil.research.identify.identify import IdentifiedConstant
from hil.research.studies.paper import Paper, Trials
from hil.research.studies.paper_rows import MetricClaim, PaperRow
from hil.research.studies.two_boards import FirstCount, Seed
from support.campaigns import planted, spec_of
from support.command import Cli


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Any:
    """What was printed since: a line is a text, a row of a table a list of its cells."""

    def read() -> list[Any]:
        found: list[Any] = []
        for line in capsys.readouterr().out.splitlines():
            if line[:1] in ("│", "┃"):
                found.append([cell.strip() for cell in line.replace("┃", "│").split("│")[1:-1]])
            elif line[:1] not in ("┏", "┡", "├", "└"):
                found.append(line.strip())
        return found

    return read


def row(seed: int, factor: float, outcome: str = "completed", error: str = "", **holds: bool) -> Row:
    """Return a flight with a different value for every number of the tables."""
    names = [name for _, group, _, _ in tables.SEED_COLUMNS for name in group]
    metrics = {name: 0.01 * factor * n for n, name in enumerate(names, 1)} | {"attitude_max": radians(factor)}
    job = Job(0, "hover", {"profile": "floaty", "seed": seed}, {})
    return Row(job, outcome, error, all(holds.values()), f"{seed}" * 64, metrics, holds)


def test_flights_of_many_seeds_are_a_row_each_and_the_means_of_the_completed(printed: Any) -> None:
    tables.print_seeds([row(5, 1.0, in_box=True), row(6, 3.0, rms_x=False, in_box=True, resets=False),
                        row(7, 9.0, "lost", "fell", lost=False), row(8, 0.1, "error", "gone", lost=False)])  # fmt: skip
    assert printed() == [
        "hover, profile floaty",
        [
            "seed",
            "rms x y z [cm]",
            "max x y z [cm]",
            "< 6 cm x y z [%]",
            "in box [%]",
            "attitude max [deg]",
            "hash",
            "verdict",
        ],
        ["5", "1.00 2.00 3.00", "4.0 5.0 6.0", "7.0 8.0 9.0", "10.0", "1.0", "5" * 12, "ok"],
        [
            "6",
            "3.00 6.00 9.00",
            "12.0 15.0 18.0",
            "21.0 24.0 27.0",
            "30.0",
            "3.0",
            "6" * 12,
            "fails: rms_x, resets",
        ],
        ["7", "9.00 18.00 27.00", "36.0 45.0 54.0", "63.0 72.0 81.0", "90.0", "9.0", "7" * 12, "fell"],
        ["8", "0.10 0.20 0.30", "0.4 0.5 0.6", "0.7 0.8 0.9", "1.0", "0.1", "8" * 12, "gone"],
        "4 seeds: 1 hold all limits, 1 lost",
        "mean of the completed: rms x 2.00 y 4.00 z 6.00 cm; < 6 cm x 14.0 y 16.0 z 18.0 % of the time",
    ]
    tables.print_seeds([row(7, 9.0, "lost", "fell", lost=False)])
    assert printed()[-1] == "1 seeds: 0 hold all limits, 1 lost"
    tables.print_seeds([])
    assert printed() == []


@pytest.mark.parametrize(("factor", "speed"), [(nan, ""), (12.4, "12 times real time; ")])
@pytest.mark.parametrize(("age_s", "taken"), [(nan, ""), (7.25, "7.2 s from start to end; ")])
def test_a_flight_says_how_fast_it_was_and_how_long_it_took_where_that_is_known(
    factor: float,
    speed: str,
    age_s: float,
    taken: str,
    printed: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(tables, "process_age_s", lambda: age_s)
    result: Any = Made(request=Made(title="hover, seed 1", profile="floaty"), rows=(), cause="fell", outcome="lost",
        real_time_factor=factor, hash="a" * 64, folder=tmp_path, ages=(), usage=None)  # fmt: skip
    tables.print_result(result)
    assert printed()[-1] == f"lost: fell; {speed}{taken}hash {'a' * 16}"


def test_a_flight_says_what_the_entry_points_took_that_were_called(printed: Any, tmp_path: Path) -> None:
    entries = {
        name: EntryLoad(calls, 168, 336) for name, calls in (("control", 1), ("goal", 0), ("estimate", 2))
    }
    result: Any = Made(request=Made(title="hover", profile="floaty", bench=Made(board="c")), rows=(), cause="", outcome="ok",
        real_time_factor=2.0, hash="a" * 64, folder=tmp_path, ages=(), usage=Made(entries=entries))  # fmt: skip
    tables.print_result(result)
    loads = [line.split()[:3] for line in printed() if " calls, " in line]
    assert loads == [["c", "control", "1"], ["c", "estimate", "2"]]


def test_robots_that_fly_together_are_a_row_each_and_their_common_limits(
    printed: Any, tmp_path: Path
) -> None:
    for name in ("report.html", "flight.rrd"):
        (tmp_path / name).touch()

    def robot(seed: int, cause: str, *failed: str) -> Any:
        request = Made(seed=seed, profile="floaty" if seed == 5 else "other")
        return Made(request=request, failed=[Made(metric=name) for name in failed], passed=not failed and not cause,
        cause=cause,
                    metrics=row(seed, seed - 4.0).metrics, hash=f"{seed}" * 64)  # fmt: skip

    robots = (robot(5, ""), robot(6, "", "max_x", "in_box"), robot(7, "fell"))
    verdicts = (Verdict("distance", 0.2, 0.3, False, "m", "min"),)
    tables.print_swarm(Made(request=Made(title="3 robots", robots=[one.request for one in robots]), robots=robots,
    verdicts=verdicts,
                            nearest="1 and 2 at 3 s", outcome="lost", hash="ab" * 32,
                            folder=tmp_path))  # type: ignore[arg-type]  # fmt: skip
    title, headings, *rows, limit, summary, report, recording = printed()
    assert (title, headings[:2], headings[-2:]) == ("3 robots, profile floaty", ["robot", "seed"],
        ["hash", "verdict"])  # fmt: skip
    assert [[*one[:3], *one[-2:]] for one in rows] == [["1", "5", "1.00 2.00 3.00", "5" * 12, "ok"],
        ["2", "6", "2.00 4.00 6.00", "6" * 12, "fails: max_x, in_box"],
        ["3", "7", "3.00 6.00 9.00", "7" * 12, "fell"]]  # fmt: skip
    assert limit == f"{verdicts[0]}: FAILS; 1 and 2 at 3 s"
    assert summary == "lost; 1 of 3 robots hold all limits; hash abababababababab"
    assert (report, recording) == (
        f"{tmp_path}/report.html",
        f"{tmp_path}/flight.rrd   (floaty view {tmp_path})",
    )


FIRST = FirstDifference(7, 0.25, "truth.x", (1.0, None))
SAME = Comparison(None, ((), ()), "Over 2 s.", (MetricPair("rms_x", "cm", (1.0, 1.0)),), (), False, (), ())


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ["1 metrics are equal. Over 2 s.", "identical"]),
        ({"first": FIRST}, ["1 metrics are equal. Over 2 s.",
                            "first difference: row 7, 0.250000 s from the release, truth.x: 1.0 | the log has ended"]),
        ({"first": FIRST, "one_is_real": True},
         ["1 metrics are equal. Over 2 s.", "one flight is real, the other simulated: they share no rows"]),
        ({"missing": (("a", "b", "c", "d", "e"), ("p", "q", "r", "s", "t", "u"))},
         ["1 metrics are equal. Over 2 s.", "not in one: a, b, c, d, e",
         "not in two: p, q, r, s, t and 1 more, which the page names",
          "identical in the columns that both have"]),
        ({"settings": (("seed", "1", "2"), ("link", "a", "b")), "metrics": (*SAME.metrics, MetricPair("max_y", "m", (1.5,
        1.25)),
                                                                         MetricPair("own", "s", (nan, 2.0)))},
         ["seed: 1 | 2", "link: a | b", "one | two", ["metric", "first", "second", "difference", "unit"],
          ["max_y", "1.5", "1.25", "-0.25", "m"], ["own", "–", "2", "–", "s"], "1 metrics are equal. Over 2 s.",
          "identical"]),
        ({"apart": (Apart("x", "cm", 1.2345, 3.456),)},
         ["1 metrics are equal. Over 2 s.", "distance at the same time", "since the release", ["", "rms", "largest", "unit"],
          ["x", "1.23", "3.46", "cm"], "identical"]),
    ],
)  # fmt: skip
def test_a_comparison_prints_what_differs(changes: dict[str, Any], expected: list[Any], printed: Any) -> None:
    compare.print_comparison(Path("one"), Path("two"), replace(SAME, **changes))
    assert printed() == expected


def test_two_boards_are_a_row_per_seed_and_the_largest_of_all(printed: Any) -> None:
    first = FirstCount(7, 0.0712, "motor.m1", (1, 2), "radio")
    rms = (np.array([0.01, 0.02, 0.04]), np.array([0.011, 0.02, 0.03]))
    seeds = [Seed(1, first, rms, 0.002, (50, 51)), Seed(2, None, rms[1:] * 2, 0.0035, (52, 53))]
    assert compare._print_seeds(Path("a"), Path("b"), seeds) == 1
    assert printed() == ["a | b", ["seed", "rms x y z [cm]", "rms x y z [cm]", "apart [mm]", "poses",
        "first servo count", "why"], ["1", "1.000 2.000 4.000", "1.100 2.000 3.000", "2.00", "50 | 51",
        "0.071 s motor.m1", "radio"], ["2", "1.100 2.000 3.000", "1.100 2.000 3.000", "3.50", "52 | 53",
        "equal", ""], "2 seeds: rms errors within 25.0 % of the first's, bodies within 3.50 mm"]  # fmt: skip
    assert compare._print_seeds(Path("a"), Path("b"), seeds[1:]) == 0


def test_columns_of_a_foreign_log_are_a_row_each_but_those_that_keep_their_names(printed: Any) -> None:
    def field(unit: str) -> Any:
        return pa.field(unit, pa.float64(), metadata={"unit": unit})

    names = {"t": "s", "x": "m", "none": "rad", "same": "V"}
    values = [[2e6, 3e6, 4.5e6], [2.0, nan, -0.25], [nan] * 3, [7.0] * 3]
    schema = pa.schema([field(unit).with_name(name) for name, unit in names.items()])
    log = pa.table(values, schema=schema)
    columns = {"t": "time", "x": "px", "none": "n", "same": "same [mV]", "left": "away [m]"}
    pictures._print_map(Made(log=log, map=Made(columns=columns, profile="p")))
    *rows, last = printed()
    assert [row for row in rows if row] == [
        ["column", "from", "least", "largest", "unit"], ["t", "time", "2e+06", "4.5e+06", "s"],
        ["x", "px", "-0.25", "2", "m"], ["none", "n", "", "", "rad"], ["left", "away [m]", "", "", ""],
    ]  # fmt: skip
    assert last == "3 rows, 2.500 s, profile p; to correct it: --map, a copy of map.toml"


def test_faults_are_listed_with_their_sizes_bounds_and_times(printed: Any) -> None:
    listing._list_faults()
    lines = [line.split() for line in printed()]
    assert lines[0] == ["kind", "size", "from..to", "lasts", "hover", "meaning"]
    told = {line[0]: line[1:] for line in lines[1:]}
    for name, kind in KINDS.items():
        size = [f"{kind.size:g}", *kind.unit.split(), f"{kind.low:g}..{kind.high:g}"] * kind.sized
        lasts = ["to", "the", "end"] if kind.duration_s == inf else [f"{kind.duration_s:g}", "s"]
        words = [*size, *lasts, *kind.outcome.split(), *kind.meaning.split(),
            *f"({kind.needs})".split() * bool(kind.needs)]  # fmt: skip
        assert told[name] == words[: len(told[name])]
        assert len(told[name]) > len(size) + len(lasts)


def test_a_verdict_in_a_few_words_is_how_it_ended_or_what_it_failed() -> None:
    def ended(outcome: str, **holds: bool) -> str:
        return listing.verdict_of(
            Made(outcome=outcome, verdicts=[Made(metric=n, holds=h) for n, h in holds.items()])
        )  # type: ignore[arg-type]

    assert ended("completed", a=True) == ended("completed") == "ok"
    assert ended("completed", a=False, b=True, c=False) == "fails: a, c"
    assert ended("lost", a=False) == "lost"


def test_a_round_of_tuning_prints_old_and_new_gains_margins_and_motion(printed: Any) -> None:
    def margins(n: float, stable: bool = True) -> Margins:
        return Margins(stable, n + 0.25, 1 / n, radians(10 * n), 0.001 * n, n + 0.125)

    axis = Made(axis=PITCH, old=np.array([1.0, 2.0, 3.0, 4.0]), new=np.array([1.5, 2.5, 3.5, 0.00045]),
        old_margins=margins(2), margins=margins(4), least=margins(5), late=0.006, least_late=0.0,
        old_motion=None, motion=Made(main=0.011), metric="rms_x")  # fmt: skip
    turn = Made(axis=YAW, old=np.array([5.0, 6.0]), new=np.array([5.5, 6.5]), old_margins=margins(8, False),
        margins=margins(9), least=margins(10), late=0.011, least_late=0.012,
        old_motion=Made(main=radians(1.5)), motion=Made(main=radians(0.5)), metric="")  # fmt: skip

    def flight(x: float, outcome: str = "completed") -> Row:
        return replace(row(1, 1.0, outcome), metrics={"rms_x": x, "rms_y": 0.0, "rms_z": 0.0})

    tuned = Made(axes=(axis, turn), robots=Made(drawn=(1, 2, 3), about="by intervals"), age_s=0.0315, jitter_s=0.0042,
                 least_delay_s=0.0051, before=flight(0.03))  # fmt: skip
    flown = (flight(0.02), flight(0.05), flight(0.09, "lost"))
    identify._print_round(Made(tuned=tuned, flown=flown, better=True))  # type: ignore[arg-type]
    found = printed()
    assert [one for one in found if isinstance(one, str)] == [
        "u = gain (target - estimate) - gains (velocity, angle, rate)",
        "margins, with the loop opened between command and servo",
        "rms of the hover",
        "robots: 3 drawn, by intervals; poses are 31.5 ms old, one in a hundred 4.2 ms older; the least delay margin is "
        "5.1 ms",
        "rms distance from the goal: 3.00 cm, with the new gains 2.00 cm",
    ]  # fmt: skip
    assert [one for one in found if isinstance(one, list)] == [["axis", "gains, old", "gains, new"],
        [PITCH.label, f"{', '.join(PITCH.gains)} = 1, 2, 3, 4", "1.5, 2.5, 3.5, 0.00045"],
        [YAW.label, f"{', '.join(YAW.gains)} = 5, 6", "5.5, 6.5"], ["axis", "", "gain up", "gain down",
        "phase", "delay", "late poses", "peak of 1/(1+L)"], [PITCH.label, "old", "2.25", "0.50", "20 deg",
        "2 ms", "", "2.12"], ["", "new", "4.25", "0.25", "40 deg", "4 ms", "6 ms", "4.12"],
        ["", "least of 4", "5.25", "0.20", "50 deg", "5 ms", "0 ms", "5.12"],
        [YAW.label, "old", "not stable", *[""] * 5], ["", "new", "9.25", "0.11", "90 deg", "9 ms", "11 ms",
        "9.12"], ["", "least of 4", "10.25", "0.10", "100 deg", "10 ms", "12 ms", "10.12"],
        ["axis", "old, predicted", "old, flown", "new, predicted", "new, flown", "worst robots, flown"],
        [PITCH.label, "not stable", "3.00 cm", "1.10 cm", "2.00 cm", "5.00 cm, lost"],
        [YAW.label, "1.50 deg", "", "0.50 deg", "", ""]]  # fmt: skip
    identify._print_round(Made(tuned=tuned, flown=(flight(0.04),), better=False))  # type: ignore[arg-type]
    assert (
        printed()[-1]
        == "rms distance from the goal: 3.00 cm, with the new gains 4.00 cm: the old gains are kept"
    )


def test_the_paper_s_rows_have_its_value_both_profiles_and_what_was_missed(printed: Any) -> None:
    claims = {"rms_x": MetricClaim("2 cm", 0.02), "max_y": MetricClaim("9 cm", 0.09)}
    both = [Trials(name, tuple(row(n, factor, in_box=n == 1 or factor < 2) for n in (1, 2))) for name,
        factor in (("floaty", 1.0), ("lqr", 3.0))]  # fmt: skip
    printed_row = PaperRow("hover", "claim", "place", claims, "because of the wind")
    paper._print_rows(Paper((("hover", printed_row, tuple(both)),), (), False))  # type: ignore[arg-type]
    title, headings, *rest = printed()
    assert (title, headings[:3]) == ("paper and laboratory: mean ± deviation over the seeds",
        ["result", "figure", "paper"])  # fmt: skip
    assert [one[:3] for one in rest if isinstance(one, list)] == [["hover", "rms_x", "2 cm"],
        ["", "max_y", "9 cm"], ["", "limits held", ""]]  # fmt: skip
    assert [one[3:] for one in rest if isinstance(one, list)] == [["1 cm", "3 cm misses by 1 cm"],
        ["5 cm", "15 cm misses by 6 cm"], ["2 of 2", "1 of 2 FAILS"]]  # fmt: skip
    assert rest[-3:] == ["hover, lqr: rms_x misses by 1 cm; max_y misses by 6 cm; limits fail: in_box 1×", "",
        "because of the wind"]  # fmt: skip


@pytest.mark.usefixtures("empty_folder")
def test_a_design_prints_its_robot_inputs_claims_and_page(
    cli: Cli, printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = Made(title="pole", paper="9.5", ours="9.4", verdict="agrees")
    other = Made(title="lift", paper="1", ours="2", verdict="differs")
    found = Made(robot=[("mass", "0.3 kg")], inputs=[("u1: roll", "-1 to 1", "± 2")], claims=[claim, other])
    asked: list[Any] = []
    monkeypatch.setattr("hil.research.design.analysis.analyse", lambda point: asked.append(point) or found)
    monkeypatch.setattr("hil.research.design.analysis.write", lambda one, folder: folder / "design.html")
    assert cli("design", "--angle", "22", "--out", "x") == 0
    print(cli.out, end="")
    assert printed() == ["mass" + 35 * " " + "0.3 kg", ["input", "alone, inside the flaps' range",
        "linear, in both directions about the hover"], ["u1: roll", "-1 to 1", "± 2"], "the paper's design",
        ["claim", "paper", "computed", ""], ["pole", "9.5", "9.4", "agrees"], ["lift", "1", "2", "differs"],
        "report  x/design.html"]  # fmt: skip
    assert asked[0].opening == radians(22.0)


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize(("flown", "text"), [("a" * 64, "the same flight"),
    ("a" * 63 + "b", "not the same flight: it was interrupted or changed")])  # fmt: skip
@pytest.mark.parametrize(("from_us", "begin"), [(1_234_000, "1.23"), (-500_000, "0.00")])
def test_a_debugged_flight_is_or_is_not_the_one_that_flew(
    flown: str, text: str, from_us: int, begin: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = Made(hash="a" * 64, failures=())
    asked: list[Any] = []
    monkeypatch.setattr("hil.api.load_run", lambda run, named: Made(result=result))
    monkeypatch.setattr("hil.laboratory.files.debugging.debugged_request", lambda one: "request")
    monkeypatch.setattr(
        "hil.laboratory.files.debugging.begin_us", lambda *what: asked.append(what) or from_us
    )
    monkeypatch.setattr("hil.laboratory.files.debugging.waiting_flight", lambda *what: what)
    monkeypatch.setattr("hil.laboratory.files.folder.reserved", lambda request, folder: nullcontext())
    ended = Made(hash=flown, outcome="completed", passed=True)
    monkeypatch.setattr("hil.laboratory.run.fly", lambda *what, **more: asked.append((what, more)) or ended)
    assert cli("debug", "runs/x", "--at", "2", "--before", "0.5", "--port", "9") == 0
    assert cli.out.splitlines() == [
        f"flying runs/x again up to {begin} s",
        f"runs/x-debug: hash {'a' * 16}, {text}",
    ]
    assert asked == [(result, "2", 0.5), (("request", Path("runs/x-debug")), {"flight_of": (9, from_us)})]


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize(("gains", "code", "kept"), [((True, False), 0, 0), ((False, False), 0, 0),
    ((False, True), 0, 1), ((), 2, None)])  # fmt: skip
def test_rounds_of_tuning_are_printed_in_turn_and_the_last_that_gained_is_written(
    gains: tuple[bool, ...], code: int, kept: int | None, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After them a round ends with an error: it is fatal only where it is the first."""
    asked: list[Any] = []
    profiles = ("floaty", "as-flown")

    def rounds(profile: str, flights: Any, robots: int, count: int) -> Any:
        asked.append((profile, flights.seed, flights.board, robots, count))
        yield from (Made(better=one, profile=profiles[number]) for number, one in enumerate(gains))
        raise LabError("no gains")

    monkeypatch.setattr("hil.research.studies.tuning.rounds", rounds)
    monkeypatch.setattr("hil.research.studies.tuning.write_tuned", lambda *what: asked.append(what))
    monkeypatch.setattr(identify, "_print_round", lambda one: identify.say(one.profile))
    assert cli("tune", "--repeat", "3", "--robots", "7", "--seed", "5", "--out", "mine.toml") == code
    assert asked[0] == ("floaty", 5, "c", 7, 3)
    if kept is None:
        assert cli.err.endswith("no gains\n")
        return
    printed = [line for number, _ in enumerate(gains, 1) for line in (f"round {number}",
        profiles[number - 1])]  # fmt: skip
    assert cli.out.splitlines() == [*printed, "  mine.toml   (floaty fly hover --profile mine.toml)"]
    assert cli.err.splitlines()[-1].endswith("no gains; the best earlier round counts")
    assert asked[1] == (Path("mine.toml"), "floaty", load_config(profiles[kept]),
        "Model and gains by floaty tune.")  # fmt: skip


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("better", [True, False])
def test_one_round_of_tuning_is_judged_by_its_exit_code(
    better: bool, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.research.studies.tuning.fly_round", lambda *what: Made(better=better,
        profile="floaty"))  # fmt: skip
    monkeypatch.setattr(identify, "_print_round", lambda one: None)
    assert cli("tune") == (0 if better else 1)
    assert cli.out == ""


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("better", [True, False])
def test_a_search_prints_each_number_and_the_metric_before_and_after_and_writes_what_is_better(
    better: bool, cli: Cli, printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def search(varied: Any, aim: Any, runner: Any, folder: Path, report: Any) -> Any:
        assert (aim.experiment, aim.metric, aim.seeds, aim.flights) == ("yaw-step", "rms_y", (4, 5), 30)
        assert (aim.options["profile"], aim.options["duration_s"], aim.options["board"]) == ("floaty", 2.0,
            "python")  # fmt: skip
        report(1, 2, 0.0123)
        return Made(values=(-1.25, 3.5), before=0.02, after=0.01, better=better)

    monkeypatch.setattr("hil.research.studies.search.search", search)
    gains = load_config().controller
    code = cli("tune", "--vary", "controller.gain_y=-3..-0.5", "--vary", "controller.gain_z=1..5", "--metric",
        "rms_y", "--seeds", "2", "--experiment", "yaw-step", "--duration", "2", "--flights", "30", "--seed",
        "4", "--board", "python", "--out", "mine.toml")  # fmt: skip
    assert code == (0 if better else 1)
    cells = [["", "before", "found"], ["controller.gain_y", f"{gains.gain_y:g}", "-1.25"],
        ["controller.gain_z", f"{gains.gain_z:g}", "3.5"], ["rms_y", "2 cm", "1 cm"]]  # fmt: skip
    last = (
        "mine.toml   (floaty fly yaw-step --profile mine.toml)"
        if better
        else "not better than before: nothing is written"
    )
    print(cli.out, end="")
    assert printed() == ["round 1 of 2: rms_y 1.23 cm", "rms_y of yaw-step, on other seeds", *cells, last]
    assert Path("mine.toml").exists() == better
    if better:
        found = load_config("mine.toml")
        assert (found.controller.gain_y, found.controller.gain_z) == (-1.25, 3.5)


@pytest.mark.usefixtures("empty_folder")
def test_a_campaign_prints_its_rates_its_errors_and_its_three_worst_flights(
    cli: Cli, printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of eight flights 1, 3 and 7 break a limit, 5 is lost and 6 ends with an error."""
    spec = spec_of(flights=8)
    changes: dict[int, dict[str, Any]] = {1: {"holds": {"in_box": False}, "metrics": {"in_box": 0.5}},
        3: {"holds": {"in_box": False}, "metrics": {"in_box": 0.25}},
        5: {"outcome": "lost", "error": "fell", "holds": {"in_box": False}, "metrics": {"flown": 0.2}},
        6: {"outcome": "error", "error": "planted", "holds": {}},
        7: {"holds": {"in_box": False}, "metrics": {"in_box": 0.4}}}  # fmt: skip

    def campaign(runner: Any, plan: Any, out: Path) -> Any:
        dataset = Dataset(out, plan, False)
        for index in range(8):
            made = planted(draw(spec, index))
            change = {"holds": {"in_box": True}, **changes.get(index, {})}
            metrics = made.metrics | {"in_box": 0.99} | change.pop("metrics", {})
            dataset.add(replace(made, passed=index not in changes, metrics=metrics, **change))
        dataset.close()
        return dataset, Made(complete=True, flown=8)

    monkeypatch.setattr(Runner, "campaign", campaign)
    monkeypatch.setattr("hil.research.campaigns.report.png", lambda draw: b"")
    Path("spec.toml").write_text(
        'experiments = ["hover"]\nduration_s = 0.3\nflights = 8\nparameters = {"actuators.tau" = {uniform = [0.04, 0.06]}}\n'
        '[[faults]]\nkind = "push.y"\nprobability = 0.5\nstart_s = 0.1\nsize = {uniform = [1.0, 12.0]}\n'
    )
    assert cli("campaign", "spec.toml", "--out", "runs/x") == 0
    print(cli.out, end="")

    def rate(failed: int, flown: int, which: str = "") -> str:
        low, high = (100.0 * end for end in binomtest(failed, flown).proportion_ci(method="wilson"))
        return f"{failed} of {flown}{which}: {100.0 * failed / flown:.2f} % ({low:.2f} to {high:.2f} %)"

    def command(number: int) -> str:
        options = draw(spec, number).options
        more = [f"--set {one}" for one in options["overrides"]] + [
            f"--fault {one}" for one in options["faults"]
        ]
        return f"flight {number}: floaty fly hover --seed {number + 1} --duration 0.3 {' '.join(more)}"

    assert [line for line in printed() if "0 of 0" not in line] == [f"failed: {rate(5, 8)}",
        f"floaty, lost: {rate(1, 7)}", f"floaty, in_box: {rate(3, 6, ' that were not lost')}",
        "did not end: 1×, first flight 6: planted", *map(command, (5, 3, 7)), "runs/x/report.html"]  # fmt: skip


def test_a_check_prints_each_target_s_counts_and_where_it_first_differs(
    printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def target(name: str, ticks: int, divergence: str | None = None) -> Any:
        return Made(name=name, ticks=ticks, calls=10 * ticks, divergence=divergence)

    def flight(name: str, faults: int, *targets: Any) -> Any:
        request = Made(experiment=Made(name=name), seed=3, faults=("x",) * faults)
        return Made(request=request, outcome="completed", targets=targets)

    flights = [flight("hover", 0, target("plain", 100), target("c-O2", 90)),
        flight("yaw", 2, target("plain", 5, "tick 7"), target("c-O2", 8))]  # fmt: skip
    for one in flights:
        deploy._print_flight(one)
    monkeypatch.setattr("hil.deploy.check.reached", lambda checked: ("flying", "not finite"))
    deploy._print_sum(flights, False)
    deploy._print_sum(flights[:1], True)
    assert printed() == [
        "hover, seed 3: completed", f"plain     {100:>7} ticks {1000:>7} calls  equal",
        f"c-O2      {90:>7} ticks {900:>7} calls  equal",
        "yaw, seed 3, 2 faults: completed", f"plain     {5:>7} ticks {50:>7} calls  DIFFERS first in tick 7",
        f"c-O2      {8:>7} ticks {80:>7} calls  equal",
        "98 ticks, c beside plain, c-O2: plain DIFFERS", "supervisor: reached flying; not not finite",
        "only a core with own logic has the guard that finds what is not finite",
        "90 ticks, c beside plain, c-O2: no bit differs", "supervisor: reached flying; not not finite",
    ]  # fmt: skip


def test_machine_code_is_printed_with_its_sizes_and_loads_beside_those_of_boards(printed: Any) -> None:
    ticks = Made(calls=4, instructions=400, worst_instructions=150, worst_us=33.4)
    deploy._print_machine_code(
        Made(ticks=ticks, flash_bytes=1000, ram_bytes=200, stack_bytes=30, loads=(0.0123, 0.0456))
    )  # type: ignore[arg-type]
    deploy._print_machine_code(
        Made(ticks=ticks, flash_bytes=None, ram_bytes=200, stack_bytes=30, loads=(0.0123, 0.0456))
    )  # type: ignore[arg-type]
    load, other, none = (Made(calls=c, cycles=12 * c, worst_cycles=w) for c, w in ((10, 20), (5, 40), (0, 0)))
    deploy._print_measured(
        "usb://0",
        {"step": load, "idle": none, "own": other},
        {"step": Made(calls=2, cycles=26, worst_cycles=15)},
    )  # type: ignore[dict-item, arg-type]
    for good in (True, False):
        deploy.say_finding(Made(good=good, subject="gyro", text="0.1 rad/s"))  # type: ignore[arg-type]
    assert printed() == [
        "Cortex-M4 code: flash 1000 B, RAM 200 B, stack 30 B",
        "instructions per tick: mean 100, worst 150; load at 168 MHz: mean 1.2%, worst tick 4.6% (33 us of 10 ms)",
        "Cortex-M4 code: RAM 200 B, stack 30 B",
        "instructions per tick: mean 100, worst 150; load at 168 MHz: mean 1.2%, worst tick 4.6% (33 us of 10 ms)",
        "usb://0: cycles per call, mean and worst, as measured on the board",
        "step           10 calls        12        20   counted        13        15",
        "own             5 calls        12        40",
        "gyro      0.1 rad/s", "! gyro      0.1 rad/s",
    ]  # fmt: skip


@pytest.mark.parametrize(("app", "findings", "well"), [(False, (), True), (True, (True, True), True),
    (True, (False, True), False)])  # fmt: skip
def test_an_image_is_well_when_all_around_its_core_is_and_memory_only_warns(
    app: bool, findings: tuple[bool, ...], well: bool, printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.deploy.image_check.has_app", lambda elf: (app, "memory"))
    monkeypatch.setattr("hil.deploy.image_check.check_memory", lambda memory: Made(good=False, subject=memory,
        text="full"))  # fmt: skip
    made = [Made(good=good, subject="part", text=str(good)) for good in findings]
    monkeypatch.setattr("hil.deploy.image_check.check_image", lambda elf, profile, overrides,
        show: made if (profile, overrides) == ("p", ("o",)) else 1 / 0)  # fmt: skip
    monkeypatch.setattr("hil.deploy.image_check.UNPROVEN", ("one", "two"))
    assert deploy._check_around(Path("cf2.elf"), "p", ("o",)) == well
    rest = [f"{'' if good else '! '}part      {good}" for good in findings] + ["unproven: one",
        "unproven: two"]  # fmt: skip
    assert printed() == [
        "! memory    full",
        *(rest if app else ["unproven: everything but the core: cf2.elf has no exported app"]),
    ]


def test_a_server_says_where_clients_find_each_of_its_robots() -> None:
    said: list[str] = []
    robots = [Made(dongles=7100, radio=f"radio://0/{n}", udp=f"udp://:{n}",
        mavlink=f"mavlink:{n}") for n in (1, 2)]  # fmt: skip
    serve._print_addresses(robots, said.append)  # type: ignore[arg-type]
    assert said[0] == "radio  radio://0/1 radio://0/2"
    assert said[1].startswith("use    env PYTHONPATH=/")
    assert said[1].endswith("/hil/servers/dongle_site FLOATY_DONGLE=127.0.0.1:7100 PROGRAM")
    assert said[2:] == ["udp    udp://:1 udp://:2", "mavlink mavlink:1 mavlink:2"]
    serve._print_addresses([Made(dongles=0, udp="", mavlink="m")], said.append)  # type: ignore[list-item]
    assert said[4:] == ["mavlink m"]


@pytest.mark.parametrize(("options", "message"), [({"program": ("cfclient", "-x"), "usb": False},
    "cfclient -x: only --usb takes a program"), ({"udp": 65535, "boards": 2},
    "--udp 65535: there are no 2 ports from there on"), ({"udp": 65534, "boards": 2}, None),
    ({"board": "a.elf", "mavlink": "x"}, "--mavlink x: a.elf speaks CRTP over its radio, not MAVLink"),
    ({"elf": Path("b.elf")}, "--elf b.elf: goes with an image as --board"),
    ({"elf": Path("b.elf"), "board": "a.bin"}, None), ({"gdb": 3333},
    "--gdb 3333: needs one board and an image as --board"), ({"gdb": 3333, "board": "a.elf"}, None),
    ({"gdb": 3333, "board": "a.elf", "boards": 2}, "--gdb 3333: needs one board and an image as --board")])  # fmt: skip
def test_options_of_a_server_that_contradict_each_other_are_one_line(
    options: dict[str, Any], message: str | None
) -> None:
    plain = {"udp": None, "board": None, "gdb": None, "boards": 1, "program": (), "usb": False,
        "mavlink": None, "elf": None}  # fmt: skip
    if message is None:
        serve._check_options(Made(**plain | options))  # type: ignore[arg-type]
    else:
        with pytest.raises(LabError) as refused:
            serve._check_options(Made(**plain | options))  # type: ignore[arg-type]
        assert str(refused.value) == message


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize("shown", [True, False])
def test_an_operator_s_console_prints_records_and_shows_each_text_where_it_belongs(
    recorded: bool, shown: bool
) -> None:
    said: list[Any] = []
    flight = Made(note=lambda *what: said.append(("note", *what)), log_us=7, on_loop="on loop")
    view = Made(answer=lambda *what: said.append(("answer", *what)), lines=lambda: ["a", "b"])
    console = station.OperatorConsole(flight if recorded else None, view if shown else None, said.append)  # type: ignore[arg-type]
    console.report("x")
    console.note("y")
    console.reply("z")
    expected = ["x", *[("note", "station", "x"), ("note", "operator", "y")] * recorded, "z"]
    assert said == expected + [("answer", 7 if recorded else 0, "z")] * shown
    queued: list[str] = []
    take, *rest = console.hooks(Made(queue_line=queued.append))  # type: ignore[arg-type]
    take(None, 0)  # type: ignore[arg-type]
    assert (queued, rest) == (["a", "b"] * shown, ["on loop"] * recorded)


def test_constants_are_printed_with_their_realisations_and_mean_flap_angles(printed: Any) -> None:
    nothing = (nan, nan)
    made = IdentifiedConstant("roll_u1", "1/s²", (230.0, 66.0), 188.6, nothing, (200.0, 12.0), (190.0, 3.0),
        "identified", "± 2%")  # fmt: skip
    seen = Made(axis=PITCH, record=1, spectra=Made(periods=5))
    records = (Made(flap_angle=0.0), Made(flap_angle=radians(24.4)))
    identify._print_constants(
        Made(constants=(made,), excited=(seen,), records=records, estimate=Made(misfit=1.44))
    )  # type: ignore[arg-type]
    title, headings, cells, text = printed()
    assert title == "constants, with the half width of their 95 % interval"
    assert headings == ["constant", "paper", "truth", "instruments", "joint fit", "unit", "verdict"]
    assert cells == ["roll_u1", "230 ± 66", "188.6", "200 ± 12", "190.0 ± 3.0", "1/s²", "identified: ± 2%"]
    assert text == (
        "realisations and mean flap angles, to which the constants refer: u2: 5 at 24.4 deg; the model "
        "misses the log by 1.20 of its scatter"
    )


def test_studies_are_as_expected_or_their_surprises_are_named(printed: Any) -> None:
    def study(name: str, holds: bool, *surprises: str) -> Any:
        curves = [Made(variant=Made(name="v")), Made(variant=Made(name="w"))]
        told = dict(zip(map(id, curves), (surprises, surprises[:1]), strict=True))
        return Made(study=Made(name=name), holds=holds, curves=curves,
            surprises=lambda curve: told[id(curve)])  # fmt: skip

    paper._print_studies(
        Made(studies=[study("a", True), study("b", False, "5 m/s: lost", "6"), study("c", False)])
    )  # type: ignore[arg-type]
    assert printed() == ["study a: as expected", "study b: v: 5 m/s: lost; v: 6; w: 5 m/s: lost",
        "study c: not complete"]  # fmt: skip


@pytest.mark.parametrize("missed", [0, 3])
def test_a_picture_that_is_closed_reports_the_rows_that_it_missed_and_the_result_has_them(
    missed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    written: list[Any] = []
    monkeypatch.setattr("hil.laboratory.files.result.write_result", written.append)
    monkeypatch.setattr(common, "replace", lambda result, **changes: (result, changes))
    view: Any = Made(close=lambda: missed)
    common.close_live(view, "result", said.append)  # type: ignore[arg-type]
    common.close_live(view, None, said.append)
    common.close_live(None, "result", said.append)  # type: ignore[arg-type]
    text = f"the live viewer did not take {missed} rows of the flight"
    assert said == [f"{text}; the log contains them all", text][: 2 * bool(missed)]
    assert written == [("result", {"not_shown": missed})]
