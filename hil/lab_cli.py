"""`floaty lab serve`: what stands in the laboratory, for a ground station outside: tunnel, cameras with Motive, board."""

from typing import Any

import click

from hil.board_cli import serve as serve_boards

COMMAND_PORT = 1510  # Motive's
VERSIONS = {"3.1": (3, 1), "4.1": (4, 1)}


@click.group()
def lab() -> None:
    """Serve the whole laboratory to a ground station."""


@lab.command(params=list(serve_boards.params))
@click.option("--natnet", type=click.Choice(list(VERSIONS)), default="4.1", show_default=True)
@click.option(
    "--natnet-port", type=click.IntRange(0, 65534), default=COMMAND_PORT, show_default=True, metavar="PORT",
    help="Motive's command port; frames go to the next one. 0: any.",
)  # fmt: skip
@click.option("--multicast", is_flag=True, help="Send frames to Motive's group instead of to each client.")
@click.pass_context
def serve(
    context: click.Context, /, natnet: str, natnet_port: int, multicast: bool, **options: Any
) -> int:  # options of `floaty board serve`, handed on unread
    """Serve boards in virtual tunnels and Motive, which sees them, in real time, until Ctrl-C.

    Motive calls the bodies floaty, floaty2, ...; its y axis points up. It tracks them by eight markers each, which
    --set markers.enabled=false takes off: poses have noise of their own then. Everything else is `floaty board serve`.
    """
    from hil.fault_kinds import MARKERS_ON
    from hil.virtual_motive import Streaming

    motive = Streaming(natnet_port, VERSIONS[natnet], multicast)
    options["overrides"] = (MARKERS_ON, *options["overrides"])
    return int(context.invoke(serve_boards, **options, motive=motive))
