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

from firmware_py.errors import FirmwareError
from firmware_py.policy.measuring import LawFigures
from ground_station.controls import ControlAction, ControlsError
from ground_station.errors import LinkError
from hil.commands import fly, identify, paper, param
from hil.commands.options import say
from hil.config import load_config
from hil.deploy.targets import TARGETS
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.metric_pairs import MetricPair
from hil.laboratory.replay import Misses
from hil.research.campaigns.run import Runner
from hil.research.design import analysis
from hil.research.design.analysis import Analysis
from hil.research.design.claims import Claim
from hil.research.design.linear import point_of
from hil.research.studies.catalogue import STUDIES
from hil.research.studies.paper_identification import COLUMNS, WHY, PaperConstant
from hil.research.studies.two_boards import FirstCount, TwoBoards
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
            one if one.startswith(("ground_station", "firmware_py")) else f"hil.{one}": answer
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
        if module.startswith(("hil.", "ground_station.", "firmware_py."))
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
    excited, free = (("u1",), ()) if held is None else ((), ("u1",))
    found = Made(excited=excited * seen, free=free * seen, constants=[Made(verdict=one) for one in verdicts])
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
    monkeypatch.setattr(
        param, "_ask", lambda wanted, **board: [[("ab.c", 1.0), ("Abc", -0.25), ("b.ab", 3.0)]]
    )
    assert (cli("param", "list", "aB", "--link", "udp://1.1.1.1:1"), cli.out) == (0, "ab.c 1\nAbc -0.25\n")
    told = cli.refusal("param", "list", "c", "--link", "udp://1.1.1.1:1")
    assert "c: no parameter of the board begins with that" in told


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
    covered: list[int] = []
    monkeypatch.setattr(fly, "print_seeds", lambda rows: None)
    monkeypatch.setattr(fly, "_cover", lambda request: covered.append(request.seed))
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
    assert covered == [5, 4], "once for all seeds"


def test_several_seeds_count_the_lines_of_one_image_beside_its_own_elf_file(asked: Asked) -> None:
    asked.answer({"pictures.exports.coverage.check_image_coverage": None})
    bench = Made(
        coverage=Path("out"), board="cf2.bin", elf="cf2.elf", check_many=lambda *many: asked.append(many)
    )
    request: Any = Made(bench=bench)
    fly._check_seeds(3, request, None)
    assert asked == [("--seeds", 3), ("check_image_coverage", Path("out"), "cf2.bin", "cf2.elf")]
    with pytest.raises(LabError, match=r"^--seeds 3: --view: for one flight only"):
        fly._check_seeds(3, request, "window")


@pytest.mark.parametrize("out", [(), ("--out", "x")])
def test_a_flight_whose_usual_folder_is_another_s_says_why(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, out: tuple[str, ...]
) -> None:
    flown: list[Path] = []
    monkeypatch.setattr("hil.laboratory.files.folder.moved", lambda request, folder: f"not {folder}")
    monkeypatch.setattr(fly, "_fly_one", lambda request, folder, target: flown.append(folder) or 0)
    assert cli("fly", "hover", "--seed", "8", *out) == 0
    assert flown == [Path("x") if out else Path("runs/hover-8")]
    assert ("not runs/hover-8\n" in cli.err) == (not out)


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
    for least in ("8", "9"):
        assert f"--updrafts {least} 8: expected the least first" in cli.refusal(
            "design", "optimise", "--updrafts", least, "8"
        )
    found.reference_flies = False
    assert cli("design", "optimise", "--figure", "speed-range", "--out", "x") == 0
    assert "speed-range: 1.250; floaty: not stable and steering around its hover; 7 robots flew" in cli.out
    assert [one[1][1] for one in asked if one[0] == "pareto"] == [
        "least-authority / that of the profile's robot",
        "speed-range",
    ]


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
    assert [*asked[0][2]] == ([*STUDIES.values()] if only is None else [])


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
        return
    assert asked == []
    view = Made(know=None, lines=None)
    asked.answer({"commands.options.open_live": view, "commands.options.close_live": None})
    flight.close = lambda failure, interrupted: None
    assert cli(*STATION, *files, "--view", "window") == 0
    recorded, flown = (next(one for one in asked if one[0] == name) for name in ("RealFlight", "fly_with"))
    assert (recorded[1], recorded[-1], flown[3].log) == (None, view, Path("log.csv")), "only seen, not kept"


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


