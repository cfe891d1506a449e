"""The pytest plugin, seen by `pytester`: what is flown, what a failure shows, what is kept, what is skipped."""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

import hil
import hil.pictures.drawing  # here, because pytester forgets what a session loads first
import hil.testing
import hil.testing.flights
from firmware_py.export.errors import ExportError
from hil.api import load_run
from hil.errors import LabError
from hil.laboratory.files.coverage import COUNTS, file_of
from hil.laboratory.request import Options
from hil.testing import baselines, choices, plugin
from hil.testing.choices import Marked, Wanted, choices_of, why_not
from support.choices import choice
from support.command import Cli
from support.examples import FILE, blocks
from support.own_logic import LAW, make_project

PAGE = Path(hil.__file__).parent.parent / "docs" / "howto" / "tests.md"
FLY = "def test_it(floaty):\n    assert floaty.fly(duration_s=0.3).passed\n"
# A flight that fails its limits, by a profile whose limit nothing holds.
FAIL = """
def test_it(floaty):
    flight = floaty.fly(duration_s=0.3, seed=3, faults=["push.y@0.1=0.2"], profile="strict.toml")
    assert flight.passed
"""
STRICT = 'base = "floaty"\n[limits.hover]\nrms_x = 1e-9\n'


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    choices.why_no_board.cache_clear()
    yield
    choices.why_no_board.cache_clear()


@pytest.fixture
def strict(pytester: pytest.Pytester) -> pytest.Pytester:
    (pytester.path / "strict.toml").write_text(STRICT)
    pytester.makepyfile(FAIL)
    return pytester


def kept(pytester: pytest.Pytester) -> list[str]:
    """Return the run folders that a session has left."""
    folder = pytester.path / "runs" / "pytest"
    return sorted(path.parent.relative_to(folder).as_posix() for path in folder.rglob("result.json"))


# Failures

BROKEN = """
import pytest
from hil.errors import LabError

def test_one(floaty):
    assert floaty.fly(profile="profile.toml").passed

def test_two(floaty):
    assert floaty.fly("y-square", profile="profile.toml").passed

def test_board(floaty):
    floaty.board(profile="profile.toml")

def test_other(floaty):
    floaty.fly("no-such")

def test_expected(floaty):
    with pytest.raises(LabError):
        floaty.fly(profile="profile.toml")

def test_check(floaty):
    with pytest.raises(LabError, match="list comprehension: write a loop"):
        floaty.check("controller.py")
"""


@pytest.mark.long
def test_a_broken_controller_is_one_message_without_traceback(pytester: pytest.Pytester) -> None:
    make_project(pytester.path, LAW.replace("DT * memory", "sum([v for v in control.u]) * memory"))
    tests = pytester.makepyfile(BROKEN).name
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(failed=4, passed=2)
    shown, _, _ = result.stdout.str().partition(
        "short test summary info"
    )  # it repeats whole messages where the variable CI is set
    [line] = re.findall(".*list comprehension.*", shown)
    assert line.startswith(f"{tests}:5: ")
    assert re.search(r"controller\.py:\d+: list comprehension: write a loop over range", line)
    assert len(re.findall(f"^as in {tests}::test_one$", shown, re.MULTILINE)) == 2
    assert f"{tests}:14: experiment 'no-such': unknown" in shown
    assert "hil/" not in shown
    assert "LabError" not in shown
    assert "floaty flights" not in shown, "of a test that flew nothing"


