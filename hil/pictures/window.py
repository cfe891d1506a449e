"""The process of the native viewer, and the thread that feeds it: a window that is slow, stuck or gone never holds a flight.

The viewer is reachable from this machine only and sends no usage statistics. What is sent is `hil.pictures.viewer`'s matter.
"""

import os
import socket
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from hil.errors import LabError

LOOPBACK, PORT = (
    "127.0.0.1",
    9876,
)  # rerun's own port: a window that is already open takes the next flight, too
START_TIMEOUT_S, POLL_S = 20.0, 0.05
SETTLE_S = 1.0  # it listens first and looks for a display then
QUEUE_BATCHES = 64  # a minute of flight
_RERUN = (
    "import sys; from rerun_cli.__main__ import main; sys.exit(main())"  # `-m rerun_cli` loses the exit code
)
COMMAND = (sys.executable, "-c", _RERUN, "--bind", LOOPBACK)

Item = TypeVar("Item")


class LiveFeed(Generic[Item]):
    """Hands items to a sink in a thread of its own; when the sink is slow the oldest waiting ones are dropped, counted."""

    def __init__(self, sink: Callable[[Item], None], capacity: int = QUEUE_BATCHES) -> None:
        self.dropped = 0
        self._sink = sink
        self._waiting: deque[Item] = deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="live feed", daemon=True)
        self._thread.start()

    def offer(self, item: Item) -> None:
        """Queue an item; returns at once."""
        with self._changed:
            if len(self._waiting) == self._capacity:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(item)
            self._changed.notify()

    def close(self, timeout_s: float) -> bool:
        """Let the sink finish what is waiting; False when it did not within the time."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                item = self._waiting.popleft()
            self._sink(item)


def open_window() -> str:
    """Start the viewer, unless one is open, and return its address; it outlives this process.

    Raises `LabError` when it does not come up.
    """
    address = f"rerun+http://{LOOPBACK}:{PORT}/proxy"
    if _is_open():
        return address
    with tempfile.TemporaryFile() as messages:
        viewer = subprocess.Popen(
            [*COMMAND, "--port", str(PORT)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=messages,
            env=_environment(), start_new_session=True,
        )  # fmt: skip
        for _ in range(round(START_TIMEOUT_S / POLL_S)):
            settle_s = SETTLE_S if _is_open() else POLL_S
            try:
                viewer.wait(settle_s)
                break
            except subprocess.TimeoutExpired:
                if settle_s == SETTLE_S:
                    return address
        else:
            viewer.kill()
        messages.seek(0)
        lines = messages.read().decode(errors="replace").split("\n")
    raise LabError(
        f"the viewer does not open ({next(filter(None, reversed(lines)), 'no message')}); it needs a display"
    )


def show_file(path: Path) -> None:
    """Show a recording until the window is closed. Raises `LabError` when no window opens."""
    code = subprocess.run([*COMMAND, str(path)], env=_environment(), check=False).returncode
    if code > 0:
        raise LabError(f"{path}: the viewer ended with code {code}; it needs a display")


def _is_open() -> bool:
    try:
        socket.create_connection((LOOPBACK, PORT), timeout=1.0).close()
    except OSError:
        return False
    return True


def _environment() -> dict[str, str]:
    """Return the viewer's environment: errors only, and CI, where rerun sends no usage statistics."""
    return {"RUST_LOG": "error", **os.environ, "CI": "1", "NO_COLOR": "1", "RERUN_APP_ONLY": "true"}
