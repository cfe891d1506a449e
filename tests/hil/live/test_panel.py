"""The control panel's server: who may come, what it shows, and that a late page gets the newest state."""

import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import WebSocketClientConnection, websocket_connect

from firmware_py.table import OF_PROFILE
from ground_station import operator
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.files.recorder import load_log
from hil.laboratory.metrics import body
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live.panel import (
    BATCHES_KEPT,
    COMMANDS,
    LINE_MOST,
    ROWS_MOST,
    TEXTS_MOST,
    PanelScreen,
    _Socket,
    _state,
)
from hil.servers import live_faults
from support.foxglove_client import current_loop


@pytest.fixture
def typed() -> list[str]:
    return []


@pytest.fixture
def panel(typed: list[str]) -> Iterator[PanelScreen]:
    panel = PanelScreen("fly", typed.append)
    yield panel
    panel.close()


@pytest.fixture
def loop() -> Iterator[IOLoop]:
    loop = current_loop()
    yield loop
    loop.close(all_fds=True)


def connect(loop: IOLoop, panel: PanelScreen, token: str, origin: str) -> WebSocketClientConnection:
    address = f"{panel.origin.replace('http', 'ws')}/socket?token={token}"
    return loop.run_sync(
        lambda: websocket_connect(HTTPRequest(address, headers={"Origin": origin})), timeout=20
    )


def receive(loop: IOLoop, socket: WebSocketClientConnection) -> dict:
    text = loop.run_sync(socket.read_message, timeout=20)
    assert isinstance(text, str)
    return json.loads(text)


@pytest.mark.parametrize("program", COMMANDS)
def test_a_program_s_panel_has_its_commands(program: str) -> None:
    panel = PanelScreen(program, [].append)
    with urllib.request.urlopen(panel.address, timeout=20) as answered:
        page, headers = answered.read().decode(), answered.headers
    panel.close()
    policy = ("default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
        f"connect-src ws://{panel.origin[7:]}; frame-src http://127.0.0.1:*; frame-ancestors 'none'")  # fmt: skip
    kept = ("Content-Security-Policy", "Referrer-Policy", "Cache-Control")
    assert [headers[name] for name in kept] == [policy, "no-referrer", "no-store"]
    content = json.loads(page.split('id="content">')[1].split("</script>")[0])
    assert content["commands"] == list(COMMANDS[program])
    assert bool(content["faults"]) == (program != "station")
    assert bool(content["parameters"]) == (program != "serve")
    assert "uPlot=function" in page
    known = {"fly": {"goal", "set", "clear", "mark", "pause", "step", "go", "stop"}, "serve": {*live_faults.COMMANDS},
        "station": {*operator.COMMANDS}}[program]  # fmt: skip
    assert set(content["commands"]) - {"fault"} <= known
    assert {one["name"]: (one["low"], one["high"], one["scale"], one["board"]) for one in content["parameters"]} == {
        key: (*one.bounds, one.scale, one.name) for key, one in OF_PROFILE.items() if program != "serve"}  # fmt: skip
    assert {one["name"]: (one["low"], one["high"], one["size"], one["unit"], one["sized"]) for one in content["faults"]} == {
        name: (one.low, one.high, one.size, one.unit, one.sized) for name, one in KINDS.items() if program != "station"
    }  # fmt: skip


@pytest.mark.parametrize("wrong", ["token", "host"])
def test_a_page_without_the_token_or_by_another_name_is_refused(panel: PanelScreen, wrong: str) -> None:
    address = panel.address if wrong == "host" else f"{panel.origin}/?token=guessed"
    request = urllib.request.Request(address, headers={"Host": "evil.example"} if wrong == "host" else {})
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request, timeout=20)
    assert refused.value.code == 403
    assert refused.value.read().decode() == "Use the address that floaty prints, token and all.\n"
    refused.value.close()


