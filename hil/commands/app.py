"""`floaty`: the command group.

Bad input ends in one line on standard error and exit code 2; a failed limit in 1; Ctrl-C in 130 with the log kept.
"""

import atexit
import gc
import sys

import click

from firmware_py.fast import STALE
from hil.commands.campaign import campaign
from hil.commands.compare import compare
from hil.commands.deploy import board, deploy
from hil.commands.design import design
from hil.commands.fly import fly
from hil.commands.identify import identify, tune
from hil.commands.listing import list_experiments, runs
from hil.commands.new import new
from hil.commands.options import INTERRUPTED
from hil.commands.paper import drag_model, paper, study
from hil.commands.param import param
from hil.commands.pictures import export, report, view
from hil.commands.serve import serve
from hil.commands.station import station
from hil.errors import LabError
from hil.installation import describe


def _print_version(context: click.Context, option: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        click.echo(describe())
        context.exit()


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_print_version,
    help="Show version, commit, packages and programs found, and exit.",
)
def app() -> None:
    """Floaty virtual laboratory: firmware, ground station and wind tunnel, joined by real bytes."""


for command in (
    fly, new, list_experiments, runs, view, report, export, serve, station, param, compare, paper, study, identify, tune,
    drag_model, design,
    campaign, deploy, board,
):  # fmt: skip
    app.add_command(command)


def main() -> None:
    """Run the command line and leave with its exit code."""
    gc.set_threshold(100_000, 20, 50)  # imports alone would cause collections of 0.3 s in sum
    atexit.register(gc.freeze)  # Python's last collection would take 0.5 s from the result to the prompt
    if STALE:
        print(f"floaty: pure Python, not what `make fast` has compiled: {STALE}", file=sys.stderr)
    try:
        code = app.main(standalone_mode=False)
    except LabError as error:
        sys.exit(_refuse(str(error)))
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        sys.exit(2)
    except click.ClickException as error:
        sys.exit(_refuse(error.format_message()))
    except (click.Abort, KeyboardInterrupt):
        sys.exit(INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)


def _refuse(text: str) -> int:
    print("floaty:", " ".join(text.split()), file=sys.stderr)
    return 2