@pytest.mark.parametrize("address", ["", "page"])
def test_a_flight_is_written_drawn_traced_printed_and_its_viewer_stays_until_it_is_closed(
    asked: Asked, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], address: str
) -> None:
    """In this order; then the lines on time that stood still, on the processor and on coverage; a trace only if asked."""
    view = Made(address=address, stay=lambda: asked.append("stay"))
    result = Made(passed=True, outcome="completed", stood_still_ms=12.4)
    bench = Made(gdb=None, in_lockstep="lockstep", trace=True, profile_cpu=Path("cpu"), coverage=Path("cov"))
    request: Any = Made(experiment=Made(name="hover"), seed=3, bench=bench)

    def flown(request: Any, folder: Any, show: Any, *more: Any) -> Any:
        for now_us in (1, 2):
            show(now_us, Made(end_us=9))
        return result

    asked.answer({
        "commands.options.open_live": view, "laboratory.run.fly": flown, "api.maker_of": "maker",
        "live.panel_commands.PanelCommands": None, "commands.options.write_pictures": None,
        "pictures.exports.perfetto.write_perfetto": None, "commands.options.close_live": None,
        "laboratory.files.cpu_profile.files_of": [Path("cpu.txt"), Path("cpu.folded")],
        "pictures.exports.coverage.write_coverage": ("9 of 10", Path("cov.info"), Path("cov.html")),
    })  # fmt: skip
    monkeypatch.setattr(fly, "print_result", lambda result: asked.append("printed"))
    monkeypatch.setattr(type(fly.common.notices), "is_terminal", True)
    monkeypatch.setattr(fly.common, "progress_bar", lambda *columns, wanted: bars.append(wanted) or nullcontext(
        Made(add_task=lambda *what, **more: 0, update=lambda *what, **more: None)))  # fmt: skip
    bars: list[bool] = []
    assert fly._fly_one(request, Path("x"), "web") == 0
    fly._cover(request)
    order = [one if isinstance(one, str) else one[0] for one in asked]
    stays = ["stay"] * bool(address)
    assert order == ["open_live", "maker_of", "fly", "PanelCommands", "write_pictures", "write_perfetto", "printed", *stays,
        "close_live", "files_of", "write_coverage"]  # fmt: skip
    assert asked[3][1] is view
    assert asked[3][3] == "lockstep"
    assert asked[order.index("close_live")] == ("close_live", view, result)
    told = capsys.readouterr()
    assert told.out.splitlines() == ["this machine was too slow: time stood still for 12 ms", "processor time:", "  cpu.txt",
        "  cpu.folded", "coverage: 9 of 10", "  cov.info", "  cov.html"]  # fmt: skip
    assert told.err == "the flight can be viewed until Ctrl-C\n" * len(stays)
    bench.gdb = 3333  # the flight may go back in time
    fly._fly_one(request, Path("x"), "web")
    assert bars == [True, False]


@pytest.mark.parametrize(
    ("flown", "outcome", "value", "code", "told"),
    [
        (0, "completed", 1.05, 0, "within 10 % of before"),
        (1, "completed", 0.95, 1, "within 10 % of before"),
        (1, "lost", 1.0, 1, "left before by more than 10 %: outcome completed | lost"),
        (0, "completed", 1.2, 1, "left before by more than 10 %: rms"),
        (130, "interrupted", 2.0, 130, ""),
    ],
)
def test_a_flight_with_a_baseline_fails_by_its_limits_its_outcome_and_its_metrics(
    cli: Cli, asked: Asked, flown: int, outcome: str, value: float, code: int, told: str
) -> None:
    asked.answer({
        "commands.fly._fly_one": flown, "laboratory.files.folder.reserved": lambda *what: nullcontext(),
        "commands.fly._flown": Made(result=Made(folder="before", outcome="completed")),
        "laboratory.experiments.finder_of": "finder", "pictures.compare.load_flown": Made(result=Made(outcome=outcome)),
        "pictures.compare.compare": Made(
            metrics=[MetricPair("same", "cm", (2.0, 2.0)), MetricPair("rms", "cm", (1.0, value))]
        ),
        "commands.compare.print_comparison": None,
    })  # fmt: skip
    assert cli("fly", "hover", "--baseline", "b", "--out", "now") == code
    assert cli.out.splitlines()[-1:] == [told][: bool(told)]
    names = [one[0] for one in asked]
    assert names.index("_flown") < names.index("_fly_one")
    assert ("print_comparison" in names) == told.startswith("left")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), ("show", "recording of x")), (("--at", "0"), ("show_at", Path("x"), 0.0)),
        (("--view", "web"), ("browse", Path("x"), 0.0, say)),
        (("--view", "web", "--at", "-1.5"), ("browse", Path("x"), -1.5, say)),
    ],
)  # fmt: skip
def test_a_recording_is_shown_where_and_at_the_time_that_was_asked_for(
    cli: Cli, asked: Asked, words: tuple[str, ...], expected: tuple[Any, ...]
) -> None:
    asked.answer({
        "live.recording.browse": None, "live.recording.show_at": None, "commands.pictures.show": None,
        "pictures.viewer.recording.recording_of": lambda run: f"recording of {run}",
    })  # fmt: skip
    assert cli("view", "x", *words) == 0
    assert asked[-1] == expected