@pytest.mark.long
def test_a_failure_shows_limit_value_folder_picture_and_the_command_that_flies_it_again(
    cli: Cli, strict: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = strict.runpytest_inprocess()
    result.assert_outcomes(failed=1)
    shown = result.stdout.str().partition("floaty flights")[2]
    value = re.search(r"limit +rms_x = (\S+) cm \(limit <= 1e-07 cm\)", shown)
    assert value is not None
    assert "hover, seed 3, board c, profile " in shown
    assert "fault    push.y@0.1=0.2" in shown
    (folder,) = re.findall(r"folder +(\S+)", shown)
    (picture,) = re.findall(r"picture +(\S+)", shown)
    (again,) = re.findall(r"again +floaty (.+)", shown)
    assert Path(picture).read_bytes().startswith(b"\x89PNG")
    run = load_run(folder)
    assert float(value[1]) == pytest.approx(100 * run.metrics["rms_x"], rel=1e-3)
    assert (
        "--profile strict.toml" in again,
        str(strict.path) in shown.partition("short test summary")[0],
    ) == (True, False)
    monkeypatch.chdir(strict.path)
    assert cli(*again.split(), "--out", "again") == 1
    assert load_run("again").hash == run.hash


@pytest.mark.long
def test_a_flight_that_no_command_names_is_flown_again_by_its_test(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        import pytest
        from hil import Experiment

        @pytest.mark.floaty(seeds=[4])
        def test_it(floaty):
            assert floaty.fly(Experiment("mine", "", 0.3, {"rms_x": 1e-9})).passed
        """)
    result = pytester.runpytest_inprocess("--floaty-seeds=2")
    result.assert_outcomes(failed=2)
    (module,) = [path.name for path in pytester.path.glob("test_*.py")]
    result.stdout.fnmatch_lines([f"*again*pytest --floaty-seeds=2 '{module}::test_it[[]seed2[]]'"])


@pytest.mark.long
def test_hypothesis_shrinks_a_failing_flight_without_a_word_about_fixtures(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        from hypothesis import given, settings
        from hil.testing import faults

        @given(push=faults("push.y", start_s=(0.0, 0.0)))
        @settings(max_examples=10, deadline=None, derandomize=True, database=None)
        def test_it(floaty, push):
            floaty.fly(duration_s=0.05, faults=[push], overrides={"flight.release_us": 10_000})
            assert push.size < 2.31
        """)
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*Fault(kind='push.y', start_s=0.0, duration_s=0.1, size=2.4)*"])
    shown = result.stdout.str().partition("floaty flights")[2]
    assert re.findall(r"again +floaty fly hover .*--fault (\S+)", shown) == ["push.y@0=2.4"]


# Baselines

PINNED = """
def test_it(floaty):
    floaty.fly(duration_s=0.2, faults=["push.y@0.05=SIZE"], overrides={"flight.release_us": 200_000})
    floaty.baseline("push")
"""


@pytest.mark.long
def test_a_baseline_is_made_kept_and_left(pytester: pytest.Pytester) -> None:
    test = pytester.path / "tests" / "test_push.py"
    test.parent.mkdir()

    def ran(size: float, *options: str) -> str:
        test.write_text(PINNED.replace("SIZE", str(size)))
        return pytester.runpytest_inprocess("--floaty-keep=none", *options).stdout.str()

    again = "pytest --floaty-update tests/test_push.py::test_it"
    missing = f"test_push.py:4: baseline tests/baselines/push.json: there is none; `{again}` writes it"
    assert missing in ran(0.5)
    assert "floaty: wrote tests/baselines/push.json" in ran(0.5, "--floaty-update")
    assert "1 passed" in ran(0.5, "--floaty-board=python"), "boards share a baseline"
    shown = ran(2.0)
    line = re.search(r"max_y +([\d.]+) +([\d.]+) +([\d.]+)  cm", shown)
    assert line is not None
    before, now, difference = map(float, line.groups())
    assert now - before == pytest.approx(difference, rel=0.01)
    assert re.search(
        r"metrics are equal\.\nE +first difference: row at 0\.\d\d s from the release, truth\.", shown
    )
    assert f"accept the new flights: {again}" in shown
    assert "arguments.py" not in shown
    (pytester.path / "tests/baselines/push.json").write_text("{}")
    with pytest.raises(LabError, match=r"push\.json: not a baseline: "):
        baselines.read(pytester.path / "tests/baselines/push.json")


# What is kept


@pytest.mark.long
@pytest.mark.parametrize(("keep", "numbers"), [("failed", ["2"]), ("all", ["1", "2"]), ("none", [])])
def test_run_folders_are_kept_as_asked(pytester: pytest.Pytester, keep: str, numbers: list[str]) -> None:
    pytester.makepyfile("""
        def test_1(floaty):
            assert floaty.fly(duration_s=0.1).outcome == "completed"

        def test_2(floaty):
            assert floaty.fly(duration_s=0.1).outcome == "lost"
        """)
    result = pytester.runpytest_inprocess(f"--floaty-keep={keep}")
    result.assert_outcomes(passed=1, failed=1)
    assert re.findall(r"test_(\d)-\w+/1", " ".join(kept(pytester))) == numbers
    assert ("runs/pytest" in result.stdout.str()) == (keep != "none")
    assert (pytester.path / "runs" / "pytest").is_dir() == bool(numbers)


def test_every_test_can_examine_the_flight_of_a_module_fixture(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        import pytest

        @pytest.fixture(scope="module")
        def flight(floaty):
            return floaty.fly(duration_s=0.1)

        def test_1(flight):
            assert flight.outcome == "completed"

        def test_2(flight):
            assert flight.log.num_rows > 100
        """)
    pytester.runpytest_inprocess().assert_outcomes(passed=2)
    assert kept(pytester) == []


# What is flown


@pytest.mark.long
def test_a_mark_repeats_a_test_for_every_seed_board_and_profile(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        import pytest

        seen = []

        @pytest.mark.floaty(seeds=2, boards=["python", "c"], profiles=["floaty", "as-flown"])
        def test_it(floaty):
            seen.append((floaty.profile, floaty.target, floaty.seed))

        def test_all():
            assert sorted(seen) == [
                (p, b, s) for p in ("as-flown", "floaty") for b in ("c", "python") for s in (1, 2)
            ]
        """)
    result = pytester.runpytest_inprocess("-v")
    result.assert_outcomes(passed=9)
    result.stdout.fnmatch_lines(["*::test_it[[]as-flown-c-seed2[]] PASSED*"])


@pytest.mark.long
def test_flights_take_what_the_mark_says_and_options_go_before_it(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        import pytest

        @pytest.mark.floaty(seeds=[7], boards=["c"], profiles=["as-flown"])
        def test_it(floaty):
            flown = floaty.fly(duration_s=0.1).result.request
            assert (flown.seed, flown.bench.board, flown.profile) == (7, "c", "as-flown")
            other = floaty.fly(duration_s=0.1, seed=9, board="python", profile="floaty").result.request
            assert (other.seed, other.bench.board, other.profile) == (9, "python", "floaty")
        """)
    pytester.runpytest_inprocess().assert_outcomes(passed=1)


@pytest.mark.parametrize(
    ("marked", "wanted", "found"),
    [
        ({}, Wanted(), [choice()]),
        ({"seeds": 2}, Wanted(), [choice(1), choice(2)]),
        ({"seeds": [5, 3]}, Wanted(), [choice(5), choice(3)]),
        ({"seeds": 20, "boards": ["c"]}, Wanted(1, ("c", "python")), [choice(1), choice(1, "python")]),
        ({"needs": "cortex-m4"}, Wanted(), [choice(1, "cortex-m4")]),
        ({"links": ["radio", "mavlink"]}, Wanted(), [choice(), choice(link="mavlink")]),
        ({"links": ["mavlink"]}, Wanted(link="radio"), [choice()]),
        (
            {"links": ["radio", "mavlink"], "profiles": ["a", "b"], "boards": ["c", "python"], "seeds": 2},
            Wanted(),
            [
                choice(seed, board, profile, link)
                for link in ("radio", "mavlink")
                for profile in ("a", "b")
                for board in ("c", "python")
                for seed in (1, 2)
            ],
        ),
        (
            {"faults": ["push.y@1", ["push.x@1=2", "mocap.dropout@2"], []]},
            Wanted(),
            [
                {**choice(), "faults": faults}
                for faults in (("push.y@1=2",), ("push.x@1=2", "mocap.dropout@2=1"), ())
            ],
        ),
        ({"needs": ["python", "c"]}, Wanted(), [choice(1, "python"), choice(1, "c")]),
        (
            {"faults": ["push.y@1=1", "push.y@1=2"], "seeds": 2},
            Wanted(),
            [{**choice(seed), "faults": (f"push.y@1={size}",)} for size in (1, 2) for seed in (1, 2)],
        ),
        ({"needs": ["lockstep"]}, Wanted(link="udp://x:1"), [choice(link="udp://x:1")]),
        ({}, Wanted(usual_profile="as-flown"), [choice(profile="as-flown")]),
        ({"profiles": ["floaty"]}, Wanted(usual_profile="as-flown"), [choice()]),
        ({"profiles": ["floaty"]}, Wanted(profiles=("as-flown",)), [choice(profile="as-flown")]),
    ],
)
def test_command_line_overrides_mark(marked: dict[str, object], wanted: Wanted, found: list[Options]) -> None:
    assert choices_of(Marked.of(marked), wanted) == found


@pytest.mark.long
def test_paths_start_at_the_root_folder_and_ini_names_the_profile(pytester: pytest.Pytester) -> None:
    pytester.makeini("[pytest]\nfloaty_profile = strict.toml\n")
    (pytester.path / "strict.toml").write_text(STRICT)
    (pytester.path / "flights.py").write_text(
        "from hil import Experiment\nmine = Experiment('mine', '', 0.1, {'lost': 0.0})\n"
    )
    pytester.makepyfile("""
        def test_it(floaty, monkeypatch, tmp_path):
            monkeypatch.chdir(tmp_path)
            assert floaty.fly(duration_s=0.1).verdicts[0].metric == "rms_x"
            assert floaty.fly("flights.py:mine").passed
            assert floaty.board().firmware is not None
        """)
    pytester.runpytest_inprocess().assert_outcomes(passed=1)


# What cannot be had


def test_an_absent_board_is_skipped(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    def runner_of(board: str, logic: object) -> None:
        if board != "c":
            raise ExportError("no C compiler on this machine")

    monkeypatch.setattr(choices, "runner_of", runner_of)
    pytester.makepyfile("""
        import pytest

        @pytest.mark.floaty(boards=["c", "python", "cortex-m4"])
        def test_it(floaty):
            assert floaty.target == "c"

        def test_in_the_middle(floaty):
            floaty.fly(board="python")
        """)
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(passed=1, skipped=3)
    result.stdout.fnmatch_lines(
        [
            "floaty: 2 not flown: board python is not available here: no C compiler on this machine",
            "floaty: 1 not flown: board cortex-m4 is not available here: no C compiler on this machine",
        ]
    )


@pytest.mark.parametrize(
    ("chosen", "needs", "told"),
    [
        (choice(), (), ""),
        (choice(), ("lockstep", "mavlink", "radio"), ""),
        (choice(), ("cortex-m4",), "needs cortex-m4: this flies on c"),
        (choice(link="udp://127.0.0.1:1"), ("lockstep",), "needs lockstep: this flies over udp://127.0.0.1:1"),
        (choice(board="python", link="udp://127.0.0.1:1"), (), "board python: --floaty-link udp://127.0.0.1:1: only c"),
    ],
)  # fmt: skip
def test_a_test_s_needs_decide_whether_it_flies(chosen: Options, needs: tuple[str, ...], told: str) -> None:
    reason = why_not(chosen, needs)
    assert reason.startswith(told)
    assert bool(reason) == bool(told)


def test_a_package_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(choices.PACKAGES, "mavlink", "pymavlink_is_not_here")
    assert why_not(choice(), ("mavlink",)) == "needs mavlink: pymavlink_is_not_here is not installed"


def test_a_package_that_a_test_file_needs_is_one_line(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.setattr(hil.testing, "find_spec", lambda name: None)
    pytester.makepyfile(
        test_learn="import gymnasium",
        test_any="from hil.testing import faults",
        test_late="def test_it(floaty):\n    import gymnasium",
        test_other="from hil.errors import LabError\n\ndef test_it():\n    raise LabError('mine')",
    )
    result = pytester.runpytest_inprocess("--continue-on-collection-errors")
    result.assert_outcomes(failed=2, errors=2)
    shown = result.stdout.str()
    assert "raise LabError('mine')" in shown, "a test without the fixture is not the plugin's"
    for place, package in (("learn.py", "gymnasium"), ("any.py", ".*hypothesis"), ("late.py:2", "gymnasium")):
        assert re.search(rf"^test_{place}: {package} is missing: .* -m pip install ", shown, re.MULTILINE)
    assert "Traceback" not in shown


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ({"sedes": 2}, "sedes: did you mean seeds?"),
        ({"colour": 2}, "colour: there are seeds, boards, profiles, links, faults, needs"),
        ({"links": ["udp://x:1"]}, "links = 'udp://x:1': expected radio, mavlink"),
        ({"faults": ["psh.y@1"]}, "fault 'psh.y@1': unknown kind 'psh.y'; did you mean push.y?"),
        ({"seeds": 0}, "seeds = 0: expected 1 or more"),
        ({"boards": ["arm"]}, "boards = 'arm': expected c, python, cortex-m4"),
        ({"needs": "wings"}, "needs = 'wings': expected c, python, cortex-m4, mavlink, radio, lockstep"),
    ],
)
def test_a_mark_that_cannot_be_is_one_line(words: dict[str, object], told: str) -> None:
    with pytest.raises(LabError) as error:
        Marked.of(words)
    assert str(error.value).startswith(told)


def test_a_wrong_mark_fails_the_collection_in_one_line(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("import pytest\n\n@pytest.mark.floaty(sedes=2)\n" + FLY)
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(errors=1)
    assert "test_it: @pytest.mark.floaty: sedes: did you mean seeds?" in result.stdout.str()
    assert "Traceback" not in result.stdout.str()


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--floaty-board=arm"], "--floaty-board arm: expected c, python, cortex-m4"),
        (["--floaty-seeds=-1"], "--floaty-seeds -1: expected 1 or more"),
        (["--floaty-keep=some"], "invalid choice: 'some'"),
        (["--floaty-link=udp://127.0.0.1:1", "-n2"], "flights in real time fly one at a time; omit -n"),
    ],
)
def test_a_bad_option_is_refused_first(pytester: pytest.Pytester, options: list[str], told: str) -> None:
    pytester.makepyfile(FLY)
    result = pytester.runpytest_inprocess(*options)
    assert result.ret in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.INTERRUPTED)
    assert told in result.stdout.str() + result.stderr.str()


# Records


@pytest.mark.long
def test_the_junit_file_has_hash_command_and_metrics(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(FLY)
    pytester.runpytest_inprocess("--junitxml=junit.xml", "--floaty-keep=all")
    properties = {
        element.attrib["name"]: element.attrib["value"]
        for element in ElementTree.parse(pytester.path / "junit.xml").iter("property")
    }
    (folder,) = kept(pytester)
    flown = json.loads((pytester.path / "runs" / "pytest" / folder / "result.json").read_text())
    assert properties["floaty.hash"] == flown["hash"]
    assert properties["floaty.again"] == "floaty fly hover --seed 1 --duration 0.3"
    assert float(properties["floaty.rms_x [m]"]) == pytest.approx(flown["metrics"]["rms_x"])
    assert float(properties["floaty.lost"]) == 0.0
    assert not any(name.startswith("floaty.settle") for name in properties)
    assert properties["floaty.folder"] == f"runs/pytest/{folder}"


@pytest.mark.long
def test_under_xdist_every_test_has_its_own_folders_and_the_same_hashes(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        import pytest

        @pytest.mark.floaty(seeds=4)
        def test_it(floaty):
            assert floaty.fly(duration_s=0.3).metrics["flown"] > 1.0
        """)
    hashes = []
    for workers in ("-n3", "-n0"):
        result = pytester.runpytest_subprocess(workers, "--junitxml=junit.xml")
        result.assert_outcomes(failed=4)
        assert len(kept(pytester)) == 4
        cases = ElementTree.parse(pytester.path / "junit.xml").iter("property")
        hashes.append(sorted(one.attrib["value"] for one in cases if one.attrib["name"] == "floaty.hash"))
    assert hashes[0] == hashes[1]
    assert len(set(hashes[0])) == 4


# The page


@pytest.mark.long
def test_the_examples_of_the_page_work(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    names: dict[str, object] = {}
    for language, text in blocks(PAGE):
        assert language == "python"
        if named := FILE.match(text):
            path = pytester.path / named[1]
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
        else:
            exec(compile(text, PAGE, "exec"), names)
    assert 3.0 < names["smallest"].size < 6.0  # type: ignore[attr-defined]
    pytester.runpytest_inprocess("tests", "--floaty-update").assert_outcomes(passed=20)
    pytester.runpytest_inprocess("tests/test_pinned.py").assert_outcomes(passed=1)


@pytest.mark.long
@pytest.mark.parametrize("keep", ["failed", "none"])
def test_flights_of_a_failed_test_are_drawn_once_and_named_where_kept(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, keep: str
) -> None:
    """Seen from another folder than pytest's root, with a test whose end fails, too."""
    drawn: list[str] = []
    monkeypatch.setattr(hil.testing.flights, "draw", lambda item: drawn.append(item.name))
    pytester.makepyfile(
        test_it="""
        import pytest
        from hil import Experiment

        @pytest.fixture
        def late():
            yield
            raise ValueError("late")

        def test_it(floaty, late):
            flight = floaty.fly(Experiment("mine", "", 0.05, {}))
            assert flight is None

        def test_end(floaty, late):
            floaty.fly(Experiment("mine", "", 0.05, {}))
        """
    )
    (pytester.path / "below").mkdir()
    monkeypatch.chdir(pytester.path / "below")
    options = ("--floaty-board=c", "--floaty-profile=as-flown, ", "--floaty-seeds=1", f"--floaty-keep={keep}")
    result = pytester.runpytest_inprocess("..", "--rootdir=..", *options)
    result.assert_outcomes(failed=1, passed=1, errors=2)
    shown = result.stdout.str()
    assert len(drawn) == 2 * (keep != "none"), "the second report of a test draws nothing"
    assert shown.count("folder   runs/pytest/") == (3 if keep == "failed" else 0)
    assert len(kept(pytester)) == 2 * (keep == "failed"), "also of a test that only ends badly"
    again = "pytest --floaty-board=c '--floaty-profile=as-flown, ' --floaty-seeds=1 '"
    assert shown.count(again) == shown.count(f"(paths are relative to {pytester.path})") == 3
    assert (re.search(r"<mine, seed 1: .*; .*>", shown) is not None) == (keep == "failed")


@pytest.mark.parametrize("executed", ["none", "wrong", "some"])
def test_the_coverage_of_a_session_is_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, executed: str
) -> None:
    written: list[tuple[str, dict[str, bool]]] = []
    config: Any = SimpleNamespace(
        getoption=lambda name: Path("cov"), invocation_params=SimpleNamespace(dir=tmp_path)
    )
    terminal = SimpleNamespace(config=config, write_line=lambda text, **how: written.append((text, how)))

    def write_coverage(out: Path) -> tuple[str, Path, Path]:
        assert out == tmp_path / "cov"
        if executed == "wrong":
            raise LabError("cov: of another image")
        return "9 of 10", Path("cov.info"), Path("cov.html")

    monkeypatch.setattr("hil.pictures.exports.coverage.write_coverage", write_coverage)
    if executed != "none":
        file_of(tmp_path / "cov", COUNTS).touch()
    plugin._write_coverage(terminal)
    texts = {"none": f"no image flew: {tmp_path}/cov is not written", "wrong": "cov: of another image",
        "some": "coverage: 9 of 10: cov.info, cov.html"}  # fmt: skip
    colours = {"none": {"yellow": True}, "wrong": {"red": True}, "some": {}}
    assert written == [(f"floaty: {texts[executed]}", colours[executed])]
