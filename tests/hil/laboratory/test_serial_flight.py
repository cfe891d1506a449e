"""Whole flights over the serial line: limits at every baud rate, determinism, wrong bits, signatures, what does not fit."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil

from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.files.result import Result
from hil.laboratory.metrics import column
from hil.laboratory.request import MAVLINK
from hil.pictures.figures import PICTURES
from support.flights import explain, hover
from support.serving import FLOATY

KEY = "5a" * 32


@pytest.mark.long
@pytest.mark.parametrize(
    "baud", [57_600, *(pytest.param(baud, marks=pytest.mark.long) for baud in (115_200, 460_800, 921_600))]
)
def test_hover_holds_its_limits_at_every_baud_rate(tmp_path: Path, baud: int) -> None:
    result = hover(tmp_path / "run", f"serial.baud={baud}", seed=3, duration_s=10.0, link=MAVLINK)
    assert result.passed, explain(result)
    log = load_log(result.folder)
    assert column(log, "serial.overrun")[-1] == 0
    assert column(log, "serial.up_bad")[-1] == 0
    seconds = result.metrics["flown"]
    sent = np.diff(column(log, "serial.up_bytes")[[100, -1]])[0]
    # 10 bits per byte.
    assert result.metrics["line_up"] == pytest.approx(10 * sent / baud / seconds, rel=0.05)


def test_the_budget_is_stated_before_take_off(tmp_path: Path) -> None:
    result = hover(tmp_path / "run", "serial.baud=57600", duration_s=1.0, link=MAVLINK)
    first = load_events(result.folder)[0]
    assert first["t_us"] == 0
    assert first["text"].startswith("57600 baud: uplink ")
    assert "telemetry 25 Hz" in first["text"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """Three seconds of hover over the line, for tests that read what is left of it."""
    return hover(tmp_path_factory.mktemp("serial") / "run", duration_s=3.0, link=MAVLINK)


@pytest.mark.long
def test_wrong_bits_cost_frames_and_nothing_else(tmp_path: Path) -> None:
    noisy = ("serial.uplink_bit_error_rate=1e-4", "serial.downlink_bit_error_rate=1e-4")
    result = hover(tmp_path / "run", *noisy, duration_s=10.0, link=MAVLINK)
    assert result.passed, explain(result)
    log = load_log(result.folder)
    assert column(log, "serial.wrong_bits")[-1] > 20
    for way in ("up", "down"):
        assert column(log, f"serial.{way}_bad")[-1] > 0
        assert column(log, f"serial.{way}_lost")[-1] > 0


@pytest.mark.long
def test_a_signed_line_flies(tmp_path: Path) -> None:
    result = hover(tmp_path / "run", f"mavlink.signing_key='{KEY}'", duration_s=1.0, link=MAVLINK)
    assert result.passed, explain(result)
    assert column(load_log(result.folder), "serial.up_bad")[-1] == 0


@pytest.mark.long
def test_telemetry_over_the_line_is_the_estimate(result: Result) -> None:
    lines = (result.folder / "telemetry.csv").read_text().splitlines()
    names = lines[0].split(",")
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    log = load_log(result.folder)
    for title, name in (
        ("stateEstimate.x [m]", "estimate.x"),
        ("stateEstimate.vz [m/s]", "estimate.vz"),
        ("stateEstimate.yaw [rad]", "estimate.yaw"),
        ("motor.m3 [counts]", "motor.m3"),
    ):
        told = rows[:, names.index(title)]
        at_us = 1000 * rows[:, names.index("board.t [ms]")]
        good = np.isfinite(told) & (at_us > 1_200_000)
        known = np.interp(at_us[good], column(log, "t"), column(log, name))
        step = np.abs(np.diff(column(log, name)[120:])).max()
        assert good.sum() > 100
        assert np.abs(told[good] - known).max() <= 2 * step, title


@pytest.mark.long
def test_the_report_shows_the_line(result: Result) -> None:
    names = load_log(result.folder).column_names
    shown = [picture.title for picture in PICTURES if picture.fits(names)]
    assert "Serial line" in shown
    assert "Radio" not in shown


def test_the_telemetry_log_has_every_frame_on_the_line_with_its_time(result: Result) -> None:
    """pymavlink reads the file, the plant's UART has counted the bytes."""
    log = load_log(result.folder)
    file = mavutil.mavlink_connection(str(result.folder / "link.tlog"))
    frames = []
    while (message := file.recv_match()) is not None:
        frames.append((round(1e6 * message._timestamp), message))
    file.close()
    assert [t_us for t_us, _ in frames] == sorted(t_us for t_us, _ in frames)
    size = {
        system: sum(len(message.get_msgbuf()) for _, message in frames if message.get_srcSystem() == system)
        for system in (255, 1)
    }
    on_the_line = 4 * 280  # frames at the end of the flight
    assert size[255] == pytest.approx(column(log, "serial.up_bytes")[-1], abs=on_the_line)
    assert size[1] == pytest.approx(column(log, "serial.down_bytes")[-1], abs=on_the_line)
    assert (result.folder / "link.tlog").stat().st_size == sum(size.values()) + 8 * len(frames)
    poses = [(t_us, m) for t_us, m in frames if m.get_type() == "ATT_POS_MOCAP"]
    assert len(poses) > 140
    age_us = [t_us - message.time_usec for t_us, message in poses]
    assert np.median(age_us) == pytest.approx(38_000, abs=300), "camera and processing, before it is sent"


@pytest.mark.long
def test_a_line_that_is_there_already_is_left_alone(tmp_path: Path) -> None:
    line = tmp_path / "uart"
    line.write_text("not a line")
    done = subprocess.run(
        [*FLOATY, "fly", "hover", "--link", f"mavlink:{line}", "--out", str(tmp_path / "run")],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 2
    assert f"{line} exists" in done.stderr
    assert done.stderr.count("\n") == 1
    assert line.read_text() == "not a line"
