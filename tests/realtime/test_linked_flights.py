"""Whole flights over real links: a goal that moves, faults of every layer, and what the record says of them."""

import json
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.metrics import column
from support.serving import FLOATY, PATIENCE_S, free_port, serve, station

DONGLE = "radio://0/80/2M/E7E7E7E7E7"
# It stays well within the limits whenever it is released; that depends on the machine.
HOVER = ("hover", "--seed", "2")


def fly(folder: Path, *arguments: str) -> dict[str, Any]:
    command = [*FLOATY, "fly", *arguments, "--out", str(folder)]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert shown.returncode in (0, 1), shown.stdout + shown.stderr
    result: dict[str, Any] = json.loads((folder / "result.json").read_text())
    assert result["outcome"] in ("completed", "lost"), result["cause"]
    return result


def test_the_complete_laboratory_flies_hover_within_its_limits(tmp_path: Path) -> None:
    """Motive, station process and virtual dongle for 8 s; the limits leave a busy machine room, the ages less."""
    result = fly(tmp_path / "run", *HOVER, "--link", DONGLE, "--duration", "8")
    assert result["passed"]
    assert result["metrics"]["flown"] == pytest.approx(8.0, abs=0.1)
    assert 0.1 < result["real_time_factor"] < 1.1
    assert len((tmp_path / "run" / "telemetry.csv").read_text().splitlines()) > 240
    ages_ms = {stage["name"]: stage["mean_us"] / 1000 for stage in result["ages"]}
    assert list(ages_ms) == ["pose", "camera", "processing", "network", "station", "radio"]
    assert (ages_ms["camera"], ages_ms["processing"]) == pytest.approx((20.0, 18.0), abs=0.1)
    assert 38.5 < ages_ms["pose"] < 50.0
    said = [event["text"] for event in load_events(tmp_path / "run")]
    budgets = [line for line in said if line.startswith("pose ")]
    assert budgets
    assert all("camera 20.0 + processing 18.0" in line and "assumed" not in line for line in budgets)
    assert not any("Traceback" in line or "connecting again" in line for line in said)
    assert '<h2 id="poses">Age of the poses</h2>' in (tmp_path / "run" / "report.html").read_text()


def test_hover_holds_its_limits_when_a_third_of_the_packets_is_lost(tmp_path: Path) -> None:
    """On a profile that describes other cameras than the virtual ones."""
    losses = ("--set=radio.uplink_loss=0.3", "--set=radio.downlink_loss=0.3")
    cameras = "system=optitrack multicast=true body=robot axes=z-up origin=[1,2,0] yaw=1 body_yaw=1"
    others = [f"--set=capture.{setting}" for setting in cameras.split()]
    result = fly(tmp_path / "run", *HOVER, "--link", DONGLE, "--duration", "6", *losses, *others)
    assert result["passed"], result["verdicts"]


def address(link: str) -> str:
    return f"udp://127.0.0.1:{free_port()}" if link == "udp" else link


@pytest.mark.parametrize("link", [DONGLE, pytest.param("mavlink:pty", marks=pytest.mark.long)])
def test_the_goal_moves_once_the_board_flies_and_judges_the_flight(tmp_path: Path, link: str) -> None:
    result = fly(tmp_path / "run", "yaw-step", "--link", link)
    assert result["passed"], result["verdicts"]
    log = load_log(tmp_path / "run")
    times, goal = column(log, "t") * 1e-6, column(log, "goal.yaw")
    released = times[np.argmax(column(log, "flight.free"))]
    (stepped,) = times[1:][np.diff(goal) != 0.0]
    # 1 s of the station after the trajectory's begin, which it sees by telemetry; a busy board has flown less by then.
    assert 0.2 < stepped - released < 1.3
    assert goal[-1] == pytest.approx(np.radians(110.0))


@pytest.mark.parametrize(("name", "link"), [("occlusion", "mavlink:pty"), ("airspeed-9.75", "udp")])
def test_experiments_hold_their_limits_over_real_links(tmp_path: Path, name: str, link: str) -> None:
    result = fly(tmp_path / "run", name, "--link", address(link))
    assert result["passed"], result["verdicts"]


