"""What `--view` can mean, each as the process that it is; a viewer that is not there is one line before the flight."""

import gc
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import nullcontext
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import pytest

from hil.errors import LabError
from hil.live import local_server, recording, rerun_screen, window
from hil.live.feed import open_view
from hil.live.local_server import LocalServer
from hil.live.picture import open_screen
from hil.live.rerun_screen import _there
from hil.live.window import DISPLAYS, LOOPBACK, free_port, open_window, show


@pytest.mark.long
def test_a_missing_viewer_is_reported_before_the_flight() -> None:
    port = free_port(0)
    with pytest.raises(LabError, match=f"connect:127.0.0.1:{port}: no viewer listens there"):
        open_view(f"connect:127.0.0.1:{port}", "fly", [].append)


@pytest.mark.parametrize(
    ("target", "told"),
    [
        (f"connect:127.0.0.1{port}", "expected nothing, web, connect:HOST:PORT")
        for port in ("", ":0", ":65536", ":x")
    ]
    + [("connect:127.0.0.1:1", r"no viewer listens there \(rerun --port 1 opens one\)")],
)
def test_a_viewer_is_joined_at_a_port_that_can_be(target: str, told: str) -> None:
    with pytest.raises(LabError, match=f"^--view {target}: {told}"):
        _there(target)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_a_missing_display_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(window, "PORT", free_port(0))
    for name in DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    for opens in (open_window, lambda: show(str(tmp_path / "flight.rrd"))):
        with pytest.raises(
            LabError,
            match=r"^the viewer needs a display, and this computer has none; in a browser: floaty view RUN --view web",
        ):
            opens()


