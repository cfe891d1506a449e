"""The kernel against FreeRTOS V10.4.1: the same scenario gives the same trace, byte for byte."""

import importlib.util
import subprocess
import sys

import pytest

from firmware_py import compiling
from support.paths import ROOT, VECTORS

TOOL = ROOT / "tools" / "freertos_scenario.py"
SCENARIOS = sorted(str(path.relative_to(VECTORS).with_suffix("")) for path in VECTORS.glob("freertos*/*.txt"))

spec = importlib.util.spec_from_file_location("freertos_scenario", TOOL)
freertos_scenario = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = freertos_scenario
spec.loader.exec_module(freertos_scenario)


def recorded(name, mode):
    return (VECTORS / f"{name}.{mode}.csv").read_text()


def test_all_62_random_scenarios_and_17_corners_are_there():
    assert len(SCENARIOS) == 62 + 17


@pytest.mark.parametrize("plain", [False, True], ids=["c", "plain"])
@pytest.mark.parametrize("mode", ["coop", "preempt"])
@pytest.mark.parametrize("name", SCENARIOS)
def test_trace_is_that_of_freertos(name, mode, plain, monkeypatch):
    monkeypatch.setattr(compiling, "PLAIN", plain)
    lines = []
    freertos_scenario.trace((VECTORS / f"{name}.txt").read_text(), mode == "preempt", lines.append)
    assert "".join(lines) == recorded(name, mode)


@pytest.mark.long
@pytest.mark.parametrize("mode", ["coop", "preempt"])
@pytest.mark.parametrize("name", SCENARIOS)
def test_without_a_trace_the_calls_return_the_same_at_the_same_instants(name, mode):
    """Then the kernel jumps over ticks at which nothing can happen; only what the runner itself records is left."""
    scenario = freertos_scenario.parse((VECTORS / f"{name}.txt").read_text())
    lines = []
    run = freertos_scenario.ScenarioRun(
        scenario, mode == "preempt", lambda *record: lines.append(",".join(map(str, record))), traced=False
    )
    run.run()
    runner_events = {"CALL", "RET", "ISR", "TMR_CB", "TMR_RET", "END"}
    assert lines == [
        line for line in recorded(name, mode).splitlines() if line.split(",")[1] in runner_events
    ]


def command(*arguments):
    return subprocess.run(
        [sys.executable, TOOL, *arguments], capture_output=True, text=True, cwd=TOOL.parents[1]
    )


@pytest.mark.long
def test_command_prints_the_trace_of_its_mode():
    result = command(VECTORS / "freertos" / "slices.txt", "--mode", "coop")
    assert (result.returncode, result.stdout) == (0, recorded("freertos/slices", "coop"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("run 5\ntask a 1\n  work x", "line 3: 'x' is not a number"),
        ("run 5\ntask a 1\n  wrok 3", "line 3: 'wrok' is none of"),
        ("run 5\ntask a 1\n  recv 3 0", "line 3: recv 3: there is no such object"),
        ("run 5\ntask a 1\n  resume b", "line 3: resume b: there is no such object"),
        ("run 5\ntask a 1\n  work 1 2", "line 3: work takes 1 operands, not 2"),
        ("run 5\nqueue 1", "line 2: cannot read 'queue 1'"),
        ("run 5\nwork 3", "line 2: cannot read 'work 3'"),
        ("run 5\ntask a 1", "task a has no operations"),
        ("task a 1\n  work 5", "run TICKS"),
        ("run 5\nqueue 1 0\ntask a 1\n  work 5", "queue 1: length 0"),
        ("run 5\ntask a 1\n  yield", "task a at 0.000 ms: 10000 switches at one instant"),
        (
            "run 5\nmutex 1\ntask a 1\n  give 1",
            "task a at 0.000 ms: 10000 calls of the kernel at one instant",
        ),
        ("run 5\ntask a 1\n  delay_until 0", "line 3: delay_until 0: it must be at least 1"),
        (
            "run 5\nmutex 1\ntask a 1\n  take 1 0\n  delay 9\nat 500 isr_give 1",
            "given from an interrupt, held by a",
        ),
    ],
)
def test_bad_scenario_is_one_line_and_exit_code_2(tmp_path, monkeypatch, capsys, text, complaint):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    monkeypatch.setattr(sys, "argv", ["freertos_scenario.py", str(path)])
    assert freertos_scenario.main() == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.count("\n") == 1


@pytest.mark.long
def test_missing_file_and_bad_mode_are_exit_code_2(tmp_path):
    missing = command(tmp_path / "missing.txt")
    assert missing.returncode == 2
    assert "missing.txt" in missing.stderr
    assert command(VECTORS / "freertos" / "demo.txt", "--mode", "sometimes").returncode == 2