def test_each_file_of_own_logic_that_can_fly_is_a_line_and_one_refusal_is_enough(
    cli: Cli, asked: Asked
) -> None:
    def checked(file: Path) -> Any:
        if file.name == "bad.py":
            raise FirmwareError("bad.py:3: one\nbad.py:4: two")
        point = Made(name="controller")
        return Made(plugs=[Made(point=point, hooks=("begin", "act"), parameters=range(int(file.stem)))])

    asked.answer({"firmware_py.logic.loading.check_file": checked})
    for name in ("0.py", "bad.py", "1.py", "2.py"):
        Path(name).touch()
    words = [f"{n}.py: ok (controller: begin, act; {n} parameter{s})" for n, s in enumerate(("s", "", "s"))]
    assert (cli("check", "0.py", "1.py"), cli.out.splitlines()) == (0, words[:2])
    assert (cli("check", "0.py", "bad.py", "1.py", "2.py"), cli.out.splitlines()) == (2, words)
    assert cli.err.splitlines() == ["bad.py:3: one", "bad.py:4: two"]


@pytest.mark.long
@pytest.mark.parametrize("identical", [True, False])
@pytest.mark.parametrize(("boards", "why"), [(None, ()), (TwoBoards(None, ()), ("no servo count differs",)),
    (TwoBoards(FirstCount(7, 0.07, "m3", (5, 6), "radio"), ("radio: late", "gyro: cold")),
    ("first servo count: row 7, 0.070 s from the release, m3: 5 | 6: radio", "radio: late", "gyro: cold"))])  # fmt: skip
def test_logs_are_identical_only_with_the_same_columns_and_boards_say_why_they_differ(
    cli: Cli, asked: Asked, identical: bool, boards: TwoBoards | None, why: tuple[str, ...]
) -> None:
    comparison = Made(identical=identical, first=None, unmeasured=("own.py:turn",))
    asked.answer({
        "pictures.compare.load_flown": lambda folder, find: f"flown {folder}", "pictures.compare.compare": comparison,
        "research.studies.two_boards.comparable": boards is not None, "research.studies.two_boards.two_boards": boards,
        "pictures.compare.write_comparison": "page",
        "commands.compare.print_comparison": None,
    })  # fmt: skip
    assert cli("compare", "a", "b") == (0 if identical else 1)
    assert ("write_comparison", Path("b"), "flown a", "flown b", comparison, why) in asked
    assert (cli.out, cli.err.count("'--experiment own.py:turn' executes it")) == (
        "\n".join((*why, "  page\n")),
        1,
    )


def test_folders_of_seeds_are_compared_only_with_one_another(cli: Cli, asked: Asked) -> None:
    for name in ("a", "b", "run"):
        Path(name).mkdir()
    Path("run/log.parquet").touch()
    asked.answer({"research.studies.two_boards.seeds_of": "seeds", "commands.compare._print_seeds": 1,
        "pictures.compare.load_flown": failing(LabError("no log"))})  # fmt: skip
    assert cli("compare", "a", "b") == 1
    assert asked == [("seeds_of", Path("a"), Path("b")), ("_print_seeds", Path("a"), Path("b"), "seeds")]
    for folders in (("a", "run"), ("run", "b")):
        asked.clear()
        assert cli.refusal("compare", *folders) == "floaty: no log\n"
        assert [one[0] for one in asked] == ["load_flown"]


