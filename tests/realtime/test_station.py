"""The ground station of a laboratory, in real time: cameras while a board connects, records and what they are good for."""

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from firmware_py.wire.supervisor import State
from firmware_py.wire.telemetry import Sample
from ground_station.config import CaptureConfig, StationConfig
from ground_station.frame_rate import FrameRate
from ground_station.latency import LinkLatency
from ground_station.mocap import MocapFrame
from ground_station.program import LiveStation
from ground_station.records import Records
from ground_station.sources.address import find_source
from ground_station.sources.replay import read_frames
from ground_station.station import GroundStation
from ground_station.trajectory import Goal, Hold
from support.motive_bench import moving
from support.serving import FLOATY, serve


class SlowLink:
    """A board that takes its time to connect, which is when `open` asks whether to give up."""

    uri = "slow"
    latency = LinkLatency("air", 0, measured=False)
    supervisor_state = State.FAILSAFE
    sent = 0

    def open(self, give_up: Callable[[], bool]) -> None:
        for _ in range(12):
            time.sleep(0.1)
            assert not give_up()

    def received(self) -> list[tuple[int, bytes]]:
        return []

    def start_telemetry(self, now_us: int) -> None: ...

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        self.sent += 1

    def receive(self, now_us: int, data: bytes) -> list[Sample]:
        return []

    def notices(self) -> list[str]:
        return []

    def summary(self) -> str:
        return ""

    def check(self) -> None: ...

    def mute(self) -> None: ...

    def close(self) -> None: ...


def test_while_the_board_connects_the_cameras_are_served() -> None:
    said: list[str] = []
    with moving() as lab:
        source = find_source(f"optitrack:127.0.0.1:{lab.motive.port}", CaptureConfig())
        source.open()
        end = time.monotonic() + 1.5
        link = SlowLink()
        ground = GroundStation(link, Hold(Goal((0.0, 0.0, 1.15), 0.0)), None, StationConfig())
        LiveStation(
            link,
            ground,
            source,
            FrameRate(5000, 50.0, 400_000),
            said.append,
            lambda: time.monotonic() > end,
            lambda now_us: None,
            Records(),
        ).run()
        source.close()
    assert 10 < link.sent < 20  # of 0.3 s, not of the 1.5 s before
    assert not any("frames" in line for line in said)


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
