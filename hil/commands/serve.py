"""`floaty serve`: robots in virtual tunnels, with cameras and Motive, for any program that knows a Crazyflie or MAVLink."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hil.commands.options import (
    announce_compilation,
    close_live,
    fault_option,
    gdb_option,
    open_debugger,
    open_live,
    profile_option,
    say,
    seed_option,
    set_option,
    stop_signals,
    view_option,
)
from hil.errors import LabError

if TYPE_CHECKING:
    from hil.servers.motive import Up

UDP_PORT = 19850  # where cflib looks for boards
RADIO_PORT = 19840
MOTIVE_PORT = 1510  # Motive's command port
NATNET = {"3.1": (3, 1), "4.1": (4, 1)}
BOARDS_MAX = 10


@click.command()
@click.option(
    "--udp", type=click.IntRange(0, 65535), metavar="PORT", help="UDP port of the first board; 0: any."
)
@click.option("--radio", is_flag=True, help="Offer a virtual Crazyradio.")
@click.option(
    "--radio-port", type=click.IntRange(0, 65535), default=RADIO_PORT, show_default=True, metavar="PORT",
    help="Where the Crazyradio's server listens; 0: any.",
)  # fmt: skip
@click.option(
    "--mavlink",
    metavar="END",
    help="Lead out a serial line with MAVLink: pty, pty:PATH, udp[:[HOST:]PORT] (talks to a ground station that listens "
    "there), tcp[:[HOST:]PORT] (listens).",
)
@click.option(
    "--baud", type=click.IntRange(9600, 3_000_000), metavar="N",
    help="Bits per second of the serial line.  [default: the profile's]",
)  # fmt: skip
@click.option(
    "--board",
    metavar="FILE",
    help="The image of a Crazyflie's firmware, an ELF file, which every board executes whole.",
)
@gdb_option
@click.option("--boards", type=click.IntRange(1, BOARDS_MAX), default=1, show_default=True, metavar="N")
@click.option("--station", is_flag=True, help="Fly with the built-in ground station.")
@click.option(
    "--motive/--no-motive", default=True, show_default=True, help="Stream the cameras' poses over NatNet."
)
@click.option(
    "--natnet", type=click.Choice(list(NATNET)), default="4.1", show_default=True, help="Motive's version."
)
@click.option(
    "--natnet-port", type=click.IntRange(0, 65534), default=MOTIVE_PORT, show_default=True, metavar="PORT",
    help="Motive's command port; frames go to the next one. 0: any.",
)  # fmt: skip
@click.option(
    "--up", type=click.Choice(["y", "z"]), default="y", show_default=True,
    help="Which of the axes that Motive streams points up.",
)  # fmt: skip
@click.option("--multicast", is_flag=True, help="Motive sends frames to its group instead of to each client.")
@click.option(
    "--state", type=click.Path(path_type=Path), metavar="DIR",
    help="Keep each board's EEPROM and deck memory in this folder, over restarts of the server.",
)  # fmt: skip
@view_option
@fault_option
@seed_option
@profile_option
@set_option
def serve(
    udp: int | None,
    radio: bool,
    radio_port: int,
    mavlink: str | None,
    baud: int | None,
    board: str | None,
    gdb: int | None,
    boards: int,
    station: bool,
    motive: bool,
    natnet: str,
    natnet_port: int,
    up: Up,
    multicast: bool,
    state: Path | None,
    target: str | None,
    fault_texts: tuple[str, ...],
    seed: int,
    profile: str,
    overrides: tuple[str, ...],
) -> int:
    """Serve robots in virtual tunnels, in real time, until Ctrl-C.

    Without --udp, --radio or --mavlink the first board is on UDP. A robot is held until it flies: corrections come from
    clients or, with --station, from within. Motive calls the bodies floaty, floaty2, .... It tracks them
    by eight markers each, which --set markers.enabled=false takes off: poses have noise of their own then.

    --view shows the first robot, with home as its goal.

    While it runs, a line like push.y=2 or mocap.dropout:0.5 lets that fault act at once; help shows what else can be typed.
    """
    if udp is None and not radio and mavlink is None:
        udp = UDP_PORT
    if udp is not None and udp + boards - 1 > 65535:
        raise LabError(f"--udp {udp}: there are no {boards} ports from there on")
    from firmware_py.core_runner import PythonRunner
    from hil.config import load_config
    from hil.laboratory.fault_kinds import MARKERS_ON
    from hil.laboratory.faults import check, parse
    from hil.laboratory.run import image_at
    from hil.servers.live_faults import LiveFaults
    from hil.servers.motive import Streaming
    from hil.servers.serial_server import parse_addresses
    from hil.servers.server import Server

    if motive:
        overrides = (MARKERS_ON, *overrides)
    if baud is not None:
        if mavlink is None:
            raise LabError(f"--baud {baud}: there is no serial line without --mavlink")
        overrides = (*overrides, f"serial.baud={baud}")
    config = load_config(profile, overrides)
    ends = parse_addresses(mavlink, boards) if mavlink is not None else []
    faults = [parse(text) for text in fault_texts]
    check(faults, float("inf"), "mavlink" if ends else "radio", config.markers.enabled)
    announce_compilation()
    if board is not None and ends:
        raise LabError(f"--mavlink {mavlink}: {board} speaks CRTP over its radio, not MAVLink")
    if gdb is not None and (board is None or boards > 1):
        raise LabError(f"--gdb {gdb}: goes with one board and an image as --board")
    debugger = open_debugger(gdb, Path(board or ""))
    runner = PythonRunner if board is None else image_at(board, None, debugger)
    view = open_live(target)
    server = Server(config, boards, seed, say, bool(ends), faults, state, view, runner)
    try:
        if radio:
            address = server.ends.serve_radio(radio_port)
            say(radio_hint(address, [robot.uri for robot in server.ends.robots]))
        if udp is not None:
            say(f"udp    {' '.join(server.ends.serve_udp(udp))}")
        if ends:
            say(f"mavlink {' '.join(server.ends.serve_mavlink(ends))}")
        if motive:
            port = server.ends.serve_motive(Streaming(natnet_port, NATNET[natnet], multicast, up)).port
            options = (",multicast" if multicast else "") + (",z-up" if up == "z" else "")
            say(f"motive optitrack:127.0.0.1:{port}{options}")
        if station:
            for robot in server.ends.robots:
                robot.fly()
        LiveFaults(server, say).listen(sys.stdin)
        stops = stop_signals()
        say("serving; Ctrl-C ends")
        server.run(lambda: bool(stops))
    finally:
        server.ends.close()
    close_live(view)
    if server.ends.motive is not None and server.ends.motive.malformed:
        say(f"motive could not read {server.ends.motive.malformed} packets")
    say(f"stopped; time stood still for {server.clock.stood_still_us / 1000:.0f} ms")
    return 0


def radio_hint(address: str, uris: list[str]) -> str:
    """Return what to type before a program's name so that it sees the dongle, and where the boards are."""
    folder = Path(__file__).parents[1] / "servers" / "dongle_site"
    return f"radio  {' '.join(uris)}\nuse    env PYTHONPATH={shlex.quote(str(folder))} FLOATY_DONGLE={address} PROGRAM"
