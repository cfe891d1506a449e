"""The control panel of `--view web`: one page with scene, curves and the commands of the terminal.

The scene is drawn here, so that a browser without a graphics card shows it at once; rerun's viewer opens on request.
Reachable only from this computer, with the token in its address; pages of other origins are refused. A pressed button
becomes a line for `typed`; state and answers go to the page, and a newer one replaces a late one.
"""

import io
import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from tornado.ioloop import IOLoop
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from firmware_py.table import OF_PROFILE
from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.files.recorder import stored_in
from hil.laboratory.metrics import body, column
from hil.live.local_server import Guarded, LocalServer
from hil.live.rerun_screen import RerunScreen
from hil.live.window import LOOPBACK
from hil.pictures import curves
from hil.pictures.pages import data_uri, library
from hil.pictures.video import GOAL_COLUMNS, VideoScene
from hil.world.scene import Points, VisualModel

PORT = 9095
PAGE = Path(__file__).with_name("panel.html")
COMMANDS: Mapping[str, tuple[str, ...]] = {  # of each program
    "fly": ("goal", "set", "fault", "clear", "mark", "pause", "step", "go", "stop"),
    "serve": ("fault", "clear", "restart"),
    "station": ("goal", "set", "mark", "arm", "save", "reset", "stop"),
}
DRAWN_EVERY = 5  # rows, of the curves: 20 Hz
BATCHES_KEPT = 20  # for the paths: four seconds
ROWS_MOST = 400  # of the curves that a late page still gets: 20 s
LINE_MOST = 200  # letters
TEXTS_MOST = 50  # for a page that opens late


class PanelScreen:
    """`hil.live.picture.Screen` of `web`; `program` chooses the commands, `typed` takes a line."""

    def __init__(self, program: str, typed: Callable[[str], None]) -> None:
        self._viewer: RerunScreen | None = None  # rerun's, once it is requested
        self.wants_viewer = False
        self._past: list[pa.Table] = []  # the rows of the last seconds
        self._goals: list[Points] = []  # (3,) [m] each, of the whole flight: the picture shows them all
        self.typed = typed
        self.pages: set[_Socket] = set()
        self.texts: list[str] = []
        self.values: dict[str, float] = {}
        self._content = _content(program)
        self._server = LocalServer(PORT, self, {"/": _Page, "/socket": _Socket})
        self.token, self.origin = self._server.token, f"http://{self._server.host}"
        self.address = f"{self.origin}/?token={self.token}"

    def show_rows(self, rows: pa.Table, events: Iterable[Mapping[str, Any]]) -> None:
        texts = list(events)
        message: dict[str, Any] = {"texts": [f"{one['source']}: {one['text']}" for one in texts]}
        if self.wants_viewer and self._viewer is None:
            message |= self._open_viewer()
        if self._viewer is not None:
            self._viewer.show_rows(rows, texts)
        if rows.num_rows:
            self._past = [*self._past, rows][-BATCHES_KEPT:]
            if self.pages:
                message |= self._drawn(rows)
        self._server.call(partial(self._tell, message))

    def _open_viewer(self) -> dict[str, Any]:
        self.wants_viewer = False
        try:
            self._viewer = RerunScreen("web")
        except LabError as error:
            return {"texts": [f"panel: {error}"]}
        return {"viewer": self._viewer.address}

    def _drawn(self, rows: pa.Table) -> dict[str, Any]:
        """Return state, scene and curves of the newest rows."""
        row = rows.slice(rows.num_rows - 1)
        message: dict[str, Any] = {"state": _state(row), **_curves(rows)}
        if np.isfinite(body(row, "x", "qw")).all():
            past = pa.concat_tables(self._past)
            path, course = body(past, "x", "y", "z")[::3], column(past, *GOAL_COLUMNS)[::3]
            path, file = path[np.isfinite(path).all(axis=1)], io.BytesIO()
            self._goals.append(column(row, *GOAL_COLUMNS)[0])
            scene = VideoScene(
                VisualModel.read(stored_in(row.schema.metadata, "look")), np.array(self._goals), path
            )
            scene.at(row, path, course).save(file, format="png", compress_level=1)
            message["scene"] = data_uri(file.getvalue())
        return message

    def know(self, values: Mapping[str, float]) -> None:
        self._server.call(partial(self._tell, {"values": dict(values)}))

    def close(self) -> None:
        self._server.close()
        if self._viewer is not None:
            self._viewer.close()

    def page(self) -> str:
        """Return the page with its commands."""
        text = PAGE.read_text(encoding="utf-8").replace("CONTENT", self._content)
        return text.replace("/* uPlot */", library()["style"]).replace("// uPlot", library()["script"])

    # In the thread of the server

    def _tell(self, message: dict[str, Any]) -> None:
        self.texts = [*self.texts, *message.get("texts", ())][-TEXTS_MOST:]
        self.values |= message.get("values", {})
        for page in self.pages.copy():
            page.tell(message)


