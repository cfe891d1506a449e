"""`floaty deploy write | check | flash`: the flight core as C for a Crazyflie, and the proof that it equals the simulated
one.

And `floaty board doctor`: the state of a connected board, within a minute.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click
from rich.progress import TimeRemainingColumn

from firmware_py.export.errors import ExportError
from firmware_py.export.usage import CLOCK_MHZ
from firmware_py.extras import install_command
from ground_station.errors import LinkError
from hil.commands import options as common
from hil.commands.options import FILE, say
from hil.errors import LabError, refusing

if TYPE_CHECKING:
    from hil.deploy.check import Checked
    from hil.deploy.doctor import Finding
    from hil.deploy.targets import Loads, MachineCode
    from hil.laboratory.flight import Flight
    from hil.laboratory.request import Options


@click.group()
def deploy() -> None:
    """Bring the flight core to a Crazyflie-class board."""


@deploy.command()
@click.argument("experiment", required=False)
@click.option("--all", "every", is_flag=True, help="Every experiment, the first minute of each.")
@common.seed_option
@common.duration_option
@common.profile_options
@common.fault_option
@click.option(
    "--targets", "target_text", metavar="NAME,...",
    help="What to compare with the flying C: plain, c-O0, c-O2, cortex-m4, and real boards: radio://…, usb://0, udp://…  "
    "[default: all but boards]",
)  # fmt: skip
@click.option(
    "--source", type=FILE, metavar="FILE",
    help="Check this floaty_core.c, which was exported before, instead of a fresh export.",
)  # fmt: skip
@click.option(
    "--elf", "firmware", type=FILE, metavar="FILE",
    help="Check this linked firmware, the build/cf2.elf that is flashed: its core as cortex-m4 (only that, unless --targets "
    "says otherwise), its parameters and a flight of it on the emulated board.",
)  # fmt: skip
def check(
    experiment: str | None,
    every: bool,
    target_text: str | None,
    source: Path | None,
    firmware: Path | None,
    **options: Unpack[Options],
) -> int:
    """Fly with C, plain Python and Cortex-M4 machine code side by side; compare the core's memory bit for bit.

    Without EXPERIMENT: hover, yaw step, a hover with faults, 10 000 ticks of 10 ms, and flights that take the supervisor
    through all states and causes. Exit code 0: no bit differs; 1: one does; 2: bad input; 130: interrupted. With --elf
    also 1 when anything else in the firmware differs from PROFILE.
    """
    from hil.config import settings_of
    from hil.deploy.check import check_flight, plan
    from hil.deploy.targets import CORTEX_M4, TARGETS, Toolbox, target_names

    if source and firmware:
        raise LabError("--source and --elf: one or the other")
    names = target_names(CORTEX_M4 if firmware and target_text is None else target_text)
    fresh = not source and not firmware and set(names) <= set(TARGETS)
    flights = plan(experiment, every, fresh, **options)
    logic, last_logic = flights[0].config.logic, flights[-1].config.logic
    with refusing(f"--source {source}: ", OSError, UnicodeDecodeError):
        core = source.read_text(encoding="utf-8") if source else None
    toolbox = Toolbox(names, logic, core, firmware)
    last_toolbox = toolbox if last_logic == logic else Toolbox(names, last_logic)
    common.announce_compilation()
    checked: list[Checked] = []
    for request in flights:
        factories = (last_toolbox if request is flights[-1] else toolbox).factories
        with common.progress_of_steps(TimeRemainingColumn()) as show:
            show_flight = partial(_show_flight, show, request.experiment.name)
            checked.append(check_flight(request, factories, show_flight))
        _print_flight(checked[-1])
        if checked[-1].outcome == "interrupted" or checked[-1].failed:
            break
    _print_sum(checked, fresh)
    if toolbox.machine_code is not None:
        _print_machine_code(toolbox.machine_code)
    counted = {} if toolbox.machine_code is None else toolbox.machine_code.entries
    for board, measured in toolbox.boards.items():
        _print_measured(board, measured, counted)
    if checked[-1].outcome == "interrupted":
        return common.INTERRUPTED
    well = all(one.equal and not one.failed for one in checked)
    if firmware is not None:
        well = _check_around(firmware, options["profile"], settings_of(options["overrides"])) and well
    return 0 if well else 1


def _check_around(elf: Path, profile: str, overrides: tuple[str, ...]) -> bool:
    """Check an image around its core; print the findings, and what remains unproven."""
    from hil.deploy.image_check import UNPROVEN, check_image, check_memory, has_app

    app, memory = has_app(elf)
    well = True
    say_finding(check_memory(memory))  # only a warning
    if not app:
        say(f"unproven: everything but the core: {elf} has no exported app")
        return True
    with common.progress_of_steps() as show:
        for finding in check_image(elf, profile, overrides, show):
            say_finding(finding)
            well = well and finding.good
    for text in UNPROVEN:
        say(f"unproven: {text}")
    return well


def say_finding(finding: Finding) -> None:
    """Print a line about a board or an image, marked when it reports a defect."""
    say(f"{'  ' if finding.good else '! '}{finding.subject:<10}{finding.text}")


def _show_flight(show: Callable[[str, int, int], None], name: str, now_us: int, flight: Flight) -> None:
    show(name, now_us, flight.end_us)


def _print_flight(checked: Checked) -> None:
    request = checked.request
    faults = f", {len(request.faults)} faults" if request.faults else ""
    say(f"{request.experiment.name}, seed {request.seed}{faults}: {checked.outcome}")
    for target in checked.targets:
        verdict = "equal" if target.divergence is None else f"DIFFERS first in {target.divergence}"
        say(f"  {target.name:<10}{target.ticks:>7} ticks {target.calls:>7} calls  {verdict}")


def _print_sum(checked: list[Checked], fresh: bool) -> None:
    from hil.deploy.check import reached

    every = [target for one in checked for target in one.targets]
    names = list(dict.fromkeys(target.name for target in every))
    ticks = min(sum(target.ticks for target in every if target.name == name) for name in names)
    different = [name for name in names if any(target.divergence for target in every if target.name == name)]
    verdict = f"{', '.join(different)} DIFFERS" if different else "no bit differs"
    say(f"{ticks} ticks, c beside {', '.join(names)}: {verdict}")
    seen, missed = reached(checked)
    say(f"supervisor: reached {seen}{f'; not {missed}' if missed else ''}")
    if not fresh and "not finite" in missed:
        say("            only a core with own logic has the guard that finds what is not finite")


def _print_machine_code(code: MachineCode) -> None:
    ticks = code.ticks
    flash = "" if code.flash_bytes is None else f"flash {code.flash_bytes} B, "
    say(f"Cortex-M4 code: {flash}RAM {code.ram_bytes} B, stack {code.stack_bytes} B")
    mean, worst = code.loads
    say(
        f"instructions per tick: mean {ticks.instructions / max(ticks.calls, 1):.0f}, worst {ticks.worst_instructions}; "
        f"load at {CLOCK_MHZ} MHz: mean {mean:.1%}, worst tick {worst:.1%} ({ticks.worst_us:.0f} us of 10 ms)"
    )


def _print_measured(board: str, measured: Loads, counted: Loads) -> None:
    """Print a board's measured cycles beside those counted for the machine code."""
    say(f"{board}: cycles per call, mean and worst, as measured on the board")
    for name, load in measured.items():
        if load.calls == 0:
            continue
        beside = ""
        if name in counted and counted[name].calls:
            one = counted[name]
            beside = f"   counted {one.cycles / one.calls:9.0f} {one.worst_cycles:9}"
        say(
            f"  {name:<10}{load.calls:>7} calls {load.cycles / load.calls:9.0f} {load.worst_cycles:9}{beside}"
        )


