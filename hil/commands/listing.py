"""`floaty list`: the experiments; `floaty runs`: the past flights."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.markup import escape
from rich.table import Table

from hil.commands.options import PATH, console, say, wide_console
from hil.errors import LabError, refusing

if TYPE_CHECKING:
    from hil.laboratory.files.result import Result

HASH_DIGITS = 12


@click.command("list")
@click.argument("file", metavar="[FILE.py]", required=False, type=PATH)
@click.option("--faults", is_flag=True, help="List the kinds of faults for `floaty fly --fault`.")
def list_experiments(file: Path | None, faults: bool) -> None:
    """List the experiments, the robustness studies and the profiles, or the kinds of faults.

    Includes experiments of installed packages, with their package; FILE.py: those of a file, and its faults.
    """
    from hil.config import DEFAULT_PROFILE, profile_names
    from hil.laboratory.experiments import EXPERIMENTS
    from hil.laboratory.experiments.own import entries, in_package, in_whole_file, package_of
    from hil.research.studies.catalogue import STUDIES

    own = in_whole_file(file) if file else {}
    if faults:
        return _list_faults()
    if file:
        for name, experiment in own.items():
            say(f"{file}:{name}  {experiment.summary}")
        return None

    width = max(map(len, EXPERIMENTS))
    for experiment in EXPERIMENTS.values():
        say(f"{experiment.name:{width}}  {experiment.summary}")
    for entry in entries().values():
        try:
            text = in_package(entry).summary
        except LabError as error:
            text = str(error)
        say(f"{entry.name:{width}}  {text} ({package_of(entry)})")
    bench = "forces and torques on the mounted robot over flap angles; not a flight: `floaty drag-model`"
    say(f"{'drag-model':{width}}  {bench}")
    say("")
    say("robustness, for `floaty study`:")
    for one in STUDIES.values():
        say(f"{one.name:{width}}  {one.question}")
    names = (f"{name} (default)" if name == DEFAULT_PROFILE else name for name in profile_names())
    say("")
    say(f"profiles: {', '.join(names)}")
    say("faults: floaty list --faults")


def _list_faults() -> None:
    from hil.laboratory.fault_kinds import KINDS

    table = Table(box=None, pad_edge=False)
    for heading in ("kind", "size", "from..to", "lasts", "hover"):
        table.add_column(heading, no_wrap=True)
    table.add_column("meaning")
    for name, kind in KINDS.items():
        unit = f" {kind.unit}".rstrip()
        size, bounds = (f"{kind.size:g}{unit}", f"{kind.low:g}..{kind.high:g}") if kind.sized else ("", "")
        lasts = f"{kind.duration_s:g} s" if math.isfinite(kind.duration_s) else "to the end"
        only = f" ({kind.needs})" if kind.needs else ""
        table.add_row(name, size, bounds, lasts, kind.outcome, f"{kind.meaning}{only}")
    wide_console().print(table)


@click.command()
@click.argument("folder", default="runs", type=PATH)
def runs(folder: Path) -> None:
    """List the run folders below FOLDER [runs], the latest last: date, request, verdict and hash."""

    from hil.laboratory.files.recorder import EVENTS
    from hil.laboratory.files.result import RESULT, read_result

    with refusing(f"runs {folder}: ", OSError):
        found = [path for name in (EVENTS, RESULT) for path in folder.rglob(name)]
        written = {path.parent: path.stat().st_mtime for path in found}
    if not written:
        raise LabError(f"runs {folder}: no run folder there; `floaty fly hover` makes one")
    table = Table(box=None, pad_edge=False)
    for heading in ("date", "folder", "request", "verdict", "hash"):
        table.add_column(heading, overflow="fold", no_wrap=heading in ("date", "hash"))
    for run in sorted(written, key=lambda run: (written[run], run)):
        try:
            result = read_result(run)
            row = (_request_of(result), verdict_of(result), result.hash[:HASH_DIGITS])
        except LabError as error:
            row = ("", " ".join(str(error).removeprefix(f"{run / RESULT}: ").split()), "")
        date = time.strftime("%m-%d %H:%M", time.localtime(written[run]))
        table.add_row(date, *map(escape, (str(run.relative_to(folder)), *row)))
    console.print(table)


def _request_of(result: Result) -> str:
    """Return the request as text, without default parts."""
    from hil.laboratory.request import USUAL

    asked = {**result.request.parts(), "": result.request.experiment.name}
    return ", ".join(
        f"{name} {value}".strip() for name, value in asked.items() if value != USUAL.get(name, "")
    )


def verdict_of(result: Result) -> str:
    """Return a flight's result in a few words."""
    failed = [verdict.metric for verdict in result.verdicts if not verdict.holds]
    if result.outcome != "completed":
        return result.outcome
    return f"fails: {', '.join(failed)}" if failed else "ok"
