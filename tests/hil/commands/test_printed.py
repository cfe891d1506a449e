"""What commands print, whole: tables cell by cell and every line, from values that are all different."""

from dataclasses import replace
from math import inf, nan, radians
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest

from hil.commands import compare, design, identify, listing, paper, tables
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.metric_pairs import MetricPair
from hil.laboratory.metrics import Verdict
from hil.pictures.compare import Apart, Comparison, FirstDifference
from hil.research.campaigns.jobs import Job, Row
from hil.research.design.axes import PITCH, YAW
from hil.research.design.margins import Margins
from hil.research.studies.paper import Paper, Trials
from hil.research.studies.paper_rows import MetricClaim, PaperRow
from hil.research.studies.two_boards import FirstCount, Seed


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
    """A flight in which every figure of the tables has a value of its own."""
    names = [name for _, group, _, _ in tables.SEED_COLUMNS for name in group]
    metrics = {name: 0.01 * factor * n for n, name in enumerate(names, 1)} | {"attitude_max": radians(factor)}
    job = Job(0, "hover", {"profile": "floaty", "seed": seed}, {})
    return Row(job, outcome, error, all(holds.values()), f"{seed}" * 64, metrics, holds)


def test_flights_of_many_seeds_are_a_row_each_and_the_means_of_the_completed(printed: Any) -> None:
    tables.print_seeds([row(5, 1.0, in_box=True), row(6, 3.0, rms_x=False, in_box=True, resets=False),
                        row(7, 9.0, "lost", "fell", lost=False)])  # fmt: skip
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
        "3 seeds: 1 hold all limits, 1 lost",
        "mean of the completed: rms x 2.00 y 4.00 z 6.00 cm; < 6 cm x 14.0 y 16.0 z 18.0 % of the time",
    ]
    tables.print_seeds([row(7, 9.0, "lost", "fell", lost=False)])
    assert printed()[-1] == "1 seeds: 0 hold all limits, 1 lost"
    tables.print_seeds([])
    assert printed() == []


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

    robots = (robot(5, ""), robot(6, "", "max_x", "in_box"), robot(7, "fell", "max_x"))
    verdicts = (Verdict("distance", 0.2, 0.3, False, "m", "min"),)
    tables.print_swarm(Made(request=Made(title="3 robots", robots=[one.request for one in robots]), robots=robots,
    verdicts=verdicts,
                            nearest="1 and 2 at 3 s", outcome="lost", hash="ab" * 32,
                            folder=tmp_path))  # type: ignore[arg-type]  # fmt: skip
    title, headings, *rows, limit, summary, report, recording = printed()
    assert (title, headings[:2], headings[-2:]) == (
        "3 robots, profile floaty",
        ["robot", "seed"],
        ["hash", "verdict"],
    )
    assert [[*one[:3], *one[-2:]] for one in rows] == [
        ["1", "5", "1.00 2.00 3.00", "5" * 12, "ok"], ["2", "6", "2.00 4.00 6.00", "6" * 12, "fails: max_x, in_box"],
        ["3", "7", "3.00 6.00 9.00", "7" * 12, "fell"],
    ]  # fmt: skip
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
    seeds = [Seed(1, first, rms, 0.002, (50, 51)), Seed(2, None, rms[::-1], 0.0035, (52, 53))]
    assert compare._print_seeds(Path("a"), Path("b"), seeds) == 1
    assert printed() == [
        "a | b", ["seed", "rms x y z [cm]", "rms x y z [cm]", "apart [mm]", "poses", "first servo count", "why"],
        ["1", "1.000 2.000 4.000", "1.100 2.000 3.000", "2.00", "50 | 51", "0.071 s motor.m1", "radio"],
        ["2", "1.100 2.000 3.000", "1.000 2.000 4.000", "3.50", "52 | 53", "equal", ""],
        "2 seeds: rms errors within 33.3 % of the first's, bodies within 3.50 mm",
    ]  # fmt: skip
    assert compare._print_seeds(Path("a"), Path("b"), seeds[1:]) == 0


