"""The processes of rerun's viewers: the window, and the server of the browser's viewer.

Both are reachable only from this computer and send no usage statistics; `hil.pictures.viewer` sends them data.
"""

import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from typing import IO
from urllib.parse import quote

from hil.errors import LabError

LOOPBACK = "127.0.0.1"
PORT = 9876  # rerun's own: a window that is already open takes the next flight, too
WEB_PORT = 9090  # likewise, of the page
START_TIMEOUT_S, POLL_S = 20.0, 0.05
SETTLE_S = 1.0  # it listens first and opens the display afterwards
SERVER_MEMORY = "500MB"  # of data that a browser which connects late is still shown
# `-m rerun_cli` loses the exit code.
_RERUN = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
COMMAND = (sys.executable, "-c", _RERUN, "--bind", LOOPBACK)
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


def address_of(host: str, port: int) -> str:
    """Return rerun's address of a viewer that receives flights there."""
    return f"rerun+http://{host}:{port}/proxy"


def open_window() -> str:
    """Start the viewer, unless one is open, and return its address; it outlives this process.

    Raises `LabError` when it does not open.
    """
    address = address_of(LOOPBACK, PORT)
    if not is_open(LOOPBACK, PORT):
        _require_display()
        _start(["--port", str(PORT)], PORT)
    return address


def serve_web() -> "tuple[str, str, subprocess.Popen[bytes]]":
    """Serve the viewer to browsers; return the page's address, the address that receives flights, and the process to be
    ended.

    Raises `LabError` when it does not open.
    """
    port, web_port = free_port(PORT), free_port(WEB_PORT)
    address = address_of(LOOPBACK, port)
    server = _start(
        ["--port", str(port), "--serve-web", "--web-viewer-port", str(web_port), "--server-memory-limit", SERVER_MEMORY],
        port,
    )  # fmt: skip
    return page_of(web_port, address), address, server


def serve_viewer(address: str) -> "tuple[int, subprocess.Popen[bytes]]":
    """Serve the viewer to browsers for data that are served at an address; return the page's port and the process to be
    ended.

    Raises `LabError` when it does not open.
    """
    web_port = free_port(WEB_PORT)
    return web_port, _start(["--serve-web", "--web-viewer-port", str(web_port), address], web_port)


def page_of(web_port: int, address: str) -> str:
    """Return the page that shows the data at an address."""
    return f"http://{LOOPBACK}:{web_port}/?url={quote(address, safe=':/')}"


def show(what: str, *options: str) -> None:
    """Show a recording, a file or an address, until the window is closed. Raises `LabError` when no window opens."""
    _require_display()
    with tempfile.TemporaryFile() as messages:
        code = subprocess.run(
            [*COMMAND, *options, what], env=_environment(), stderr=messages, check=False
        ).returncode
        if code > 0:
            raise LabError(f"{what}: the viewer ended with code {code} ({_last_line(messages)})")


def is_open(host: str, port: int) -> bool:
    """Whether a program listens at a TCP port."""
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True


def listen(wanted: int) -> socket.socket:
    """Return a listening socket of this computer that does not block, at the wanted port if it is free."""
    for port in (wanted, 0):
        try:
            listener = socket.create_server((LOOPBACK, port))
        except OSError:
            continue
        listener.setblocking(False)
        return listener
    raise LabError("this computer has no free TCP port")


def free_port(wanted: int) -> int:
    """Return a free TCP port of this computer, the wanted one if it is free."""
    with listen(wanted) as listener:
        return int(listener.getsockname()[1])


def _start(arguments: Sequence[str], port: int) -> "subprocess.Popen[bytes]":
    """Start a viewer that listens at a port. Raises `LabError` when it does not open."""
    with tempfile.TemporaryFile() as messages:
        viewer = subprocess.Popen(
            [*COMMAND, *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=messages,
            env=_environment(), start_new_session=True,
        )  # fmt: skip
        for _ in range(round(START_TIMEOUT_S / POLL_S)):
            settle_s = SETTLE_S if is_open(LOOPBACK, port) else POLL_S
            try:
                viewer.wait(settle_s)
                break
            except subprocess.TimeoutExpired:
                if settle_s == SETTLE_S:
                    return viewer
        else:
            end(viewer)
        raise LabError(f"the viewer does not open ({_last_line(messages)})")


def end(viewer: "subprocess.Popen[bytes]") -> None:
    """End a viewer, which is a child of the process that was started."""
    with suppress(ProcessLookupError):
        os.killpg(viewer.pid, signal.SIGKILL)
    viewer.wait()


def _require_display() -> None:
    if sys.platform == "linux" and not any(os.environ.get(name) for name in DISPLAYS):
        raise LabError(
            "the viewer needs a display, and this computer has none; in a browser: floaty view RUN --view web, or "
            "floaty fly … --view web"
        )


def _last_line(messages: IO[bytes]) -> str:
    messages.seek(0)
    lines = messages.read().decode(errors="replace").split("\n")
    return next(filter(None, map(str.strip, reversed(lines))), "no message")


def _environment() -> dict[str, str]:
    """Return the viewer's environment: errors only, and CI, where rerun sends no usage statistics."""
    return {"RUST_LOG": "error", **os.environ, "CI": "1", "NO_COLOR": "1", "RERUN_APP_ONLY": "true"}