class _Page(Guarded):
    owner: PanelScreen

    def get(self) -> None:
        self.set_header("Content-Security-Policy", (
            "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
            f"connect-src ws://{self.request.host}; frame-src http://{LOOPBACK}:*; frame-ancestors 'none'"
        ))  # fmt: skip
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("Cache-Control", "no-store")
        self.finish(self.owner.page())


class _Socket(Guarded, WebSocketHandler):
    owner: PanelScreen

    def check_origin(self, origin: str) -> bool:
        """Whether a page may connect: the panel's own."""
        return origin == self.owner.origin

    def open(self, *_: str) -> None:
        self._sending = False
        self._late: dict[str, Any] = {}
        self.owner.pages.add(self)
        self.tell({"texts": self.owner.texts, "values": self.owner.values})

    def on_message(self, message: str | bytes) -> None:
        """Pass a line on."""
        line = message if isinstance(message, str) else ""
        if line == "viewer":
            self.owner.wants_viewer = True
        elif line.isprintable() and 0 < len(line) <= LINE_MOST:
            self.owner.typed(line)
        else:
            text = f"panel: a line of {len(message)} characters: expected 1..{LINE_MOST} printable ones"
            self.tell({"texts": [text]})

    def on_close(self) -> None:
        self.owner.pages.discard(self)

    def tell(self, message: dict[str, Any]) -> None:
        """Send a message; while the last one is under way, only the newest state waits, with all texts and values."""
        texts = [*self._late.get("texts", ()), *message.get("texts", ())]
        values = {**self._late.get("values", {}), **message.get("values", {})}
        rows = [*self._late.get("curves", ()), *message.get("curves", ())]
        self._late |= message | {"texts": texts[-TEXTS_MOST:], "values": values, "curves": rows[-ROWS_MOST:]}
        if not self._sending:
            IOLoop.current().add_callback(self._send)

    async def _send(self) -> None:
        if self._sending:
            return
        self._sending = True
        with suppress(WebSocketClosedError):
            while self._late:
                message, self._late = self._late, {}
                await self.write_message(json.dumps(message))
        self._sending = False


def _content(program: str) -> str:
    """Return what the page is made of, as JSON that may be part of a script."""
    faults = [
        {"name": name, "unit": kind.unit, "size": kind.size, "low": kind.low, "high": kind.high, "sized": kind.sized,
         "meaning": kind.meaning}
        for name, kind in KINDS.items()
    ]  # fmt: skip
    parameters = [
        {"name": key, "unit": one.unit if abs(one.scale) == 1 else "", "low": one.bounds[0], "high": one.bounds[1],
         "board": one.name, "scale": one.scale}
        for key, one in OF_PROFILE.items()
    ]  # fmt: skip
    content = {
        "program": program, "commands": COMMANDS[program],
        "faults": faults if "fault" in COMMANDS[program] else [],
        "parameters": parameters if "set" in COMMANDS[program] else [],
    }  # fmt: skip
    return json.dumps(content).replace("<", "\\u003c")


def _state(row: pa.Table) -> dict[str, Any]:
    """Return what the page shows of a row: seconds, states, and goal and body [m, deg]."""
    state = int(column(row, "supervisor.state")[0])
    goal = column(row, "goal.x", "goal.y", "goal.z", "goal.yaw")[0]
    place = body(row, "x", "y", "z")[0]
    return {
        "t_s": round(float(curves.since_release(row)[0]), 2),
        "supervisor": curves.SUPERVISOR.names[state],
        "goal": [*(round(float(value), 4) for value in goal[:3]), round(float(goal[3]) * 57.29578, 2)],
        "body": [round(float(value), 4) if value == value else None for value in place],
    }


def _curves(rows: pa.Table) -> dict[str, Any]:
    """Return the title and names of each graph, and of every fifth row time [s], all values and the number of faults.

    An unknown value is None.
    """
    some = rows.take(np.arange(0, rows.num_rows, DRAWN_EVERY))
    shown = curves.errors_and_actuators(some)
    faults = column(some, "fault.active") if "fault.active" in some.column_names else np.zeros(some.num_rows)
    table = np.round(
        np.column_stack((curves.since_release(some), *(curve.read(some) for _, curve in shown), faults)), 3
    )
    return {
        "graphs": [[f"{title} [{curve.unit}]", *curve.names] for title, curve in shown],
        "curves": [[value if value == value else None for value in row] for row in table.tolist()],
    }
