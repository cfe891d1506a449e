"""Flights on a board behind a link: the exported app in a process of its own, unmodified cflib, sockets in between."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil.experiments import find_experiment
from hil.laboratory.recorder import load_log
from hil.laboratory.result import read_result
from hil.laboratory.run import Request, fly, prepare
from support.app_board import board
from support.command import floaty
from support.crazyflie_app import build_app
from support.plugged_dongle import plug
from support.serving import Served

pytestmark = pytest.mark.realtime
LOSSY = (
    "radio.uplink_loss=0.1",
    "radio.downlink_loss=0.1",
    "radio.uplink_jitter_us=5000",
    "radio.downlink_jitter_us=5000",
)

BEARABLE_S = 0.026  # of the loop's delay, by flights on one time line
SERVO_S = 0.005  # what servos and control period take at least


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_app(tmp_path_factory.mktemp("app"))


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the flight on the board that all others are held to."""
    folder = tmp_path_factory.mktemp("python")
    prepare(folder)
    return fly(Request.of(find_experiment("hover"), duration_s=1.0), folder).hash


@pytest.fixture(scope="module", params=[(), LOSSY], ids=["good", "lossy"])
def served(request: pytest.FixtureRequest, library: Path) -> Iterator[Served]:
    with board(library, *request.param) as served:
        plug(served)
        yield served


@pytest.mark.parametrize("medium", ["radio", "udp"])
def test_a_flight_on_a_board_behind_a_link_is_the_flight_of_python(
    served: Served, medium: str, python: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    (uri,) = served.line(f"{medium} ")
    out = tmp_path / "run"
    assert floaty(monkeypatch, "fly", "hover", "--duration", "1", "--board", uri, "--out", out) == 0
    result = read_result(out)
    assert (result.board, result.hash) == (uri, python)
    assert result.usage.entries["control"].calls == 200


def test_a_board_that_is_killed_in_flight_ends_it_in_one_line_with_what_was_flown(
    library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with board(library) as served:
        (uri,) = served.line("udp ")
        out = tmp_path / "run"

        def kill(now_us: int, flight: object) -> None:
            if now_us > 500_000:
                served.process.kill()

        prepare(out)
        result = fly(Request.of(find_experiment("hover"), duration_s=5.0, board=uri), out, progress=kill)
    assert result.outcome == "error"
    assert re.fullmatch(rf"board {re.escape(uri)}: (silent for 3 s|lost: .*)", result.cause)
    assert 50 < load_log(out).num_rows < 200


@pytest.mark.parametrize("medium", ["radio", "udp"])
@pytest.mark.parametrize("overrides", [(), LOSSY], ids=["good", "lossy"])
def test_hover_with_the_board_in_the_loop_holds_all_limits_or_tells_a_delay_that_hover_does_not_bear(
    library: Path, medium: str, overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    with board(library, *overrides) as served:
        plug(served)
        (uri,) = served.line(f"{medium} ")
        out = tmp_path / "run"
        code = floaty(monkeypatch, "fly", "hover", "--duration", "20", "--board", uri, "--hil", "--out", out)
    result = read_result(out)
    assert result.outcome in ("completed", "lost")
    assert code == 0 or (code == 1 and result.metrics["loop_delay"] > BEARABLE_S), result.verdicts
    assert result.metrics["loop_delay"] > SERVO_S
