"""`floaty serve`: robots in virtual tunnels, with cameras and Motive, for any program that speaks CRTP or MAVLink."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hil.commands import options as common
from hil.commands.options import PATH, argument, common_option, option
from hil.errors import LabError, require

if TYPE_CHECKING:
    from hil.board.board_firmware import Executor
    from hil.config import LabConfig
    from hil.live.feed import LiveView
    from hil.servers.motive import VirtualMotive
    from hil.servers.server import Endpoints, OpenEndpoints, Server
    from hil.servers.swarm import Swarm

Say = Callable[[str], None]
UDP_PORT = 19850  # where cflib looks for boards
RADIO_PORT = 19840
BOARDS_MAX = 10


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """The options of `floaty serve`."""

    udp: int | None = option(
        "--udp", type=click.IntRange(0, 65535), metavar="PORT", help="UDP port of the first board; 0: any."
    )
    radio: bool = option("--radio", is_flag=True, help="Offer a virtual Crazyradio.")
    radio_port: int = option(
        "--radio-port", type=click.IntRange(0, 65535), default=RADIO_PORT, show_default=True, metavar="PORT",
        help="Where the Crazyradio's server listens; 0: any.",
    )  # fmt: skip
    usb: bool = option(
        "--usb", is_flag=True,
        help="Put the virtual Crazyradio on the USB bus of PROGRAM, in any language, and serve until that ends; without "
        "PROGRAM, print the command that starts one so.",
    )  # fmt: skip
    program: tuple[str, ...] = argument("program", nargs=-1, type=click.UNPROCESSED)
    mavlink: str | None = option(
        "--mavlink",
        metavar="END",
        help="Open a serial line with MAVLink: pty, pty:PATH, udp[:[HOST:]PORT] (talks to a ground station that listens "
        "there), tcp[:[HOST:]PORT] (listens).",
    )
    board: str | None = option(
        "--board",
        metavar="FILE",
        help="The image of a Crazyflie's firmware, which every board executes whole: an ELF file, a .bin or the zip of "
        "a release.",
    )
    elf: Path | None = common_option(common.elf_option)
    gdb: int | None = common_option(common.gdb_option)
    boards: int = option(
        "--boards", type=click.IntRange(1, BOARDS_MAX), default=1, show_default=True, metavar="N"
    )
    station: str | None = option(
        "--station", type=click.Choice(["corrections", "poses"]), is_flag=False, flag_value="corrections",
        help="Fly at home with the built-in ground station; poses: it sends absolute poses, and clients send the goal. "
        "Of the profile crazyflie: always poses.",
    )  # fmt: skip
    motive: bool = option(
        "--motive/--no-motive", default=True, show_default=True, help="Stream the cameras' poses over NatNet."
    )
    state: Path | None = option(
        "--state", type=PATH, metavar="DIR",
        help="Keep each board's EEPROM and deck memory in this folder, over restarts of the server.",
    )  # fmt: skip
    target: str | None = common_option(common.view_option)
    faults: tuple[str, ...] = common_option(common.fault_option)
    seed: int = common_option(common.seed_option)
    profile: str = common_option(common.profile_option)
    overrides: tuple[str, ...] = common_option(common.set_option)


@click.command()
@common.asked_as(ServeOptions)
def serve(asked: ServeOptions) -> int:
    """Serve robots in virtual tunnels, in real time, until Ctrl-C.

    Without --udp, --radio, --usb or --mavlink the first board is on UDP. A robot is held until it flies: corrections come
    from clients or, with --station, from within. Motive calls the bodies floaty, floaty2, .... It tracks them
    by eight markers each; with --set markers.enabled=false poses have noise of their own instead. Its stream is that of
    [capture] in the profile: capture.port (frames go to the next one), axes, multicast and natnet.

    --view shows the first robot, with home as its goal.

    While it runs, a line like push.y=2 or mocap.dropout:0.5 injects that fault at once; help lists the other commands.
    """
    if asked.usb:
        asked = replace(asked, radio=True)
    if asked.udp is None and not asked.radio and asked.mavlink is None:
        asked = replace(asked, udp=UDP_PORT)
    _check_options(asked)
    if asked.mavlink is not None:
        require(f"--mavlink {asked.mavlink}", "mavlink", "pymavlink")
    from ground_station.records import INCOMPLETE, Records
    from hil.config import load_config
    from hil.laboratory.fault_kinds import MARKERS_ON
    from hil.laboratory.faults import check, parse
    from hil.servers.serial_server import parse_addresses
    from hil.servers.server import Endpoints, Server, Service
    from hil.servers.swarm import Swarm

    markers = (MARKERS_ON,) if asked.motive else ()
    # Bitcraze's programs send absolute poses.
    poses = () if asked.station == "corrections" else ("predictor.absolute=true",)
    config = load_config(asked.profile, (*markers, *poses, *asked.overrides))
    config.check_effect("--set ", asked.overrides, asked.profile)
    config.check_decks(asked.board is not None)
    if asked.boards == 1:
        common.check_alone(asked.overrides, "--boards N serves several")
    station = _station_of(asked, config)
    serial = parse_addresses(asked.mavlink, asked.boards) if asked.mavlink is not None else []
    planned = [parse(text) for text in asked.faults]
    check(planned, inf, "mavlink" if serial else "radio", config)
    common.announce_compilation()
    plan = Service(config, 1, asked.seed, bool(serial), planned, asked.state, _executor(asked))
    endpoints = Endpoints(asked.udp, asked.radio_port if asked.radio else None, serial, station, asked.motive)
    records = Records()
    say = records.print_text
    with closing(Swarm(plan, asked.boards, endpoints, say)) as swarm:
        view = common.open_live(asked.target, say)
        with closing(Server(plan, say, view, swarm.to_peers, swarm.room)) as server:
            code = _run(server, swarm, endpoints, view, say, asked)
    say(f"stopped; time stood still for {server.clock.stood_still_us / 1000:.0f} ms")
    return code or (INCOMPLETE if records.incomplete else 0)


def _executor(asked: ServeOptions) -> Executor:
    """Return what executes the boards' firmware."""
    from hil.laboratory.lockstep import debugger, image_at
    from hil.laboratory.robot import PYTHON_BOARD

    if asked.board is None:
        return PYTHON_BOARD
    stack = click.get_current_context().with_resource(ExitStack())
    why_forward = "a served robot flies in real time, with programs that cannot go back"
    server = debugger(asked.gdb, asked.elf or Path(asked.board), stack, why_forward)
    return replace(image_at(asked.board, asked.elf), debugger=server)