@pytest.mark.long
@pytest.mark.parametrize("flown", [0, 1, 2])
def test_an_experiment_of_the_user_s_is_checked_against_the_second_run_unless_the_first_flew_it(
    cli: Cli, asked: Asked, flown: int
) -> None:
    """It flew in neither, the first or the second run; a run that flew it was found by it."""
    given = EXPERIMENTS["hover"]
    runs = {name: Made(result=Made(request=Made(experiment=given if flown == n else None)))
        for n, name in enumerate("ab", 1)}  # fmt: skip
    comparison = Made(identical=True, first=None, unmeasured=())
    asked.answer({
        "laboratory.experiments.find_experiment": given, "laboratory.experiments.check_flown": None,
        "pictures.compare.load_flown": lambda folder, find: runs[str(folder)], "pictures.compare.compare": comparison,
        "research.studies.two_boards.comparable": False, "pictures.compare.write_comparison": "page",
        "commands.compare.print_comparison": None,
    })  # fmt: skip
    assert cli("compare", "a", "b", "--experiment", "mine.py:turn") == 0
    checked = [one[1:] for one in asked if one[0] == "check_flown"]
    assert checked == ([] if flown == 1 else [(given, runs["b"].result)])


def test_a_robot_of_another_size_is_analysed_and_written_as_a_profile_of_its_length(
    cli: Cli, asked: Asked
) -> None:
    asked.answer({
        "commands.design.point_of": "point", "commands.design.write_profile": None, "commands.design.show": None,
        "research.design.analysis.analyse": "found", "research.design.analysis.write": "page",
    })  # fmt: skip
    words = ("--length", "2", "--mass", "3", "--write", "own.toml", "--out", "o", "--set", "a.b=1")
    assert cli("design", "--angle", "40", *words) == 0
    about = "The robot of floaty, lengths times 2, masses times 3."
    assert asked == [
        ("point_of", "floaty", ("a.b=1",), None, 40.0, 2.0, 3.0), ("write_profile", "point", Path("own.toml"), about, 2.0),
        ("analyse", "point"), ("write", "found", Path("o")), ("show", "found"),
    ]  # fmt: skip
    assert cli.out == "report  page\n"


def test_a_replay_prints_what_each_estimate_missed_in_the_units_of_its_rows(cli: Cli, asked: Asked) -> None:
    request = Made(profile="mine", overrides=("a=1",), experiment="hover")
    misses = [Misses(0.01, 0.02, 0.03, 0.04, 5, 6), Misses(0.07, 0.08, 0.09, 0.1, 11, 12)]
    asked.answer({"api.load_run": Made(request=request, hash="h"), "laboratory.replay.replay": None,
        "config.load_config": lambda profile, overrides: (profile, *overrides),
        "commands.options.write_pictures": None, "laboratory.replay.misses": misses})  # fmt: skip
    for options, profile in (((), "mine"), (("--profile", "floaty"), "floaty")):
        assert cli("replay", "runs/x", "--set", "b=2", *options) == 0
        cells = [
            [cell.strip() for cell in re.split("[│┃]", line)[1:-1]]
            for line in cli.out.splitlines()
            if line[0] in "│┃"
        ]
        assert cells == [["estimate less truth", "flown", "replayed", "unit"], ["position, rms", "1", "7", "cm"],
            ["position, largest", "2", "8", "cm"], ["attitude, rms", "1.719", "5.157", "deg"],
            ["attitude, largest", "2.292", "5.73", "deg"], ["poses fused", "5", "11", ""],
            ["poses refused", "6", "12", ""]]  # fmt: skip
        assert cli.out.splitlines()[-1] == "  runs/x-replay/report.html"
        assert ("replay", request, "h", (profile, "a=1", "b=2"), Path("runs/x-replay")) in asked