@deploy.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@common.profile_options
def write(folder: Path, profile: str, overrides: tuple[str, ...]) -> None:
    """Write the Crazyflie app with the flight core as C, and PROFILE's parameters in it, into the folder DIR."""
    from firmware_py.export.crazyflie import write_app
    from hil.config import load_config

    config = load_config(profile, overrides)
    if config.pilot.enabled:
        raise LabError(
            f"profile {profile}: its robot flies with the Crazyflie's own firmware, not with the app"
        )
    with refusing("", ExportError):
        for file in write_app(config, " ".join((profile, *overrides)), folder):
            say(file)


@deploy.command()
@click.argument("image", metavar="IMAGE", type=FILE)
@click.option("--uri", required=True, metavar="radio://…", help="The board, as in `floaty station`.")
def flash(image: Path, uri: str) -> None:
    """Flash IMAGE, the .bin of a Crazyflie build, over the radio, read it back and start it."""
    try:
        from ground_station.flashing import flash as flash_board
    except ImportError as error:
        raise LabError(f"deploy flash: {error}: {install_command('radio')}") from None

    with refusing(f"{image}: ", OSError, LinkError):
        content = image.read_bytes()
        with common.progress_of_steps(TimeRemainingColumn()) as show:
            flash_board(uri, content, show)
    say(f"{len(content)} bytes written and read back; the board starts")


@click.group()
def board() -> None:
    """Inspect a real board."""


@board.command()
@click.argument("link", metavar="LINK")
@common.profile_options
def doctor(link: str, profile: str, overrides: tuple[str, ...]) -> int:
    """Examine the board at LINK (radio://0/80/2M/E7E7E7E7E7, usb://0, udp://HOST:PORT), and report its defects.

    The board must not fly, and nothing moves. Exit code 0: no defect; 1: a defect; 2: no board answers.
    """
    from hil.board.real_core import open_real_core
    from hil.config import load_config
    from hil.deploy.doctor import examine

    config = load_config(profile, overrides)
    well = True
    with ExitStack() as stack, refusing("", LinkError):
        for finding in examine(open_real_core(link, "LINK", stack), config):
            say_finding(finding)
            well = well and finding.good
    return 0 if well else 1