def _run(
    server: Server, swarm: Swarm, endpoints: Endpoints, view: LiveView | None, say: Say, asked: ServeOptions
) -> int:
    """Open all robots' endpoints and serve until Ctrl-C, with faults typed at the terminal or in the picture's panel.

    Return the exit code of the program that had the radio on its bus, 0 without one.
    """
    from ground_station.stops import stop_signals
    from hil.servers import usb_dongle
    from hil.servers.live_faults import LiveFaults

    def answer(text: str) -> None:
        say(text)
        if view is not None:
            view.answer(server.lab.now_us, text)

    def stopping() -> bool:
        for line in view.lines() if view is not None else ():
            faults.execute_line(line, server.lab.now_us)
        return bool(stops) or (client is not None and client.poll() is not None)

    others, client = swarm.wait(), None
    robots = [server.open(endpoints, [other.dongles for other in others]), *others]
    _print_addresses(robots, say)
    if asked.usb and not asked.program:
        say(f"usb    {shlex.join(usb_dongle.command_of(robots[0].dongles))} PROGRAM")
    motive = _motive(server, 1 + len(others), say) if endpoints.motive else None
    with nullcontext() if motive is None else closing(motive):
        swarm.listen(server, answer, motive)
        faults = LiveFaults(server, answer, swarm.terminals)
        faults.listen(sys.stdin)
        stops = stop_signals()
        say("serving; Ctrl-C ends")
        if asked.program:
            client = usb_dongle.start(robots[0].dongles, asked.program)
        server.run(stopping)
        code = 0 if client is None else usb_dongle.end(client)
        swarm.close()
        common.close_live(view, say=say)
        if motive is not None and motive.malformed:
            say(f"motive could not read {motive.malformed} packets")
    return code


def _station_of(asked: ServeOptions, config: LabConfig) -> str | None:
    """Return what the built-in ground station sends. Raises `LabError` where the robot and its board do not fit."""
    if not config.pilot.enabled:
        return asked.station
    if asked.board is None:
        raise LabError(
            f"profile {asked.profile}: its robot flies with the Crazyflie's own firmware; "
            "--board FILE: the image, an ELF file, a .bin or the zip of a release"
        )
    if asked.station == "corrections":
        raise LabError(
            f"--station corrections: the Crazyflie's own firmware of profile {asked.profile} takes poses"
        )
    return "poses"


def _check_options(asked: ServeOptions) -> None:
    """Raise `LabError` for options that contradict each other."""
    from hil.servers import usb_dongle

    udp, board, gdb, boards = asked.udp, asked.board, asked.gdb, asked.boards
    if asked.program and not asked.usb:
        raise LabError(f"{shlex.join(asked.program)}: only --usb takes a program")
    if asked.usb and (why := usb_dongle.why_not()):
        raise LabError(f"--usb: {why}")
    if udp is not None and udp + boards - 1 > 65535:
        raise LabError(f"--udp {udp}: there are no {boards} ports from there on")
    if board is not None and asked.mavlink is not None:
        raise LabError(f"--mavlink {asked.mavlink}: {board} speaks CRTP over its radio, not MAVLink")
    if asked.elf is not None and board is None:
        raise LabError(f"--elf {asked.elf}: goes with an image as --board")
    if gdb is not None and (board is None or boards > 1):
        raise LabError(f"--gdb {gdb}: needs one board and an image as --board")


def _motive(server: Server, count: int, say: Say) -> VirtualMotive:
    """Open a Motive that tracks `count` robots, and say where it is."""
    from hil.servers.motive import streaming_of
    from hil.servers.server import open_motive

    streaming = streaming_of(server.robot.config.capture)
    motive = open_motive(streaming, server.robot, server.clock, count)
    options = (",multicast" if streaming.multicast else "") + (",z-up" if streaming.up == "z" else "")
    say(f"motive optitrack:127.0.0.1:{motive.port}{options}")
    return motive


def _print_addresses(robots: list[OpenEndpoints], say: Say) -> None:
    """Say where clients find the robots."""
    if robots[0].dongles:
        for line in radio_hint(robots[0].dongles, [robot.radio for robot in robots]).splitlines():
            say(line)
    if robots[0].udp:
        say(f"udp    {' '.join(robot.udp for robot in robots)}")
    if robots[0].mavlink:
        say(f"mavlink {' '.join(robot.mavlink for robot in robots)}")


def radio_hint(port: int, uris: list[str]) -> str:
    """Return the text to type before a program's name so that it finds the dongle, and the addresses of the boards."""
    folder = Path(__file__).parents[1] / "servers" / "dongle_site"
    variables = f"PYTHONPATH={shlex.quote(str(folder))} FLOATY_DONGLE=127.0.0.1:{port}"
    return f"radio  {' '.join(uris)}\nuse    env {variables} PROGRAM"
