"""What `--view` can mean, each as the process that it is; a viewer that is not there is one line before the flight."""

import gc
import socket
import sys
from pathlib import Path

import pytest

from hil.errors import LabError
from hil.live import window
from hil.live.feed import open_view
from hil.live.local_server import LocalServer
from hil.live.window import DISPLAYS, LOOPBACK, free_port, open_window, show


@pytest.mark.long
def test_a_missing_viewer_is_reported_before_the_flight() -> None:
    port = free_port(0)
    with pytest.raises(LabError, match=f"connect:127.0.0.1:{port}: no viewer listens there"):
        open_view(f"connect:127.0.0.1:{port}", "fly", [].append)


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


def test_a_port_that_is_taken_gives_way_to_one_that_is_free() -> None:
    wanted = free_port(0)
    assert free_port(wanted) == wanted
    with window.socket.create_server((LOOPBACK, wanted)):
        assert free_port(wanted) != wanted


def test_a_server_takes_another_port_when_its_own_is_in_use_and_leaves_no_socket() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        server = LocalServer(other.getsockname()[1], None, {})
    host, port = server.host.split(":")
    socket.create_connection((host, int(port)), timeout=10.0).close()
    server.close()
    gc.collect()  # a socket that nobody closed warns, and a warning fails the test
