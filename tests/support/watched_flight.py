"""A flight that all live pictures show at once, with a panel's commands; without sockets, threads and waiting.

What each screen sends to its viewers is text, as in `support.described`.
"""

import base64
import hashlib
import io
import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from PIL import Image

from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.flight import Flight
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live import foxglove_server, panel, rerun_screen
from hil.live.panel_commands import PanelCommands
from support import described

LINES = {  # by the row at which they are typed
    20: ("mark start", "goal 0.05 0.02 1.2 10", "set controller.gain_y -1.5", "set controller.gain_x 9"),
    30: (
        "set predictor.horizon 3",
        "set predictor.horizon 2.5",
        "set servo.trim_1 1",
        "set no.such 1",
        "set",
    ),
    110: ("push.y:0.1=0.5", "servo.stuck.2", "puhs.y", "goal 9 0 0", "goal 1", "pause"),
    120: ("goal 0 0 1.15", "mark late"),
    130: ("clear", "restart", "step 5", "go", "mark last"),
}
PAUSED = ("mark in the pause", "step 30", "step", "go")  # one at each look
REQUESTS: dict[int, Sequence[dict[str, Any]]] = {  # of a Foxglove's, before a piece of rows
    0: [{"op": "getParameters", "parameterNames": [], "id": "all"}],
    1: [{"op": "subscribe", "subscriptions": [{"id": 70 + n, "channelId": n} for n in (1, 3, 4)]}],
    2: [
        {"op": "subscribeParameterUpdates", "parameterNames": ["extCtrl.y_P", "delayComp.horizon"]},
        {
            "op": "setParameters",
            "parameters": [{"name": "extCtrl.x_P", "value": 2}, {"name": "no", "value": 1}],
        },
        {"op": "unsubscribe", "subscriptionIds": [73]},
    ],
    4: [
        {"op": "unsubscribeParameterUpdates", "parameterNames": ["extCtrl.y_P"]},
        {"op": "getParameters", "parameterNames": ["extCtrl.y_P", "no.such"]},
        {"op": "setParameters", "parameters": [{"name": "extCtrl.y_P", "value": "1"}], "id": "text"},
        {"op": "format"},
    ],
    5: [{"op": "subscribe", "subscriptions": [{"id": 80, "channelId": 2}]}, {"op": 1}, {"op": "subscribe"}],
}


class Server:
    """In place of `hil.live.local_server.LocalServer`: acts at once."""

    def __init__(self, wanted: int, owner: Any, handlers: dict[str, Any]) -> None:
        self.host, self.token, self.handlers = f"127.0.0.1:{wanted}", "0123456789abcdef", handlers

    def call(self, act: Callable[[], None]) -> None:
        act()

    def close(self) -> None:
        """Nothing is open."""