@pytest.mark.parametrize(
    ("cycles", "difference", "told"),
    [
        (604_800, 1e-4, ""),
        (604_801, 1e-4, "20-4: 604801 cycles per call (3600 us of a Cortex-M4), 90% of its control slot of 672000; flash "
         "3 B, RAM 4 B; at most 90% of the slot are allowed"),
        (672, 1.1e-4, "the law's actions differ by 0.00011 from the file's: at most 0.0001"),
        (672, float("nan"), "the law's actions differ by nan from the file's: at most 0.0001"),
    ],
)  # fmt: skip
def test_a_policy_is_written_where_it_fits_its_slot_and_acts_as_its_file(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch, cycles: int, difference: float, told: str
) -> None:
    Path("law.json").touch()
    asked.answer({
        "commands.new.write_project": None, "config.load_config": Made(logic="logic"),
        "board.cores.boards.runner_of": "runner",
    })  # fmt: skip
    figures = LawFigures(cycles, 3, 4, difference)
    monkeypatch.setattr("firmware_py.policy.reading.read_policy", lambda file: Made(shape="20-4", numbers=84))
    monkeypatch.setattr(
        "firmware_py.policy.measuring.measure", lambda *what: asked.append(what[2]) or figures
    )
    if told:
        assert cli.refusal("policy", "law.json", "--out", "my law") == f"floaty: policy law.json: {told}\n"
        return
    assert cli("policy", "law.json", "--out", "my law") == 0
    assert cli.out.splitlines() == [f"20-4, 84 constants: {figures}",
        "largest difference from law.json: 1.0e-04 of an action",
        "floaty fly hover --profile my law/profile.toml"]  # fmt: skip
    first, *_, last = asked  # of `write_project`, whose own `name` is the project's
    assert (first[0], first[-1], last[0], last[3]) == (
        "my-law",
        LawFigures(0, 0, 0, 0.0),
        "my-law",
        Path("my law"),
    )
    assert first[3] != last[3]
    assert (last[4], last[-1]) == ("law.json", figures)
    assert ("runner_of", "cortex-m4", "logic") in asked
    assert "runner" in asked


