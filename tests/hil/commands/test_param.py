"""`floaty param` by a board's names and by a profile's, which differ in sign: what is asked, and what is shown."""

from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.table import on_board
from ground_station.controls import ControlAction, ControlRequest
from hil.commands import param
from hil.config import load_config
from support.command import Cli

LINK = ("--link", "udp://127.0.0.1:1")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[ControlRequest]:
    """The requests that reach the board, whose parameters are 1.5 until they are set."""
    requests: list[ControlRequest] = []

    def ask(wanted: list[ControlRequest], **board: Any) -> list[Any]:
        requests.extend(wanted)
        if wanted[0].action is ControlAction.LIST:
            return [[("extCtrl.y_P", 1.5), ("extCtrl.z_P", 2.0), ("motorShifts.m1", 3.0)]]
        return [[(one.name, one.value if one.action is ControlAction.WRITE else 1.5)] for one in wanted]

    monkeypatch.setattr(param, "_ask", ask)
    return requests


def test_a_profile_s_name_has_its_sign_and_a_board_s_name_too(cli: Cli, asked: list[ControlRequest]) -> None:
    name, factor = on_board("controller.gain_y")
    assert (name, factor) == ("extCtrl.y_P", -1.0)
    assert cli("param", "get", "controller.gain_y", "extCtrl.y_P", "supervisor.pose_timeout_us", *LINK) == 0
    assert cli.out == "controller.gain_y -1.5\nextCtrl.y_P 1.5\nsupervisor.pose_timeout_us 1500\n"
    assert cli("param", "set", "controller.gain_y=-2.5", "extCtrl.y_P=2.123456", *LINK) == 0
    assert cli.out == "controller.gain_y -2.5\nextCtrl.y_P 2.123456\n"  # all digits of a float32
    assert [(one.name, one.value) for one in asked[3:]] == [("extCtrl.y_P", 2.5), ("extCtrl.y_P", 2.123456)]


def test_a_board_is_asked_over_its_link_with_the_profile_s_settings_and_refuses_by_its_own_words(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Any] = []
    link = SimpleNamespace(open=opened.append, close=lambda: opened.append("closed"))
    answers = iter([SimpleNamespace(error="", values=[("a", 1.0)]), SimpleNamespace(error="no b")])
    # first: the program, which is loaded here, keeps the function that finds links
    monkeypatch.setattr("ground_station.program.ask", lambda link, request: next(answers))
    monkeypatch.setattr("ground_station.links.schemes.find_link", lambda *what: opened.append(what) or link)
    change = "serial.baud=57600"
    assert cli.refusal("param", "get", "a", "b", *LINK, "--set", change) == "floaty: no b\n"
    (uri, settings), stopped, closed = opened
    assert (uri, settings, stopped(), closed) == (
        LINK[1],
        load_config("floaty", (change,)).ground.links(),
        False,
        "closed",
    )
    assert settings != load_config().ground.links()


@pytest.mark.parametrize("group", ["extctrl", "extCtrl.", "EXTCTRL"])
def test_a_group_is_found_however_it_is_written(cli: Cli, asked: list[ControlRequest], group: str) -> None:
    assert cli("param", "list", group, *LINK) == 0
    assert cli.out == "extCtrl.y_P 1.5\nextCtrl.z_P 2\n"
