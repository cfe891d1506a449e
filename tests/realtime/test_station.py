"""The ground station of a laboratory, in real time: records and what they are good for."""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from ground_station.sources.replay import read_frames
from support.serving import FLOATY, serve

ALONE = (sys.executable, "-m", "ground_station")


def station(
    *arguments: str, command: Sequence[str] = (*FLOATY, "station")
) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=60)


@pytest.mark.long
def test_a_flight_is_recorded_and_its_record_flown_again(tmp_path: Path) -> None:
    profile, frames = tmp_path / "lab.toml", tmp_path / "frames.csv"
    with serve("--mavlink", "pty", motive=True) as lab:
        link = "mavlink:" + lab.line("mavlink ")[0]
        port = lab.line("motive ")[0].split(":")[2]
        profile.write_text(
            f'base = "floaty"\n[capture]\nsystem = "optitrack"\nport = {port}\nbody = "floaty"\n'
        )
        shown = station(
            "--link", link, "--profile", str(profile), "--duration", "8", "--record", str(frames), "--log",
            str(tmp_path / "telemetry.csv"),
        )  # fmt: skip
        assert shown.returncode == 0, shown.stdout + shown.stderr
        recorded = read_frames(frames)
        assert len(recorded) > 800
        assert max(abs(frame.p_WB[2] - 1.15) for _, frame in recorded) < 0.1
        begin_s = time.monotonic()
        shown = station("--link", link, "--mocap", f"replay:{frames}", command=ALONE)
        assert shown.returncode == 0, shown.stdout + shown.stderr
        assert f"the recording is over: {len(recorded)} frames" in shown.stdout
        assert time.monotonic() - begin_s > (recorded[-1][0] - recorded[0][0]) * 1e-6
        assert len(read_frames(tmp_path / "telemetry.csv")) > 100
        shown = station("--link", link, "--mocap", f"replay:{tmp_path}")
        assert "a frame every" in shown.stdout  # telemetry has 50 a second
