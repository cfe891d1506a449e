"""Flights on a board behind a link: the exported app in a process of its own, unmodified cflib, sockets in between."""

import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import read_result
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from support.app_board import board
from support.command import Cli
from support.plugged_dongle import plug
from support.serving import PATIENCE_S, Served, started

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
def python(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the flight on the board that all others are held to."""
    folder = tmp_path_factory.mktemp("python")
    return fly(Request.of(find_experiment("hover"), duration_s=1.0), folder).hash


@pytest.fixture(scope="module", params=[(), LOSSY], ids=["good", "lossy"])
def served(request: pytest.FixtureRequest, library: Path) -> Iterator[Served]:
    with board(library, *request.param) as served:
        plug(served)
        yield served


@pytest.mark.parametrize("medium", ["radio", "udp"])
def test_a_linked_board_is_equal(cli: Cli, served: Served, medium: str, python: str, tmp_path: Path) -> None:
    (uri,) = served.line(f"{medium} ")
    out = tmp_path / "run"
    assert cli("fly", "hover", "--duration", "1", "--board", uri, "--out", out) == 0
    result = read_result(out)
    assert (result.request.bench.board, result.hash) == (uri, python)
    assert result.usage.entries["control"].calls == 200


def test_killing_the_board_ends_the_flight_in_one_line_with_its_log(library: Path, tmp_path: Path) -> None:
    with board(library) as served:
        (uri,) = served.line("udp ")
        out = tmp_path / "run"

        def kill(now_us: int, flight: object) -> None:
            if now_us > 500_000:
                served.process.kill()

        result = fly(Request.of(find_experiment("hover"), duration_s=5.0, board=uri), out, progress=kill)
    assert result.outcome == "error"
    assert re.fullmatch(rf"board {re.escape(uri)}: (silent for 3 s|lost: .*)", result.cause)
    assert 50 < load_log(out).num_rows < 200


@pytest.mark.parametrize(
    ("medium", "overrides"), [("radio", LOSSY), ("udp", ())], ids=["lossy-radio", "good-udp"]
)
def test_hover_with_the_board_in_the_loop_holds_all_limits(
    cli: Cli, library: Path, medium: str, overrides: tuple[str, ...], tmp_path: Path
) -> None:
    with board(library, *overrides) as served:
        plug(served)
        (uri,) = served.line(f"{medium} ")
        out = tmp_path / "run"
        code = cli("fly", "hover", "--duration", "8", "--board", uri, "--hil", "--out", out)
    result = read_result(out)
    assert (code, result.outcome) == (0, "completed"), result.verdicts
    assert SERVO_S < result.metrics["loop_delay"] < BEARABLE_S
    assert result.metrics["samples_lost"] == 0


@contextmanager
def in_the_loop(library: Path, out: Path, duration_s: int) -> Iterator[tuple[Served, Served, str]]:
    """A board, the host that has it fly in the loop, and its URI, once the board says that it flies."""
    with board(library) as served:
        (uri,) = served.line("udp ")
        duration = ("--duration", str(duration_s))
        with started("fly", "hover", *duration, "--board", uri, "--hil", "--out", out) as host:
            served.wait_for("^state FLYING", PATIENCE_S)
            yield served, host, uri


def test_a_host_that_pauses_finds_the_board_in_failsafe_and_flies_on(library: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with in_the_loop(library, out, 4) as (served, host, _):
        served.forget()
        host.process.send_signal(signal.SIGSTOP)
        served.wait_for("^state FAILSAFE SILENCE", PATIENCE_S)
        host.process.send_signal(signal.SIGCONT)
        served.wait_for("^state FLYING", PATIENCE_S)
        host.process.wait(PATIENCE_S)
    assert read_result(out).outcome == "completed"