@pytest.mark.parametrize("wrong", ["token", "origin", "longer origin"])
def test_a_foreign_socket_is_refused(panel: PanelScreen, loop: IOLoop, typed: list[str], wrong: str) -> None:
    token = "guessed" if wrong == "token" else panel.token
    origin = {"token": panel.origin, "origin": "http://evil.example"}.get(
        wrong, f"{panel.origin}.evil.example"
    )
    with pytest.raises(HTTPClientError) as refused:
        connect(loop, panel, token, origin)
    assert refused.value.code == 403
    assert typed == []


def test_lines_reach_the_flight_and_bad_ones_fail(panel: PanelScreen, loop: IOLoop, typed: list[str]) -> None:
    socket = connect(loop, panel, panel.token, panel.origin)
    assert receive(loop, socket)["texts"] == []
    longest, bad = "x" * LINE_MOST, ("x" * (LINE_MOST + 1), "", "a\nb")
    for line in ("mark one", longest, *bad, "mark two"):
        loop.run_sync(lambda line=line: socket.write_message(line))
    answers: list[str] = []
    while len(answers) < len(bad):
        answers += receive(loop, socket)["texts"]
    told = f"expected 1..{LINE_MOST} printable ones"
    assert answers == [f"panel: a line of {len(line)} characters: {told}" for line in bad]
    panel.know({"extCtrl.y_P": 1.6})
    assert receive(loop, socket)["values"] == {"extCtrl.y_P": 1.6}
    assert typed == ["mark one", longest, "mark two"]
    socket.close()


def test_a_page_that_opens_later_gets_the_newest_texts_and_all_values() -> None:
    told: list[Any] = []
    pages = [SimpleNamespace(tell=told.append)]
    panel: Any = SimpleNamespace(texts=[], values={}, pages=pages)
    messages = [{"texts": [f"{n}", f"{n}+"], "values": {f"{n % 3}": n}} for n in range(TEXTS_MOST)]
    for message in messages:
        PanelScreen._tell(panel, message)
    half = TEXTS_MOST // 2
    assert panel.texts == [text for n in range(half, TEXTS_MOST) for text in (f"{n}", f"{n}+")]
    assert sorted(panel.values.values()) == [TEXTS_MOST - 3, TEXTS_MOST - 2, TEXTS_MOST - 1]
    assert told == messages


def test_a_page_that_reads_slowly_gets_the_newest_rows_and_texts_and_all_values() -> None:
    page = SimpleNamespace(_late={}, _sending=True)
    for n in range(ROWS_MOST + 10):
        _Socket.tell(page, {"curves": [[n]], "texts": [f"{n}"], "values": {f"{n % 60}": n}, "state": n})  # type: ignore[arg-type]
    late, last = page._late, ROWS_MOST + 9
    assert (late["curves"], late["state"]) == ([[n] for n in range(10, ROWS_MOST + 10)], last)
    assert late["texts"] == [f"{n}" for n in range(last - TEXTS_MOST + 1, last + 1)]
    assert sorted(late["values"].values()) == list(range(last - 59, last + 1))


def test_a_page_shows_only_the_newest_row(panel: PanelScreen, loop: IOLoop, tmp_path: Path) -> None:
    request = Request.of(EXPERIMENTS["hover"], duration_s=0.5, faults=("push.x@0.1:0.2=0.1",))
    fly(request, tmp_path / "run")
    log = load_log(tmp_path / "run")
    socket = connect(loop, panel, panel.token, panel.origin)
    receive(loop, socket)
    for first in range(0, 140, 20):
        panel.show_rows(log.slice(first, 20), [{"t_us": 0, "source": "lab", "text": f"from {first}"}])
    texts: list[str] = []
    curves: list[list[float]] = []
    while len(texts) < 7:
        message = receive(loop, socket)
        texts += message["texts"]
        curves += message["curves"]
    assert texts == [f"lab: from {first}" for first in range(0, 140, 20)]
    assert [row[0] for row in curves] == pytest.approx([-1.0 + 0.05 * index for index in range(28)], abs=0.01)
    assert [row[0] for row in curves if row[-1]] == pytest.approx([0.1, 0.15, 0.2, 0.25], abs=0.011)
    assert message["state"]["t_s"] == pytest.approx(0.39, abs=0.01)
    assert message["state"]["supervisor"] == "flying"
    assert message["state"]["goal"] == [0.0, 0.0, 1.15, 0.0]
    assert message["scene"].startswith("data:image/png;base64,")
    assert pa.concat_tables(panel._past).num_rows == 140, "the path of the last seconds"
    at = log.column_names.index("truth.y")
    unseen = log.slice(0, 1).set_column(at, "truth.y", [[float("nan")]])
    assert _state(unseen)["body"] == [0.0, None, 1.15], "JSON has no NaN"
    turned = log.slice(0, 1).set_column(log.column_names.index("goal.yaw"), "goal.yaw", [[0.5]])
    assert _state(turned)["goal"] == [0.0, 0.0, 1.15, 28.65], "degrees"
    for first in range(140, 140 + BATCHES_KEPT):
        panel.show_rows(log.slice(first % 150, 1), [])
    assert [len(panel._past), panel._past[-1]["t"][0]] == [BATCHES_KEPT, log["t"][(139 + BATCHES_KEPT) % 150]]
    socket.close()


