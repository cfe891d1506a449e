"""Foxglove's view of a flight: what a client of its protocol is told, and what it can change."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil.experiments import EXPERIMENTS
from hil.laboratory.recorder import load_log
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live.foxglove_server import FoxgloveScreen
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
    yield client
    client.close()


def values(message: dict) -> dict[str, float]:
    return {parameter["name"]: parameter["value"] for parameter in message["parameters"]}


def test_changed_parameter_is_shown(screen: FoxgloveScreen, client: FoxgloveClient, typed: list[str]) -> None:
    screen.know({"extCtrl.y_P": 1.6, "extCtrl.z_P": 2.0})
    client.send(op="getParameters", parameterNames=[], id="all")
    assert values(client.receive("parameterValues")) == {"extCtrl.y_P": 1.6, "extCtrl.z_P": 2.0}
    client.send(op="subscribeParameterUpdates", parameterNames=["extCtrl.y_P"])
    wish = [{"name": "extCtrl.y_P", "value": 2.5}, {"name": "no.such", "value": 1.0}]
    client.send(op="setParameters", parameters=wish, id="wish")
    assert values(client.receive("parameterValues")) == {"extCtrl.y_P": 1.6}
    assert typed == ["set extCtrl.y_P 2.5"]
    screen.know({"extCtrl.y_P": 2.5})
    while values(client.receive("parameterValues")) != {"extCtrl.y_P": 2.5}:
        pass


def test_the_rows_are_those_of_mcap(screen: FoxgloveScreen, client: FoxgloveClient, tmp_path: Path) -> None:
    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.1), tmp_path / "run")
    log = load_log(tmp_path / "run")
    screen.show(log.slice(0, 20), [{"t_us": 5, "source": "lab", "text": "released"}])
    while not {"/truth/pose", "/estimate/pose", "/tf", "/flaps", "/text"} <= set(client.channels):
        client.receive("advertise")
    client.send(op="subscribe", subscriptions=[{"id": 1, "channelId": client.channels["/battery"]}])
    client.send(op="getParameters", parameterNames=[], id="subscribed")
    client.receive("parameterValues")
    screen.show(log.slice(20, 1), [])
    time_ns, data = client.receive("message")
    assert time_ns == 1000 * log.column("t")[20].as_py()
    assert json.loads(data)["battery_voltage"] == pytest.approx(log.column("battery.voltage")[20].as_py())
