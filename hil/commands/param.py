"""`floaty param`: the parameters of a board, real or virtual, without flying it."""

from contextlib import closing, suppress
from math import nan
from typing import Any

import click

from ground_station.controls import ControlAction, ControlRequest, Settings
from ground_station.errors import LinkError
from hil.commands.options import Command, profile_options, say
from hil.errors import LabError


def board_options(command: Command) -> Command:
    """Add --link, --profile and --set."""
    link_option = click.option(
        "--link", "uri", required=True, metavar="URI",
        help="radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:19850, or mavlink:DEVICE[,BAUD].",
    )  # fmt: skip
    return link_option(profile_options(command))


@click.group()
def param() -> None:
    """Parameters of a board, by its own names (extCtrl.y_P) or a profile's (controller.gain_y)."""


@param.command("list")
@click.argument("group", default="")
@board_options
def list_all(group: str, **board: Any) -> None:
    """Show all parameters, or those whose names begin with GROUP."""
    (values,) = _ask([ControlRequest(ControlAction.LIST, group)], **board)
    chosen = [(name, value) for name, value in values if name.lower().startswith(group.lower())]
    if not chosen:
        raise LabError(f"{group}: no parameter of the board begins with that")
    for name, value in chosen:
        say(f"{name} {value:.7g}")


@param.command()
@click.argument("names", nargs=-1, required=True, metavar="NAME...")
@board_options
def get(names: tuple[str, ...], **board: Any) -> None:
    """Show the values of parameters."""
    _exchange(ControlAction.READ, [(name, nan) for name in names], **board)


@param.command("set")
@click.argument("settings", nargs=-1, required=True, metavar="NAME=VALUE...")
@board_options
def set_values(settings: tuple[str, ...], **board: Any) -> None:
    """Change parameters until the board's next boot; `floaty param save` stores them."""
    _exchange(ControlAction.WRITE, [_setting(text) for text in settings], **board)


@param.command()
@board_options
def save(**board: Any) -> None:
    """Store the parameters for the board's next boot."""
    _ask([ControlRequest(ControlAction.SAVE)], **board)
    say("saved")


def _setting(text: str) -> tuple[str, float]:
    name, equals, number = text.partition("=")
    with suppress(ValueError):
        if equals and name:
            return name, float(number)
    raise LabError(f"{text}: expected NAME=VALUE with a number, like controller.gain_y=-2.0")


def _exchange(action: ControlAction, settings: list[tuple[str, float]], **board: Any) -> None:
    """Read or write parameters by a board's or a profile's names, and show the board's values."""
    from firmware_py.table import on_board

    own = [on_board(name) for name, _ in settings]
    requests = [
        ControlRequest(action, name, factor * value)
        for (name, factor), (_, value) in zip(own, settings, strict=True)
    ]
    answers = _ask(requests, **board)
    for (typed, _), (_, factor), ((_, value),) in zip(settings, own, answers, strict=True):
        say(f"{typed} {value / factor:.7g}")


def _ask(
    requests: list[ControlRequest], uri: str, profile: str, overrides: tuple[str, ...]
) -> list[Settings]:
    """Send requests over a link; return the values of each answer. Raises `LabError` for the first refused one."""
    from ground_station.links.schemes import find_link
    from ground_station.program import ask, why
    from hil.config import load_config

    settings = load_config(profile, overrides).ground.links()
    try:
        with closing(find_link(uri, settings)) as link:
            link.open(lambda: False)
            answers = []
            for request in requests:
                answer = ask(link, request)
                if answer.error:
                    raise LabError(answer.error)
                answers.append(answer.values)
            return answers
    except (LinkError, ImportError) as error:
        raise LabError(why(error, uri)) from None