class View:
    """The flight's picture: passes its rows on to the screens, and has the lines typed."""

    def __init__(self, target: Path, typed: list[str]) -> None:
        self.rerun = rerun_screen.RerunScreen("window")
        self.web = panel.PanelScreen("fly", typed.append)
        self.foxglove = foxglove_server.FoxgloveScreen(typed.append)
        self.page, self.client = (
            self._connected(kind, screen)
            for kind, screen in ((panel._Socket, self.web), (foxglove_server._Client, self.foxglove))
        )
        self.page._sending, self.sent, self._pieces, self._looks = True, list[Any](), 0, 0
        self.client._queue = self.sent.append
        self.said: list[str] = [f"addresses {self.web.address} {self.foxglove.address}"]
        self._texts: list[dict[str, Any]] = []
        self._paused = list(PAUSED)

    def _connected(self, kind: Any, screen: Any) -> Any:
        client = object.__new__(kind)
        client.server, client.owner = screen._server, screen
        client._queue = lambda message: None
        client.tell = client.tell if kind is foxglove_server._Client else lambda message: None
        client.open()
        vars(client).pop("tell", None)
        return client

    def rows(self, batch: pa.RecordBatch) -> None:
        """Show rows, with the texts before them."""
        for request in REQUESTS.get(self._pieces, ()):
            self.client.on_message(json.dumps(request))
        table, texts, self._texts = pa.Table.from_batches([batch]), self._texts, []
        self._pieces += 1
        if self._pieces == 3:  # a browser's second page opens
            self.said += described.described(
                {"texts": self.web.texts, "values": self.web.values}, "late page"
            )
        for screen in (self.rerun, self.web, self.foxglove):
            screen.show_rows(table, texts)
        late, self.page._late = self.page._late, {}
        late["scene"] = seen(late.get("scene", ""))
        self.said += described.described(late, f"page {self._pieces}")
        self.said += [f"foxglove {self._pieces}: {one}" for one in told(self.sent)]
        self.sent.clear()

    def note(self, t_us: int, source: str, text: str) -> None:
        """Keep a text for the next rows."""
        self._texts.append({"t_us": t_us, "source": source, "text": text})

    def know(self, values: Sequence[tuple[str, float]]) -> None:
        """Show values of parameters."""
        for screen in (self.rerun, self.web, self.foxglove):
            screen.know(dict(values))

    def lines(self) -> list[str]:
        """Return what is typed at a row."""
        self._looks += 1
        return [*LINES.get(self._looks, ())]

    def wait(self) -> list[str]:
        """Return what is typed in a pause."""
        return [self._paused.pop(0)] if self._paused else []

    def answer(self, t_us: int, text: str) -> None:
        """Note an answer."""
        self.said.append(f"answer at {t_us}: {text}")


def seen(picture: str) -> str:
    """Return size and mean colours of a grid of an embedded picture."""
    if not picture:
        return ""
    with Image.open(io.BytesIO(base64.b64decode(picture.partition(",")[2]))) as image:
        grid = image.convert("RGB").resize((8, 8), Image.Resampling.BOX)
        return f"{image.format} {image.size} {described.numbers(np.asarray(grid, float).ravel())}"


def told(messages: Sequence[str | bytes]) -> Iterator[str]:
    """Yield messages: the texts, and the number, first and sum of the bytes of samples by subscription."""
    samples: dict[int, list[bytes]] = {}
    for one in messages:
        if isinstance(one, bytes):
            samples.setdefault(int.from_bytes(one[1:5], "little"), []).append(one)
        else:
            message = json.loads(one)
            for channel in message.get("channels", ()):
                channel["schema"] = hashlib.sha256(channel["schema"].encode()).hexdigest()[:16]
            yield from described.described(message, message.pop("op"))
    for number, data in samples.items():
        times = [int.from_bytes(one[5:13], "little") for one in data]
        yield f"samples of {number}: {described.numbers(times)}; {described.numbers(sum(one) for one in data)}"


def watched(folder: Path) -> Iterator[str]:
    """Yield what the screens show of a flight of 0.6 s, and what its panel's lines do."""
    typed: list[str] = []
    recording, hands = rr.RecordingStream("floaty"), list[PanelCommands]()
    recording.save(folder / "live.rrd")
    with pytest.MonkeyPatch.context() as patch:
        for module in (panel, foxglove_server):
            patch.setattr(module, "LocalServer", Server)
        patch.setattr(rerun_screen, "open_window", lambda: "a window")
        patch.setattr(rerun_screen, "stream_to", lambda address: recording)
        view = View(folder / "live.rrd", typed)

        def progress(now_us: int, flight: Flight) -> None:
            if not hands:
                hands.append(PanelCommands(view, flight))  # type: ignore[arg-type]

        result = fly(Request.of(EXPERIMENTS["hover"], duration_s=0.6), folder / "run", progress, view)
        for screen in (view.rerun, view.web, view.foxglove):
            screen.close()
    recording.disconnect()
    yield from view.said
    yield f"outcome {result.outcome}, typed {typed}"
    yield from (folder / "run" / "events.jsonl").read_text().splitlines()
    for line in described.recording(folder / "live.rrd"):
        yield re.sub(r"(\S:) \d+ (?=\S)", r"\1 ", line, count=1)  # rerun joins batches by the wall clock
    for program in panel.COMMANDS:
        yield from described.described(json.loads(panel._content(program)), f"panel of {program}")