@pytest.mark.parametrize(
    ("link", "faults"),
    [
        # Too short for cflib to give the link up, and to connect anew for more than a second.
        (DONGLE, ("radio.cut@1:0.3", "cpu.load@3=0.3", "imu.freeze@4")),
        ("udp", ("radio.loss@1:1=0.3", "mocap.dropout@3:0.7", "servo.slow.1@1=0.5")),
        ("mavlink:pty", ("serial.cut@1:0.7", "push.y@3=0.5", "battery.sag@4:0.5=0.2")),
    ],
)
def test_faults_of_every_layer_act_on_every_link(tmp_path: Path, link: str, faults: tuple[str, ...]) -> None:
    arguments = [f"--fault={fault}" for fault in faults]
    result = fly(tmp_path / "run", *HOVER, "--link", address(link), "--duration", "6", *arguments)
    assert result["outcome"] == "completed"
    medium = link.partition(":")[0].replace("mavlink", "serial")
    assert [stage["name"] for stage in result["ages"]][-1] == medium
    texts = [event["text"] for event in load_events(tmp_path / "run")]
    for fault in faults:
        kind = fault.partition("@")[0]
        assert any(text.startswith(f"fault {kind}@") and text.endswith("begins") for text in texts)
    log = load_log(tmp_path / "run")
    assert column(log, "fault.active").max() >= 1
    state, free = column(log, "supervisor.state"), column(log, "flight.free") == 1
    assert (state[free] == 3).any()  # without poses or IMU for longer than admitted; it ends by itself
    assert state[-1] == 2


def test_faults_of_the_command_line_begin_after_the_release() -> None:
    with serve("--udp", "0", "--station", "--fault", "imu.freeze@0.5:0.1") as served:
        served.wait_for("board 1: released", 60.0)
        served.wait_for(r"fault imu\.freeze@0\.5:0\.1 ends", 60.0)


EIGHT = """
from hil import Along, Experiment

wide = Experiment("wide", "a step in y", 4.0, {"lost": 0.0}, Along(lambda t: (0.0, 0.05 if t > 1.0 else 0.0, 0.0)))
"""


def test_the_station_flies_the_trajectory_of_an_own_file(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(EIGHT)
    result = fly(tmp_path / "run", f"{tmp_path / 'own.py'}:wide", "--link", DONGLE)
    assert result["passed"], result["verdicts"]
    log = load_log(tmp_path / "run")
    assert column(log, "goal.y")[-1] == pytest.approx(0.05)
    assert column(log, "truth.y")[-100:].mean() == pytest.approx(0.05, abs=0.02)


def test_the_tests_of_a_project_fly_over_a_real_link(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        import pytest

        def test_it(floaty):
            flight = floaty.fly(duration_s=2.0)
            assert flight.request.bench.link.startswith("radio://")
            assert flight.outcome == "completed"

        @pytest.mark.floaty(boards=["python"])
        def test_python(floaty):
            floaty.fly()

        @pytest.mark.floaty(needs="lockstep")
        def test_bits(floaty):
            floaty.fly()
        """)
    result = pytester.runpytest_inprocess(f"--floaty-link={DONGLE}")
    result.assert_outcomes(passed=1, skipped=2)
    result.stdout.fnmatch_lines(["floaty: 1 not flown: needs lockstep: this flies over radio://*"])


# A machine that stalls


def test_a_robot_flown_from_outside_survives_a_stall_of_its_world() -> None:
    with serve("--udp", "0", motive=True) as lab:
        with station(lab, lab.udp_uris[0], "--duration", "12") as typed:
            lab.wait_for("released", PATIENCE_S)
            lab.process.send_signal(signal.SIGSTOP)
            time.sleep(1.0)
            lab.process.send_signal(signal.SIGCONT)
            lab.wait_for(r"time stood still for (9|1\d)\d\d ms", PATIENCE_S)
            assert typed.process.wait(PATIENCE_S) == 0, typed.lines
        assert lab.interrupt() == 0
        assert not any("lost" in line for line in lab.lines)