def test_faults_are_listed_with_their_sizes_bounds_and_times(printed: Any) -> None:
    listing._list_faults()
    lines = [line.split() for line in printed()]
    assert lines[0] == ["kind", "size", "from..to", "lasts", "hover", "meaning"]
    told = {line[0]: line[1:] for line in lines[1:]}
    for name, kind in KINDS.items():
        size = [f"{kind.size:g}", *kind.unit.split(), f"{kind.low:g}..{kind.high:g}"] * kind.sized
        lasts = ["to", "the", "end"] if kind.duration_s == inf else [f"{kind.duration_s:g}", "s"]
        words = [
            *size,
            *lasts,
            *kind.outcome.split(),
            *kind.meaning.split(),
            *f"({kind.needs})".split() * bool(kind.needs),
        ]
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

    axis = Made(
        axis=PITCH,
        old=np.array([1.0, 2.0, 3.0, 4.0]),
        new=np.array([1.5, 2.5, 3.5, 0.00045]),
        old_margins=margins(2),
        margins=margins(4),
        least=margins(5),
        late=0.006,
        least_late=0.007,
        old_motion=None,
        motion=Made(main=0.011),
        metric="rms_x",
    )
    turn = Made(axis=YAW, old=np.array([5.0, 6.0]), new=np.array([5.5, 6.5]), old_margins=margins(8, False),
    margins=margins(9),
                least=margins(10), late=0.011, least_late=0.012, old_motion=Made(main=radians(1.5)),
                motion=Made(main=radians(0.5)), metric="")  # fmt: skip

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
    assert [one for one in found if isinstance(one, list)] == [
        ["axis", "gains, old", "gains, new"],
        [PITCH.label, f"{', '.join(PITCH.gains)} = 1, 2, 3, 4", "1.5, 2.5, 3.5, 0.00045"],
        [YAW.label, f"{', '.join(YAW.gains)} = 5, 6", "5.5, 6.5"],
        ["axis", "", "gain up", "gain down", "phase", "delay", "late poses", "peak of 1/(1+L)"],
        [PITCH.label, "old", "2.25", "0.50", "20 deg", "2 ms", "", "2.12"],
        ["", "new", "4.25", "0.25", "40 deg", "4 ms", "6 ms", "4.12"],
        ["", "least of 4", "5.25", "0.20", "50 deg", "5 ms", "7 ms", "5.12"],
        [YAW.label, "old", "not stable", *[""] * 5],
        ["", "new", "9.25", "0.11", "90 deg", "9 ms", "11 ms", "9.12"],
        ["", "least of 4", "10.25", "0.10", "100 deg", "10 ms", "12 ms", "10.12"],
        ["axis", "old, predicted", "old, flown", "new, predicted", "new, flown", "worst robots, flown"],
        [PITCH.label, "not stable", "3.00 cm", "1.10 cm", "2.00 cm", "5.00 cm, lost"],
        [YAW.label, "1.50 deg", "", "0.50 deg", "", ""],
    ]
    identify._print_round(Made(tuned=tuned, flown=(flight(0.04),), better=False))  # type: ignore[arg-type]
    assert (
        printed()[-1]
        == "rms distance from the goal: 3.00 cm, with the new gains 4.00 cm: the old gains are kept"
    )


def test_the_paper_s_rows_have_its_value_both_profiles_and_what_was_missed(printed: Any) -> None:
    claims = {"rms_x": MetricClaim("2 cm", 0.02), "max_y": MetricClaim("9 cm", 0.09)}
    both = [
        Trials(name, tuple(row(n, factor, in_box=n == 1 or factor < 2) for n in (1, 2)))
        for name, factor in (("floaty", 1.0), ("lqr", 3.0))
    ]
    printed_row = PaperRow("hover", "claim", "place", claims, "because of the wind")
    paper._print_rows(Paper((("hover", printed_row, tuple(both)),), (), False))  # type: ignore[arg-type]
    title, headings, *rest = printed()
    assert (title, headings[:3]) == (
        "paper and laboratory: mean ± deviation over the seeds",
        ["result", "figure", "paper"],
    )
    assert [one[:3] for one in rest if isinstance(one, list)] == [
        ["hover", "rms_x", "2 cm"], ["", "max_y", "9 cm"], ["", "limits held", ""],
    ]  # fmt: skip
    assert [one[3:] for one in rest if isinstance(one, list)] == [
        ["1 cm", "3 cm misses by 1 cm"], ["5 cm", "15 cm misses by 6 cm"], ["2 of 2", "1 of 2 FAILS"],
    ]  # fmt: skip
    assert rest[-3:] == [
        "hover, lqr: rms_x misses by 1 cm; max_y misses by 6 cm; limits fail: in_box 1×", "", "because of the wind",
    ]  # fmt: skip


def test_a_design_prints_its_robot_inputs_and_claims(printed: Any) -> None:
    claim = Made(title="pole", paper="9.5", ours="9.4", verdict="agrees")
    other = Made(title="lift", paper="1", ours="2", verdict="differs")
    design.show(
        Made(robot=[("mass", "0.3 kg")], inputs=[("u1: roll", "-1 to 1", "± 2")], claims=[claim, other])
    )  # type: ignore[arg-type]
    assert printed() == [
        "mass" + 35 * " " + "0.3 kg",
        ["input", "alone, inside the flaps' range", "linear, in both directions about the hover"], ["u1: roll",
        "-1 to 1", "± 2"],
        "the paper's design", ["claim", "paper", "computed", ""], ["pole", "9.5", "9.4", "agrees"], ["lift", "1", "2",
        "differs"],
    ]  # fmt: skip
