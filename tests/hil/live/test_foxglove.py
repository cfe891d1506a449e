"""Foxglove's view of a flight: what a client of its protocol is told, and what it can change."""

import json
import threading
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import foxglove
import pytest
from tornado.httpclient import HTTPClientError

from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import load_log
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live.foxglove_server import FoxgloveScreen
from hil.pictures.exports.mcap import log_rows
from support.foxglove_client import FoxgloveClient


@pytest.fixture
def typed() -> list[str]:
    """What the operator is to do."""
    return []


@pytest.fixture
def screen(typed: list[str]) -> Iterator[FoxgloveScreen]:
    screen = FoxgloveScreen(typed.append)
    yield screen
    screen.close()


@pytest.fixture
def client(screen: FoxgloveScreen) -> Iterator[FoxgloveClient]:
    client = FoxgloveClient(screen.address)
    assert "parameters" in client.receive("serverInfo")["capabilities"]
    assert client.selected == "foxglove.sdk.v1"
    yield client
    client.close()


def values(message: dict) -> dict[str, float]:
    return {parameter["name"]: parameter["value"] for parameter in message["parameters"]}


def test_changed_parameter_is_shown(screen: FoxgloveScreen, client: FoxgloveClient, typed: list[str]) -> None:
    screen.know({"extCtrl.y_P": 1.6, "extCtrl.z_P": 2.0})
    client.send(op="getParameters", parameterNames=[], id="all")
    assert values(client.receive("parameterValues")) == {"extCtrl.y_P": 1.6, "extCtrl.z_P": 2.0}
    client.send(op="subscribeParameterUpdates", parameterNames=["extCtrl.y_P", "extCtrl.z_P"])
    wish = [{"name": "extCtrl.y_P", "value": 2.5}, {"name": "no.such", "value": 1.0}]
    client.send(op="setParameters", parameters=wish, id="wish")
    assert values(client.receive("parameterValues")) == {"extCtrl.y_P": 1.6}
    assert typed == ["set extCtrl.y_P 2.5"]
    screen.know({"extCtrl.y_P": 2.5})
    while values(client.receive("parameterValues")) != {"extCtrl.y_P": 2.5}:
        pass
    client.send(op="unsubscribeParameterUpdates", parameterNames=["extCtrl.y_P"])
    client.send(op="getParameters", parameterNames=["extCtrl.z_P"], id="one")
    assert values(client.receive("parameterValues")) == {"extCtrl.z_P": 2.0}
    screen.know({"extCtrl.y_P": 2.75})
    screen.know({"extCtrl.z_P": 2.25})
    assert values(client.receive("parameterValues")) == {"extCtrl.z_P": 2.25}, (
        "the other one is still subscribed to"
    )
    screen.know({"extCtrl.y_P": 2.5})
    wrong = [{"name": "extCtrl.y_P", "value": value} for value in ("stop", True, None, [1.0])]
    client.send(op="setParameters", parameters=wrong)
    assert values(client.receive("parameterValues")) == {"extCtrl.y_P": 2.5}
    for malformed in ({"op": "format"}, {"op": "subscribe"}, {"parameters": 1}):
        client.send(**malformed)
        assert client.receive("status")["level"] == 2
    assert typed == ["set extCtrl.y_P 2.5"]


def test_parameters_that_nobody_asked_for_are_neither_shown_nor_changed() -> None:
    screen = FoxgloveScreen(None)
    client = FoxgloveClient(screen.address)
    assert client.receive("serverInfo")["capabilities"] == []
    screen.know({"extCtrl.y_P": 1.6})
    for request in ("getParameters", "setParameters"):
        client.send(
            op=request, parameterNames=[], parameters=[{"name": "extCtrl.y_P", "value": 2.5}], id="any"
        )
        assert client.receive("status")["level"] == 2
    client.close()
    while screen.clients:  # until the server has read that it has gone
        turn = threading.Event()
        screen._server.call(turn.set)
        assert turn.wait(20.0)
    screen.close()


@pytest.mark.parametrize(
    ("refused", "token", "headers"),
    [
        (True, "guessed", {}), (True, None, {"Origin": "http://evil.example"}),
        (True, None, {"Origin": "https://app.foxglove.dev.evil.example"}), (True, None, {"Origin": "null"}),
        (True, None, {"Host": "evil.example:8765"}), (False, None, {"Origin": "https://app.foxglove.dev"}),
        (False, None, {"Origin": "http://localhost:8080"}), (False, None, {"Origin": "file://"}),
    ],
)  # fmt: skip
def test_only_programs_with_the_token_and_foxglove_s_pages_connect(
    screen: FoxgloveScreen, refused: bool, token: str | None, headers: dict[str, str]
) -> None:
    address = screen.address if token is None else f"{screen.address.partition('=')[0]}={token}"
    with pytest.raises(HTTPClientError, match="403") if refused else nullcontext():
        client = FoxgloveClient(address, **headers)
        client.receive("serverInfo")
        client.close()


def test_channels_and_messages_are_those_of_foxglove_s_own_server(tmp_path: Path) -> None:
    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.1), tmp_path / "run")
    rows, context = load_log(tmp_path / "run").slice(0, 5), foxglove.Context()
    screen, own = FoxgloveScreen(None), foxglove.start_server(port=0, context=context)
    found, topics = [], ("/truth/pose", "/battery")
    for address, show in (
        (screen.address, lambda rows: screen.show_rows(rows, [])),
        (f"ws://127.0.0.1:{own.port}", lambda rows: log_rows(rows, context)),
    ):
        client = FoxgloveClient(address)
        show(rows)
        while not client.channels.keys() >= set(topics):
            client.receive("advertise")
        for number, topic in enumerate(topics):
            client.send(op="subscribe", subscriptions=[{"id": number, "channelId": client.channels[topic]}])
        client.send(op="nonsense")
        client.receive("status")  # it has subscribed by now
        show(rows)
        messages = sorted(client.receive("message") for _ in range(2 * rows.num_rows))
        found.append(({topic: client.described[topic] for topic in topics}, messages))
        client.close()
    screen.close()
    own.stop()
    assert found[0] == found[1]


def test_the_rows_are_those_of_mcap(screen: FoxgloveScreen, client: FoxgloveClient, tmp_path: Path) -> None:
    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.1), tmp_path / "run")
    log = load_log(tmp_path / "run")
    screen.show_rows(log.slice(0, 20), [{"t_us": 5, "source": "lab", "text": "released"}])
    while not {"/truth/pose", "/estimate/pose", "/tf", "/flaps", "/text"} <= set(client.channels):
        client.receive("advertise")
    client.send(op="subscribe", subscriptions=[{"id": 1, "channelId": client.channels["/battery"]}])
    client.send(op="getParameters", parameterNames=[], id="subscribed")
    client.receive("parameterValues")
    screen.show_rows(log.slice(20, 1), [])
    time_ns, data = client.receive("message")
    assert time_ns == 1000 * log.column("t")[20].as_py()
    client.send(op="unsubscribe", subscriptionIds=[1])
    client.send(op="subscribe", subscriptions=[{"id": 2, "channelId": client.channels["/truth/pose"]}])
    client.send(op="getParameters", parameterNames=[], id="changed")
    client.receive("parameterValues")
    screen.show_rows(log.slice(21, 1), [])
    screen.show_rows(log.slice(22, 1), [])
    assert [client.receive("message")[0] for _ in range(2)] == [
        1000 * log.column("t")[row].as_py() for row in (21, 22)
    ]
    assert json.loads(data)["battery_voltage"] == pytest.approx(log.column("battery.voltage")[20].as_py())
