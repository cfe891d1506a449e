"""Ctrl-C and the signals of a lost session end a flight at once, whatever executes the flight core and however long its
calls are; the run keeps its log."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hil.laboratory.files.recorder import load_log
from support.own_logic import LAW, make_project
from support.paths import ROOT

pytestmark = pytest.mark.realtime

PATIENCE_S = 60.0  # only a flight that hangs takes so long
# Every call takes most of its budget.
BUSY = LAW.replace(
    "    memory.ticks = i32(memory.ticks + 1)\n",
    "    for i in range(own.after):\n        memory.hidden = memory.hidden + DT\n",
)


@pytest.mark.parametrize(
    ("board", "number"),
    [
        ("c", signal.SIGINT),
        ("python", signal.SIGINT),
        ("cortex-m4", signal.SIGINT),
        ("python", signal.SIGTERM),
        ("c", signal.SIGHUP),
    ],
)
def test_ctrl_c_ends_a_flight_on_any_board_and_keeps_the_log(
    tmp_path: Path, board: str, number: signal.Signals
) -> None:
    profile = make_project(tmp_path, BUSY, "", "after = 130000")
    process = subprocess.Popen(
        (sys.executable, "-m", "hil.commands", "fly", "hover", "--duration", "600", "--profile", profile, "--board", board,
         "--set", "flight.release_us=700000", "--out", "run"),
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    end_s = time.monotonic() + 4 * PATIENCE_S  # the first flight on a machine compiles
    while "released" not in _events(tmp_path / "run") and process.poll() is None and time.monotonic() < end_s:
        time.sleep(0.05)
    process.send_signal(number)
    if number != signal.SIGINT:  # as a terminal and a shell that end together
        process.send_signal(number)
    try:
        shown, _ = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 130, shown
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["outcome"] == "interrupted"
    assert result["cause"] is None
    assert load_log(tmp_path / "run").num_rows > 50
    assert {"report.html", "flight.rrd"} <= set(os.listdir(tmp_path / "run"))


def _events(run: Path) -> str:
    return (run / "events.jsonl").read_text() if (run / "events.jsonl").exists() else ""