def test_a_campaign_of_an_image_adds_its_coverage_in_each_flight_and_prints_it_if_one_flew(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("spec.toml").write_text(SPEC, encoding="utf-8")
    interims = [Made(flown=2, complete=True), Made(flown=0, complete=False)]
    monkeypatch.setattr(
        Runner, "campaign", lambda runner, plan, out: asked.append(plan) or ("set", interims.pop(0))
    )
    findings = Made(rate="1 of 2", cells=[], errors=(), worst=())
    asked.answer({
        "research.campaigns.report.write_report": ("page", findings), "commands.campaign._check_coverage": None,
        "pictures.exports.coverage.write_coverage": ("9 of 10", Path("cov.info"), Path("cov.html")),
    })  # fmt: skip
    lines = ["failed: 1 of 2", "  page", "coverage: 9 of 10", "  cov.info", "  cov.html"]
    for shown in (5, 2):
        assert cli("campaign", "spec.toml", "--coverage", "cov") == 0
        assert cli.out.splitlines() == lines[:shown]
    _, plan, *_ = asked
    assert asked[0] == ("_check_coverage", Path("cov"), "c")
    assert [plan.job(n).options["coverage"] for n in (0, 2)] == [Path("cov").absolute()] * 2
    assert plan.job(2).options["seed"] == 3


def test_rows_of_the_paper_s_identification_are_printed_in_their_columns_with_the_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(paper, "say", shown.append)
    monkeypatch.setattr(paper.common, "wide_console", lambda width: Made(print=shown.append))
    paper._print_constants([PaperConstant(*"abcdefg")])
    paper._print_constants([])
    table, why = shown
    assert [(column.header, *column.cells) for column in table.columns] == [
        *zip(COLUMNS, "abcdefg", strict=True)
    ]
    assert why == WHY


@pytest.mark.parametrize(
    ("outcomes", "around", "code"),
    [(("completed",) * 3, True, 0), (("completed",) * 3, False, 1), (("completed", "error: gone", "completed"), True, 1),
     (("completed", "interrupted", "completed"), True, 130)],
)  # fmt: skip
def test_a_check_flies_the_last_flight_with_targets_of_its_own_logic_and_ends_with_the_first_error(
    cli: Cli,
    asked: Asked,
    monkeypatch: pytest.MonkeyPatch,
    outcomes: tuple[str, ...],
    around: bool,
    code: int,
) -> None:
    logics = ("usual", "usual", "failing")
    flights = [
        Made(config=Made(logic=logic), experiment=Made(name=f"flight {n}")) for n, logic in enumerate(logics)
    ]
    endings = iter(outcomes)
    Path("cf2.elf").touch()

    def checked(request: Any, factories: Any, show: Any) -> Any:
        outcome = next(endings)
        return Made(outcome=outcome, failed=outcome.startswith("error"), equal=True)

    boxes = {logic: Made(factories=f"for {logic}", machine_code=None, boards={}) for logic in logics}
    asked.answer({
        "deploy.check.plan": flights, "deploy.check.check_flight": checked, "commands.deploy._print_flight": None,
        "deploy.targets.Toolbox": lambda names, logic, *more: boxes[logic], "commands.deploy._print_sum": None,
        "commands.deploy._check_around": around,
    })  # fmt: skip
    assert cli("deploy", "check", "--elf", "cf2.elf", "--set", "a.b=1") == code
    flown = [one[1:3] for one in asked if one[0] == "check_flight"]
    ended = [n for n, outcome in enumerate(outcomes, 1) if outcome != "completed"][:1] or [3]
    assert (
        flown == [(flight, f"for {logic}") for flight, logic in zip(flights, logics, strict=True)][: ended[0]]
    )
    boxed = [one[1:] for one in asked if one[0] == "Toolbox"]
    assert boxed == [(("cortex-m4",), "usual", None, Path("cf2.elf")), (("cortex-m4",), "failing")]
    plan = next(one for one in asked if one[0] == "plan")
    assert plan[1:4] == (None, False, False), "a linked image is not built afresh"
    judged = [one for one in asked if one[0] == "_check_around"]
    assert judged == ([] if code == 130 else [("_check_around", Path("cf2.elf"), "floaty", ("a.b=1",))])


@pytest.mark.long
@pytest.mark.parametrize(("options", "fresh"), [
    ("", True), ("--targets c-O0", True), (f"--targets {','.join(TARGETS)}", True), ("--targets udp://127.0.0.1:9", False),
    ("--source core.c", False), ("--elf cf2.elf", False), ("--elf cf2.elf --targets cortex-m4", False),
])  # fmt: skip
def test_all_states_are_checked_for_what_is_exported_and_built_afresh(
    cli: Cli, asked: Asked, options: str, fresh: bool
) -> None:
    for name in ("core.c", "cf2.elf"):
        Path(name).touch()
    asked.answer({"deploy.check.plan": failing(LabError("planned"))})
    assert "planned" in cli.refusal("deploy", "check", *options.split())
    assert asked[0][:4] == ("plan", None, False, fresh)


def test_a_study_flies_alone_into_a_folder_of_its_name(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(paper, "_fly", lambda *what, **more: asked.append(what) or 0)
    crew = {"workers": None, "cluster": "", "resume": True}
    assert cli("study", "loss", "--seeds", "3", "--resume") == 0
    assert cli("study", "loss", "--out", "x") == 0
    assert asked == [([], [STUDIES["loss"]], 3, Path("runs/study-loss"), crew),
        ([], [STUDIES["loss"]], 5, Path("x"), crew | {"resume": False})]  # fmt: skip


def test_the_drag_model_is_measured_with_its_seed_and_drawn_at_the_hover_angle_in_degrees(
    cli: Cli, asked: Asked
) -> None:
    place = "research.studies.drag_model."
    asked.answer({f"{place}measure": ["a", "b"], f"{place}write": "page"})
    words = ("--seed", "3", "--set", "plant.hover_angle=0.5", "--out", "x/y")
    assert cli("drag-model", *words) == 0
    config = load_config("floaty", ["plant.hover_angle=0.5"])
    assert asked == [
        ("measure", config, 3),
        ("write", ["a", "b"], pytest.approx(28.6479, abs=1e-4), Path("x/y")),
    ]
    assert Path("x/y").is_dir()
    assert cli.out == "report  page\n"


def test_the_exit_code_is_that_of_the_paper_s_rows_or_of_studies_alone(
    cli: Cli, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    studies = "research.studies."
    for name in ("_print_rows", "_print_studies"):
        monkeypatch.setattr(paper, name, lambda what: None)
    flown = Made(holds=True, studies=[])
    asked.answer({f"{studies}paper.fly_paper": flown, f"{studies}paper_report.write_paper": "page"})
    for rows, studied, words, code in (
        (True, [True, False], ("study", "loss"), 1), (False, [True, True], ("study", "loss"), 0),
        (True, [False], ("paper", "--only", "hover"), 0), (False, [True], ("paper", "--only", "hover"), 1),
    ):  # fmt: skip
        flown.holds, flown.studies = rows, [Made(holds=one) for one in studied]
        assert cli(*words) == code
