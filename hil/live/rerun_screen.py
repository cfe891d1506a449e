"""A live flight in rerun's viewer: in its window, in a browser, or in a viewer that is already open."""

import re
import subprocess
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any

import pyarrow as pa

from hil.errors import LabError
from hil.live.window import address_of, end, is_open, open_window, serve_web
from hil.pictures.viewer.layout import blueprint
from hil.pictures.viewer.recording import RerunFlight, stream_to

CATCH_UP_S = 5.0  # granted to the viewer at the end of a live flight


class RerunScreen:
    """`hil.live.picture.Screen` of the targets `window`, `web` and `connect:HOST:PORT`."""

    def __init__(self, target: str) -> None:
        """Open it. Raises `LabError` for an unknown target, or when no viewer opens."""
        self.address = ""
        self._server: subprocess.Popen[bytes] | None = None
        if target == "window":
            taker = open_window()
        elif target == "web":
            self.address, taker, self._server = serve_web()
        else:
            taker = _there(target)
        self._recording = stream_to(taker)
        self._flight: RerunFlight | None = None

    def show_rows(self, rows: pa.Table, events: Iterable[Mapping[str, Any]]) -> None:
        if self._flight is None:
            self._recording.send_blueprint(blueprint(rows.schema, live=True))
            self._flight = RerunFlight(self._recording, rows.schema)
        self._flight.add_rows(rows)
        self._flight.add_events(events)

    def know(self, values: Mapping[str, float]) -> None:
        """Nothing: rerun has no parameters; their changes are texts."""

    def close(self) -> None:
        """Send the rest to the viewer; the browser keeps what it has, the window stays."""
        with suppress(RuntimeError):  # a viewer that was closed, or is stuck
            self._recording.flush(timeout_sec=CATCH_UP_S)
        if self._server is not None:
            end(self._server)


def _there(target: str) -> str:
    """Return the address of a viewer that is open at HOST:PORT."""
    found = re.fullmatch(r"connect:(.+):(\d{1,5})", target)
    if found is None or not 0 < int(found[2]) < 65536:
        raise LabError(f"--view {target}: expected nothing, web, connect:HOST:PORT or foxglove[:parameters]")
    host, port = found[1], int(found[2])
    if not is_open(host, port):
        raise LabError(f"--view {target}: no viewer listens there (rerun --port {port} opens one)")
    return address_of(host, port)
