"""What commands hand to the rooms that do the work, and what they print and return however it ends."""

import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest

from ground_station.controls import ControlAction, ControlsError
from ground_station.errors import LinkError
from hil.commands import fly, identify, paper, param
from hil.config import load_config
from hil.laboratory.experiments import EXPERIMENTS
from hil.research.campaigns.run import Runner
from hil.research.design import analysis
from hil.research.design.analysis import Analysis
from hil.research.design.claims import Claim
from hil.research.design.linear import point_of
from support.command import Cli

pytestmark = pytest.mark.usefixtures("empty_folder")


class Asked(list[Any]):
    """What the rooms were asked for, in order."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self._patch = patch
        self.patched: dict[str, Callable[..., Any]] = {}

    def answer(self, answers: Mapping[str, Any]) -> None:
        """Note the calls of functions of `hil`, and return an answer each."""
        places = {
            one if one.startswith("ground_station") else f"hil.{one}": answer
            for one, answer in answers.items()
        }
        for (
            place
        ) in places:  # before anything is patched: a module that is loaded later would keep what it finds
            import_module(place.rpartition(".")[0])
        for place, answer in places.items():
            name = place.rpartition(".")[2]

            def called(*what: Any, name: str = name, answer: Any = answer, **more: Any) -> Any:
                self.append((name, *what, *more.values()))
                return answer(*what) if callable(answer) else answer

            self.patched[place] = called
            self._patch.setattr(place, called)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[Asked]:
    """What the rooms are asked for; they are patched, and nothing keeps that."""
    loaded = ("hil.api", "ground_station.program", "hil.pictures.compare", "hil.research.studies.paper_report",
        "hil.research.campaigns.report")  # fmt: skip
    for name in loaded:
        import_module(name)
    asked = Asked(monkeypatch)
    yield asked
    kept = {
        f"{module}.{name}"
        for module, content in [*sys.modules.items()]
        if module.startswith(("hil.", "ground_station."))
        for name, value in vars(content).items()
        if any(value is one for one in asked.patched.values())
    }
    assert kept == set(asked.patched)


def failing(error: Exception) -> Callable[..., Any]:
    """Return a function that raises an error."""

    def fail(*_: Any) -> Any:
        raise error

    return fail


@pytest.mark.parametrize("verdicts", [("identified", "weak"), ("weak",)])
@pytest.mark.parametrize(
    ("seen", "held", "out"), [(True, None, None), (False, "held", "mine.toml"), (True, "held", "mine.toml")]
)
def test_identify_predicts_the_flight_that_it_was_not_fitted_to_and_writes_what_it_found(
    cli: Cli,
    asked: Asked,
    monkeypatch: pytest.MonkeyPatch,
    seen: bool,
    held: str | None,
    out: str | None,
    verdicts: tuple[str, ...],
) -> None:
    found = Made(excited=("u1",) * seen, free=(), constants=[Made(verdict=one) for one in verdicts])
    asked.answer({
        "research.identify.record.load_record": lambda run, profile: f"{run} {profile}",
        "research.identify.record.profile_of": "lqr", "research.identify.identify.check_held_out": None,
        "research.identify.identify.identify": found, "research.identify.pages.write_pages": "page",
        "research.identify.robots.write_profile": "trim changed" if len(verdicts) > 1 else "",
    })  # fmt: skip
    monkeypatch.setattr(identify, "_print_constants", lambda one: identify.say("constants"))
    more = [*(["--validate", held] if held else []), *(["--profile-out", out] if out else []), "--out", "x"]
    assert cli("identify", "a", "b", *more) == (0 if "identified" in verdicts else 1)
    assert asked[-1 - bool(out) - seen :][0] == ("identify", ["a lqr", "b lqr"])
    assert ("check_held_out", "held lqr", ["a lqr", "b lqr"]) in asked or not held
    assert (("write_pages", Path("x"), found, f"{held} lqr" if held else None) in asked) == seen
    assert not out or asked[-1] == ("write_profile", Path("mine.toml"), "lqr", found)
    written = ["  trim changed"] * (len(verdicts) > 1) + [
        "  mine.toml   (floaty fly hover --profile mine.toml)"
    ]
    assert cli.out.splitlines() == ["constants", *["  page"] * seen, *(written if out else [])]


def test_parameters_are_asked_for_in_turn_and_the_first_refusal_ends_it(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = Made(open=lambda stop: asked.append(("open", stop())), close=lambda: asked.append("close"))
    answers = [Made(error="", values=[("a", 1.0)]), Made(error="no such", values=[])]
    asked.answer({
        "ground_station.links.schemes.find_link": link,
        "ground_station.program.ask": lambda link, request: answers.pop(0),
    })  # fmt: skip
    assert cli.refusal("param", "get", "a", "b", "c", "--link", "udp://127.0.0.1:1") == "floaty: no such\n"
    assert [one[0] for one in asked[:-1]] == ["find_link", "open", "ask", "ask"]
    assert (asked[1], asked[-1]) == (("open", False), "close")
    monkeypatch.setattr(link, "open", failing(LinkError("gone")))
    assert cli.refusal("param", "save", "--link", "udp://1.1.1.1:1") == "floaty: --link gone\n"
    monkeypatch.setattr(param, "_ask", lambda wanted, **board: asked.append(wanted[0]) or [[("a", 1.0)]])
    assert (cli("param", "save", "--link", "udp://1.1.1.1:1"), cli.out) == (0, "saved\n")
    assert asked[-1].action is ControlAction.SAVE
    told = cli.refusal("param", "list", "b", "--link", "udp://1.1.1.1:1")
    assert "b: no parameter of the board begins with that" in told


SPEC = """
experiments = ["hover"]
flights = 3
[parameters]
"actuators.tau" = { uniform = [0.045, 0.055] }
"""


def test_a_shrunk_flight_is_its_command_and_an_interrupted_campaign_says_what_is_kept(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("spec.toml").write_text(SPEC, encoding="utf-8")
    reflight = Made(whole="whole", fails="fails", request=lambda trial: Made(duration_s=4.0, trial=trial))
    asked.answer({
        "research.campaigns.shrink.Reflight": reflight, "research.campaigns.shrink.shrink": "least",
        "api.command_of": lambda request: f"floaty fly {request.trial}",
    })  # fmt: skip
    assert cli("campaign", "spec.toml", "--shrink", "2") == 0
    assert cli.out == "flight 2 still fails with\n  floaty fly least\n"
    assert (asked[0][2].index, asked[1]) == (2, ("shrink", "whole", 4.0, "fails"))
    findings = Made(rate="1 of 2", cells=[], errors=(), worst=())
    monkeypatch.setattr(Runner, "interrupted", True)
    monkeypatch.setattr(
        Runner,
        "campaign",
        lambda runner, plan, out: asked.append(out) or ("set", Made(flown=2, complete=False)),
    )
    asked.answer({
        "research.campaigns.report.write_report": ("page", findings),
    })  # fmt: skip
    assert cli("campaign", "spec.toml") == 130
    assert cli.out == "failed: 1 of 2\n  page\n"
    assert cli.err.splitlines()[-1].endswith("interrupted: 2 flights are kept; --resume flies the others")
    assert asked[-2] == Path("runs/campaign-spec")
    assert (asked[-1][1], *asked[-1][3:]) == ("spec.toml", "set", False)


@pytest.mark.parametrize(
    ("outcome", "passed", "code"),
    [("completed", True, 0), ("completed", False, 1), ("interrupted", True, 130)],
)
def test_robots_that_fly_together_get_their_pictures_and_one_exit_code(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch, outcome: str, passed: bool, code: int
) -> None:
    request = Made(title="two", robots=())
    robots = [Made(folder=name, request=Made(experiment=f"of {name}")) for name in ("one", "two")]
    result = Made(robots=robots, outcome=outcome, passed=passed)
    asked.answer({
        "laboratory.swarms.request.swarm_of": request, "laboratory.swarms.folder.swarm_folder": "where",
        "pictures.swarm.write_swarm_report": None,
        "laboratory.swarms.folder.swarm_reserved": lambda *what: nullcontext(),
        "laboratory.swarms.flying.fly_swarm": lambda request, folder, show: show(1, 2) or result,
        "commands.options.write_pictures": None, "commands.tables.print_swarm": None,
        "pictures.viewer.swarm.write_swarm_rrd": None,
    })  # fmt: skip
    assert cli("fly", "hover", "--robots", "2") == code
    assert [one[:3] for one in asked[1:4]] == [("swarm_folder", request), ("swarm_reserved", request, "where"),
        ("fly_swarm", request, "where")]  # fmt: skip
    assert asked[4:] == [("write_pictures", "one", "of one"), ("write_pictures", "two", "of two"),
        ("write_swarm_report", result), ("write_swarm_rrd", result), ("print_swarm", result)]  # fmt: skip


def test_seeds_that_were_interrupted_are_counted_and_folders_that_moved_are_named_once(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Runner, "interrupted", True)
    monkeypatch.setattr(Runner, "fly", lambda runner, name, jobs, out: [Made(passed=True)])
    monkeypatch.setattr(fly, "print_seeds", lambda rows: None)
    monkeypatch.setattr(
        "hil.laboratory.files.folder.moved",
        lambda request, folder: f"why {request.seed}" * (request.seed > 5),
    )
    assert cli("fly", "hover", "--seed", "5", "--seeds", "3") == 130
    assert re.search(
        r"why 6, and so on: 2 of 3\n.*interrupted: 1 of 3 seeds are complete\n$", cli.err, re.DOTALL
    )
    assert (cli("fly", "hover", "--seed", "4", "--seeds", "3"), cli.err.count("why 6")) == (130, 1)
    assert "and so on" not in cli.err


def test_a_better_shape_is_printed_drawn_and_written_with_its_figure(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = point_of(load_config())
    found = Made(
        best=Made(point=point, name="best"),
        reference=Made(name="own"),
        reference_flies=True,
        tried=("a",) * 7,
    )
    places = {"best": (2.0, 1.25), "own": (1.0, 1.0)}

    def placed(robots: Any) -> Any:
        return np.array([places.get(getattr(robots[0], "name", ""), (0, 0))])

    asked.answer({
        "research.design.optimise.optimise": found, "research.design.optimise.front": "front",
        "research.design.optimise.placed": lambda robots, figure: placed(robots),
        "research.design.optimise.exercise": ["it holds 8 to 9"], "research.design.bounds.at_bounds": ["at a bound"],
        "research.design.claims.robot_lines": [("mass", "0.3 kg")],
        "pictures.drawing.png": lambda draw: draw() or b"png", "research.design.figures.pareto": None,
    })  # fmt: skip
    options = "--seed 3 --generations 4 --updrafts 8 9 --out x --write b.toml"
    assert cli("design", "optimise", *options.split()) == 0
    said = ["profile b.toml", "mass" + 35 * " " + "0.3 kg", "least-authority: 1.250; floaty: 1.000; 7 robots flew",
        "at a bound", "it holds 8 to 9", "picture  x/pareto-least-authority.png"]  # fmt: skip
    assert cli.out.splitlines() == said
    assert asked[0][2:] == ("least-authority", 3, 4)
    assert ("exercise", found, 8.0, 9.0) in asked
    assert next(one for one in asked if one[0] == "pareto")[4] == {"floaty": (1.0, 1.0), "best": (2.0, 1.25)}
    assert Path("x/pareto-least-authority.png").read_bytes() == b"png"
    assert (
        "# What floaty design optimise --figure least-authority --seed 3 derived from floaty."
        in Path("b.toml").read_text()
    )
    assert load_config("b.toml").geometry == point.geometry
    assert "--updrafts 9 8: expected the least first" in cli.refusal(
        "design", "optimise", "--updrafts", "9", "8"
    )
    found.reference_flies = False
    assert cli("design", "optimise", "--figure", "speed-range", "--out", "x") == 0
    assert "speed-range: 1.250; floaty: not stable and steering around its hover; 7 robots flew" in cli.out


@pytest.mark.parametrize("interrupted", [False, True])
@pytest.mark.parametrize("only", [None, "hover"])
def test_the_paper_is_flown_measured_and_identified_unless_only_a_row_is_asked_for(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch, only: str | None, interrupted: bool
) -> None:
    flown = Made(holds=True, studies=[])
    studies = "research.studies."
    asked.answer({
        f"{studies}paper.fly_paper": flown, f"{studies}drag_model.measure": ["bench"],
        f"{studies}paper_identification.fly_identification": ("c",),
        f"{studies}paper_identification.fly_scaling": ["more"], f"{studies}paper_report.write_paper": "page",
        "research.design.analysis.analyse": Analysis(None, [], [], ["own"], []), # type: ignore[arg-type, list-item],
    })  # fmt: skip
    for name in ("_print_rows", "_print_studies", "show_claims", "_print_constants"):
        monkeypatch.setattr(paper, name, lambda what, name=name: paper.say(name))
    monkeypatch.setattr(Runner, "interrupted", interrupted)
    assert cli("paper", "--seeds", "2", "--out", "x", *(["--only", only] if only else [])) == (
        130 if interrupted else 0
    )
    _, out, told, bench, shape, constants = asked[-1]
    whole = only is None and not interrupted
    assert (out, told, bench, constants) == (Path("x"), flown, ["bench"] * whole, ("c",) * whole)
    assert (shape.claims if shape else []) == ["own", "more"] * whole
    shown = ["_print_rows", "_print_studies", *["show_claims"] * whole, "_print_constants", "  page"]
    assert cli.out.splitlines() == shown
    assert ("interrupted: the report has the flights that were complete" in cli.err) == interrupted
    assert asked[0][3:5] == (2, Path("x"))


def test_an_analysis_is_written_as_page_pictures_and_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    point, inputs, claim = (
        point_of(load_config()),
        [("u1: roll", "-1 to 1", "± 2")],
        Claim("pole", "p", "9.5", "9.4", "agrees", ""),
    )
    monkeypatch.setattr("hil.pictures.drawing.png", lambda draw: b"drawn")
    page = analysis.write(
        Analysis(point, [("mass", "0.3 kg")], inputs, [claim], [("shape", "T", "C", Made)]), Path()
    )
    assert (page, Path("shape.png").read_bytes()) == (Path("design.html"), b"drawn")
    text, told = page.read_text("utf-8"), json.loads(Path("design.json").read_text())
    assert all(part in text for part in ('id="shape"', "0.3 kg", "9.5", "9.4"))
    assert told == {"geometry": json.loads(point.geometry.model_dump_json()), "constants": asdict(point.linear.constants),
        "robot": {"mass": "0.3 kg"}, "claims": [asdict(claim)]}  # fmt: skip


STATION = (
    "station",
    "--link",
    "mavlink:COM3",
    "yaw-step",
    "--start",
    "2.5",
    "--set",
    "controller.gain_r=0.08",
)


@pytest.mark.parametrize("out", [True, False])
def test_a_station_flies_with_its_files_and_ends_with_the_result_of_its_record(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch, out: bool
) -> None:
    result = Made(outcome="completed", passed=False, folder=Path("run"))
    flight = Made(telemetry=Path("run/telemetry.csv"), on_loop="row", note=lambda *note: asked.append(note))
    flight.close = lambda failure, interrupted: asked.append(("close", failure, interrupted)) or result
    asked.answer({
        "laboratory.real_flight.RealFlight": flight, "commands.options.write_pictures": None,
        "commands.station.print_result": None, "ground_station.operator.fly_with": ("", True),
    })  # fmt: skip
    files = (
        "--record",
        "seen.csv",
        "--tlog",
        "link.tlog",
        *(("--out", "run") if out else ("--log", "log.csv")),
    )
    assert cli(*STATION, *files) == (1 if out else 0)
    if out:
        _, folder, request, records, _, view = asked.pop(0)
        assert (folder, view, records.incomplete) == (Path("run"), None, False)
        assert (request.experiment.name, request.profile, request.seed) == ("yaw-step", "floaty", 0)
        assert (request.overrides, request.duration_s) == (
            ("controller.gain_r=0.08",),
            request.experiment.duration_s,
        )
        assert (request.bench.link, request.bench.board) == ("mavlink:COM3", "real")
    _, _, settings, session, _, duration_s, hooks, names = asked.pop(0)
    assert (session.uri, session.mocap, session.start_s, duration_s) == ("mavlink:COM3", None, 2.5, None)
    assert session.log == Path("run/telemetry.csv" if out else "log.csv")
    assert (session.record, session.tlog) == (Path("seen.csv"), Path("link.tlog"))
    assert settings == load_config(overrides=("controller.gain_r=0.08",)).ground
    assert ("row" in hooks, len(hooks)) == (out, 1 + out)
    assert {"hover", "yaw-step"} <= set(names)
    if out:
        assert asked == [("close", "", True), ("write_pictures", Path("run"), session_experiment(session)),
                         ("print_result", result)]  # fmt: skip
        result.passed, result.outcome = True, "interrupted"
        assert cli(*STATION, *files) == 130
        asked.answer({"commands.options.write_pictures": failing(OSError(28, ""))})
        assert cli(*STATION, *files) == 3
        assert cli.out == "run: No space left on device; no more is written to it\n"
    else:
        assert asked == []


def session_experiment(session: Any) -> Any:
    """Return the experiment whose trajectory a session flies."""
    return next(one for one in EXPERIMENTS.values() if one.trajectory is session.trajectory)


def test_a_station_that_failed_says_why_and_one_that_lost_a_file_says_so_in_its_exit_code(
    cli: Cli, asked: Asked
) -> None:
    asked.answer({"ground_station.operator.fly_with": ("--link mavlink:COM3: gone", False)})
    assert cli.refusal(*STATION) == "floaty: --link mavlink:COM3: gone\n"

    def full(operator: Any, settings: Any, session: Any, *_: Any) -> tuple[str, bool]:
        session.records.write("log.csv", failing(OSError(28, "")))
        return "", False

    asked.answer({"ground_station.operator.fly_with": full})
    assert cli(*STATION) == 3
    assert cli.out == "log.csv: No space left on device; no more is written to it\n"
    find = asked[-1][1]._find
    assert find("hover") is EXPERIMENTS["hover"].trajectory
    with pytest.raises(ControlsError, match="hovar"):
        find("hovar")
