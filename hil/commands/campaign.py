"""`floaty campaign`: thousands of flights over sampled parameters and faults, and the causes of failures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hil.commands.options import (
    INTERRUPTED,
    PATH,
    announce_compilation,
    coverage_option,
    notices,
    print_coverage,
    runner_options,
    say,
    warn,
)
from hil.errors import LabError, require

if TYPE_CHECKING:
    from hil.research.campaigns.config import Spec
    from hil.research.campaigns.jobs import Job


@click.command()
@click.argument("spec")
@click.option("--out", type=PATH, metavar="DIR", help="[runs/campaign-SPEC]")
@coverage_option
@runner_options
@click.option(
    "--shrink", type=click.IntRange(0), metavar="FLIGHT",
    help="Instead: reduce a failing flight to the fewest faults and the smallest sizes that still fail.",
)  # fmt: skip
def campaign(spec: str, out: Path | None, coverage: Path | None, shrink: int | None, **crew: Any) -> int:
    """Fly the campaign SPEC into a dataset, and report what breaks the robot (see `floaty docs campaigns`).

    SPEC is a TOML file, or `table`: every robot that the paper's Table allows.

    Exit code 0: all flights were flown, with any outcome; 2: bad input or a full disk, with the flights kept; 130:
    interrupted, likewise.
    """
    require("floaty campaign", "campaign", "SALib", "scipy")
    from hil.research.campaigns.config import find_spec, read_spec
    from hil.research.campaigns.report import write_report
    from hil.research.campaigns.run import Runner
    from hil.research.campaigns.sampling import check_spec, covered, draw, plan_of

    file = find_spec(spec)
    read = read_spec(file)
    check_spec(read)
    if shrink is not None and shrink >= read.flights:
        raise LabError(f"--shrink {shrink}: the campaign has flights 0..{read.flights - 1}")
    if coverage is not None:
        _check_coverage(coverage, read.board)
    announce_compilation()
    if shrink is not None:
        return _shrink(read, draw(read, shrink))
    plan = plan_of(read) if coverage is None else covered(plan_of(read), coverage)
    with Runner(notices, **crew) as runner:
        dataset, interim = runner.campaign(plan, out or Path("runs") / f"campaign-{file.stem}")
    page, findings = write_report(spec, read, dataset, interim.complete)
    say(f"failed: {findings.rate}")
    several = len(findings.cells) > 1
    for cell in findings.cells:
        where = f"{cell.experiment}, {cell.profile}" if several else cell.profile
        if several:
            say(f"  {where}: {cell.rate}")
        say(f"  {where}, lost: {cell.loss_text}")
        for one in cell.limits:
            say(f"  {where}, {one.name}: {cell.rate_text(one)}")
    for text in findings.errors:
        say(f"  did not end: {text}")
    for worst in findings.worst[:3]:
        say(f"  flight {worst.index}: {worst.command}")
    say(f"  {page}")
    if coverage is not None and interim.flown:
        print_coverage(coverage)
    if runner.interrupted:
        warn(f"interrupted: {interim.flown} flights are kept; --resume flies the others")
        return INTERRUPTED
    return 0


def _check_coverage(out: Path, board: str) -> None:
    """Raise `LabError` when the flights on a board cannot add their coverage to OUT."""
    from hil.laboratory.request import Bench
    from hil.pictures.exports.coverage import check_image_coverage

    Bench(board=board, coverage=out).check()
    check_image_coverage(out, board, None)


def _shrink(spec: Spec, drawn: Job) -> int:
    from hil.api import command_of
    from hil.research.campaigns.shrink import Reflight, shrink

    reflight = Reflight(spec, drawn, lambda text: warn(text))
    whole = reflight.request(reflight.whole)
    least = shrink(reflight.whole, whole.duration_s, reflight.fails)
    say(f"flight {drawn.index} still fails with")
    say(f"  {command_of(reflight.request(least))}")
    return 0