@pytest.mark.long
def test_the_scene_has_the_goals_of_the_whole_flight_and_the_path_of_the_last_seconds(
    panel: PanelScreen, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.5), tmp_path / "run")
    log, drawn = load_log(tmp_path / "run"), []
    y = log["truth.y"].to_numpy().copy()
    y[3] = np.nan  # one place of which a part is unknown
    log = log.set_column(log.column_names.index("truth.y"), "truth.y", pa.array(y))
    log = log.set_column(log.column_names.index("goal.x"), "goal.x", pa.array(np.arange(150.0)))

    class Scene:
        def __init__(self, look: Any, goals: Any, places: Any) -> None:
            drawn.append([goals, places])

        def at(self, row: pa.Table, trail: Any, course: Any) -> Any:
            drawn[-1] += [row["t"][0].as_py(), trail, course]
            return SimpleNamespace(save=lambda file, **how: file.write(b"x"))

    monkeypatch.setattr("hil.live.panel.VideoScene", Scene)
    panel.pages.add(lambda message: None)  # type: ignore[arg-type]
    monkeypatch.setattr(panel, "_tell", lambda message: None)
    for first in (0, 20):
        panel.show_rows(log.slice(first, 20), [])
    (_, places, at_us, trail, course) = drawn[-1]
    assert [goals[:, 0].tolist() for goals, *_ in drawn] == [[19.0], [19.0, 39.0]]
    assert at_us == log["t"][39].as_py()
    assert (
        places.tolist()
        == trail.tolist()
        == body(log.slice(0, 40), "x", "y", "z")[[0, *range(6, 40, 3)]].tolist()
    )
    assert course[:, 0].tolist() == [*range(0, 40, 3)]
    panel.pages.clear()


def test_a_viewer_is_opened_once_when_it_is_asked_for_and_gets_the_rows_from_then_on(
    panel: PanelScreen, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[object] = []
    told: list[dict[str, object]] = []
    viewer = SimpleNamespace(
        address="http://viewer",
        show_rows=lambda *what: shown.append(what),
        close=lambda: shown.append("closed"),
    )
    monkeypatch.setattr("hil.live.panel.RerunScreen", lambda target: shown.append(target) or viewer)
    monkeypatch.setattr(panel._server, "call", lambda call: told.append(call.args[0]))
    rows, event = pa.table({"t": []}), {"t_us": 0, "source": "lab", "text": "x"}
    panel.show_rows(rows, [event])
    panel.wants_viewer = True
    panel.show_rows(rows, iter([event]))
    assert not panel.wants_viewer
    panel.wants_viewer = True  # asked for again by another page
    panel.show_rows(rows, [])
    assert shown == ["web", (rows, [event]), (rows, [])]
    assert told == [{"texts": ["lab: x"]}, {"texts": ["lab: x"], "viewer": "http://viewer"}, {"texts": []}]
    panel.close()
    assert shown[-1] == "closed"
