"""`floaty param`: the parameters of a board, real or virtual, without flying it."""

import click

from ground_station.controls import ControlAction, ControlRequest, Settings
from ground_station.errors import LinkError
from ground_station.links.schemes import find_link
from hil.commands.options import profile_option, say, set_option
from hil.commands.station import settings_of
from hil.errors import LabError

link_option = click.option(
    "--link", "uri", required=True, metavar="URI",
    help="radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:19850, or mavlink:DEVICE[,BAUD].",
)  # fmt: skip


@click.group()
def param() -> None:
    """Parameters of a board, by its own names (extCtrl.y_P) or a profile's (controller.gain_y)."""


@param.command("list")
@click.argument("group", default="")
@link_option
@profile_option
@set_option
def list_all(group: str, uri: str, profile: str, overrides: tuple[str, ...]) -> None:
    """Show all parameters, or those whose names begin with GROUP."""
    (values,) = _ask(uri, profile, overrides, [ControlRequest(ControlAction.LIST, group)])
    chosen = [(name, value) for name, value in values if name.lower().startswith(group.lower())]
    if not chosen:
        raise LabError(f"{group}: no parameter of the board begins with that")
    for name, value in chosen:
        say(f"{name} {value:.7g}")


@param.command()
@click.argument("names", nargs=-1, required=True, metavar="NAME...")
@link_option
@profile_option
@set_option
def get(names: tuple[str, ...], uri: str, profile: str, overrides: tuple[str, ...]) -> None:
    """Show the values of parameters."""
    from firmware_py.table import on_board

    requests = [ControlRequest(ControlAction.READ, on_board(name)[0]) for name in names]
    for typed, ((_, value),) in zip(names, _ask(uri, profile, overrides, requests), strict=True):
        say(f"{typed} {value / on_board(typed)[1]:.7g}")


@param.command("set")
@click.argument("settings", nargs=-1, required=True, metavar="NAME=VALUE...")
@link_option
@profile_option
@set_option
def set_values(settings: tuple[str, ...], uri: str, profile: str, overrides: tuple[str, ...]) -> None:
    """Change parameters until the board's next boot; `floaty param save` stores them."""
    from firmware_py.table import on_board

    wanted = [_setting(text) for text in settings]
    requests = [
        ControlRequest(ControlAction.WRITE, on_board(name)[0], on_board(name)[1] * value)
        for name, value in wanted
    ]
    for (typed, _), ((_, value),) in zip(wanted, _ask(uri, profile, overrides, requests), strict=True):
        say(f"{typed} {value / on_board(typed)[1]:.7g}")


@param.command()
@link_option
@profile_option
@set_option
def save(uri: str, profile: str, overrides: tuple[str, ...]) -> None:
    """Store the parameters for the board's next boot."""
    _ask(uri, profile, overrides, [ControlRequest(ControlAction.SAVE)])
    say("saved")


def _setting(text: str) -> tuple[str, float]:
    name, equals, number = text.partition("=")
    try:
        if equals and name:
            return name, float(number)
    except ValueError:
        pass
    raise LabError(f"{text}: expected NAME=VALUE with a number, like controller.gain_y=-2.0")


def _ask(
    uri: str, profile: str, overrides: tuple[str, ...], requests: list[ControlRequest]
) -> list[Settings]:
    """Send requests over a link; return the values of each answer. Raises `LabError` for the first refused one."""
    from ground_station.program import ask, link_settings, why
    from hil.config import load_config

    settings = settings_of(load_config(profile, overrides))
    try:
        link = find_link(uri, link_settings(settings))
        link.open(lambda: False)
    except (LinkError, ImportError) as error:
        raise LabError(why(error, uri)) from None
    try:
        answers = []
        for request in requests:
            answer = ask(link, request)
            if answer.error:
                raise LabError(answer.error)
            answers.append(answer.values)
        return answers
    except LinkError as error:
        raise LabError(why(error, uri)) from None
    finally:
        link.close()