@pytest.mark.parametrize("code", [0, 1, -signal.SIGTERM])
def test_a_window_that_is_closed_or_killed_is_no_error(monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    def run(words: list[str], *, env: object, stderr: IO[bytes], check: bool) -> SimpleNamespace:
        assert words == [*window.COMMAND, "--port", "7", "x.rrd"]
        stderr.write(b"first\nno GPU\n")
        return SimpleNamespace(returncode=code)

    monkeypatch.setattr(window, "_require_display", lambda: None)
    monkeypatch.setattr(window.subprocess, "run", run)
    refused = pytest.raises(LabError, match=r"^x\.rrd: the viewer ended with code 1 \(no GPU\)$")
    with refused if code > 0 else nullcontext():
        show("x.rrd", "--port", "7")


def test_a_port_that_is_taken_gives_way_to_one_that_is_free() -> None:
    wanted = free_port(0)
    assert free_port(wanted) == wanted
    with window.socket.create_server((LOOPBACK, wanted)):
        assert free_port(wanted) != wanted


@pytest.mark.long
def test_a_server_takes_another_port_when_its_own_is_in_use_and_leaves_no_socket() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        server = LocalServer(other.getsockname()[1], None, {})
    host, port = server.host.split(":")
    for size, code in ((local_server.BODY_MAX, 404), (local_server.BODY_MAX + 1, 400)):  # there is no page
        asker = HTTPConnection(host, int(port), timeout=10.0)
        asker.request(
            "POST", "/", headers={"Content-Length": str(size)}, body=bytes(size) if code == 404 else None
        )
        assert asker.getresponse().status == code
        asker.close()
    server.close()
    assert not server._thread.is_alive()
    gc.collect()  # a socket that nobody closed warns, and a warning fails the test


LISTENS = (
    "import socket, sys, time; s = socket.create_server(('127.0.0.1', int(sys.argv[2]))); time.sleep(60)"
)
DIES = (
    "import os, sys; told = 'no display' if os.environ.get('RERUN_APP_ONLY') else 'counted by rerun';"
    "sys.stderr.write('first\\n' * (len(sys.argv) > 1) + told + '\\n\\n'); sys.exit(3)"
)


def test_a_viewer_is_started_once_it_listens_and_ended_with_its_children(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(window, "COMMAND", (sys.executable, "-c", LISTENS))
    monkeypatch.setattr(window, "SETTLE_S", 0.06)  # another time than between two looks
    port = free_port(0)
    assert not window.is_open(LOOPBACK, port)
    viewer = window._start(["--port", str(port)], port)
    assert viewer.poll() is None
    assert window.is_open(LOOPBACK, port)
    window.end(viewer)
    assert viewer.poll() == -9
    window.end(viewer)  # it is gone already


def test_a_viewer_that_does_not_open_is_one_line_with_its_last_message(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(window, "COMMAND", (sys.executable, "-c", DIES))
    monkeypatch.setenv("DISPLAY", ":0")
    with pytest.raises(LabError, match=r"^the viewer does not open \(no display\)$"):
        window._start([], free_port(0))
    with pytest.raises(LabError, match=r"^run.rrd: the viewer ended with code 3 \(no display\)$"):
        show("run.rrd", "--new")
    monkeypatch.setattr(
        window,
        "COMMAND",
        (sys.executable, "-c", "import sys; sys.exit(sys.argv[1:] != ['--new', 'run.rrd'])"),
    )
    show("run.rrd", "--new")
    monkeypatch.setattr(window, "COMMAND", (sys.executable, "-c", "import time; time.sleep(60)"))
    monkeypatch.setattr(window, "START_TIMEOUT_S", 0.1)
    with pytest.raises(LabError, match=r"^the viewer does not open \(no message\)$"):
        window._start([], free_port(0))


def test_viewers_in_a_browser_have_a_port_for_the_page_and_one_for_the_data(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started: list[tuple[list[str], int]] = []
    monkeypatch.setattr(window, "_start", lambda arguments, port: started.append((arguments,
        port)) or "process")  # fmt: skip
    monkeypatch.setattr(window, "free_port", lambda wanted: wanted + 1)
    assert window.serve_web() == ("http://127.0.0.1:9091/?url=rerun%2Bhttp://127.0.0.1:9877/proxy",
        "rerun+http://127.0.0.1:9877/proxy", "process")  # fmt: skip
    assert window.serve_viewer("rerun+http://x") == (9091, "process")
    assert started == [(["--port", "9877", "--serve-web", "--web-viewer-port", "9091",
        "--server-memory-limit", "500MB"], 9877), (["--serve-web", "--web-viewer-port", "9091",
        "rerun+http://x"], 9091)]  # fmt: skip
    monkeypatch.setattr(window, "is_open", lambda host, port: True)
    assert open_window() == "rerun+http://127.0.0.1:9876/proxy"
    assert len(started) == 2, "one is open"
    monkeypatch.setattr(window, "is_open", lambda host, port: False)
    monkeypatch.setenv("DISPLAY", ":0")
    assert open_window() == "rerun+http://127.0.0.1:9876/proxy"
    assert started[2] == (["--port", "9876"], 9876)


@pytest.mark.parametrize(("target", "screen"), [("web", ("panel", "fly", print)),
    ("foxglove", ("foxglove", None)), ("foxglove:parameters", ("foxglove", print)),
    ("window", ("rerun", "window")), ("connect:a:1", ("rerun", "connect:a:1"))])  # fmt: skip
def test_each_target_has_its_screen(
    target: str, screen: tuple[object, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, kind in (
        ("panel.PanelScreen", "panel"),
        ("foxglove_server.FoxgloveScreen", "foxglove"),
        ("rerun_screen.RerunScreen", "rerun"),
    ):
        monkeypatch.setattr(f"hil.live.{name}", lambda *given, kind=kind: (kind, *given))
    assert open_screen(target, "fly", print) == screen


def test_a_run_is_shown_in_a_browser_at_its_instant_until_ctrl_c(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    said: list[str] = []
    served: list[object] = []

    class Links:
        """The links of the report, of which one is followed at once; then Ctrl-C."""

        def __init__(self, run: Path, page_at: Callable[[float], str]) -> None:
            self.page_at = page_at

        def __enter__(self) -> "Links":
            return self

        def __exit__(self, *error: object) -> None:
            served.append("closed")

        def serve_forever(self) -> None:
            served.append(self.page_at(2.0))
            raise KeyboardInterrupt

    monkeypatch.setattr(recording, "Links", Links)
    monkeypatch.setattr(
        recording, "ServedRecording", lambda run: SimpleNamespace(at=lambda at_s: f"rerun+http://x?{at_s:g}")
    )
    monkeypatch.setattr(recording, "serve_viewer", lambda address: served.append(address) or (9091, "viewer"))
    monkeypatch.setattr(recording, "end", served.append)
    monkeypatch.setattr(recording.signal, "signal", lambda *what: served.append(what))
    recording.browse(tmp_path, 1.5, said.append)
    page = "http://127.0.0.1:9091/?url=rerun%2Bhttp://x%3F"
    assert served == [(signal.SIGTERM, signal.default_int_handler), "rerun+http://x?1.5", f"{page}2",
        "viewer", "closed"]  # fmt: skip
    assert said == [
        f"view    {page}1.5",
        "report  http://127.0.0.1:9877/report.html, whose links lead here, as those of the file do, until Ctrl-C",
    ]


def test_a_flight_in_rerun_s_viewer_has_its_layout_once_and_the_server_of_a_page_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[object] = []
    stuck = [RuntimeError("the viewer has gone")]

    def flush(timeout_sec: float) -> None:
        asked.append(("flush", timeout_sec))
        raise stuck.pop()

    def flight(recording: object, schema: object) -> SimpleNamespace:
        asked.append(("flight", schema))
        return SimpleNamespace(
            add_rows=lambda rows: asked.append(("rows", rows.number)), add_events=asked.append
        )

    patch = {"open_window": lambda: "at the window", "serve_web": lambda: ("page", "at the page", "server"),
        "is_open": lambda host, port: (host, port) == ("here", 65535), "end": asked.append, "RerunFlight": flight,
        "blueprint": lambda schema, live: (schema, live)}  # fmt: skip
    for name, value in patch.items():
        monkeypatch.setattr(rerun_screen, name, value)

    def stream_to(address: str) -> SimpleNamespace:
        asked.append(address)
        return SimpleNamespace(send_blueprint=asked.append, flush=flush)

    monkeypatch.setattr(rerun_screen, "stream_to", stream_to)
    for target, taker, page, server in (
        ("window", "at the window", "", []), ("web", "at the page", "page", ["server"]),
        ("connect:here:65535", "rerun+http://here:65535/proxy", "", []),
    ):  # fmt: skip
        asked.clear()
        stuck[:] = [RuntimeError()]
        screen = rerun_screen.RerunScreen(target)
        assert screen.address == page
        for number in (1, 2):
            screen.show_rows(SimpleNamespace(schema="columns", number=number), [f"text {number}"])  # type: ignore[arg-type, list-item]
        screen.know({"a": 1.0})
        screen.close()
        assert asked == [taker, ("columns", True), ("flight", "columns"), ("rows", 1), ["text 1"], ("rows", 2),
            ["text 2"], ("flush", rerun_screen.CATCH_UP_S), *server]  # fmt: skip


def test_a_viewer_prints_errors_only_unless_the_user_wants_more_and_sends_no_usage_statistics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for own, level in (({}, "error"), ({"RUST_LOG": "info", "CI": "", "A": "b"}, "info")):
        monkeypatch.setattr(window.os, "environ", own)
        settings = {"RUST_LOG": level, "CI": "1", "NO_COLOR": "1", "RERUN_APP_ONLY": "true"}
        assert window._environment() == own | settings
