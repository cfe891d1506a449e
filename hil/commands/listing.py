"""`floaty list`: the experiments; `floaty runs`: the past flights; `floaty docs`: the pages of the documentation."""

from __future__ import annotations

import math
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.markup import escape
from rich.table import Table

from hil.commands.options import PATH, console, say, wide_console
from hil.errors import LabError, hint, refusing

if TYPE_CHECKING:
    from hil.laboratory.files.result import Result

HASH_DIGITS = 12
# The pages: in the wheel, or in the clone.
FOLDERS = (Path(__file__).parents[1] / "docs", Path(__file__).parents[2] / "docs")
PARTS = ("tutorials", "howto", "explanation", "reference")
LINES = 3  # shown of a page that has the words


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
            row = (result.request.text, verdict_of(result), result.hash[:HASH_DIGITS])
        except LabError as error:
            row = ("", " ".join(str(error).removeprefix(f"{run / RESULT}: ").split()), "")
        date = time.strftime("%m-%d %H:%M", time.localtime(written[run]))
        table.add_row(date, *map(escape, (str(run.relative_to(folder)), *row)))
    console.print(table)


def verdict_of(result: Result) -> str:
    """Return a flight's result in a few words."""
    failed = [verdict.metric for verdict in result.verdicts if not verdict.holds]
    if result.outcome != "completed":
        return result.outcome
    return f"fails: {', '.join(failed)}" if failed else "ok"


@click.command()
@click.argument("topic", nargs=-1)
@click.option("--open", "opened", is_flag=True, help="Open the page in the program for its files instead.")
def docs(topic: tuple[str, ...], opened: bool) -> None:
    """Print the page TOPIC of the documentation, or list the pages that have its words; without TOPIC all pages."""
    pages = pages_of(next(folder for folder in FOLDERS if folder.is_dir()))
    name = "-".join(topic).lower().removesuffix(".md").rpartition("/")[2]
    if page := pages.get(name):
        if opened and click.launch(str(page)) != 0:
            raise LabError(f"--open {page}: no program opens it here")
        for line in [] if opened else page.read_text(encoding="utf-8").splitlines():
            say(line)
        return
    if topic:
        _list_found(pages, topic)
        return
    for name, page in pages.items():
        say(f"{name:{max(map(len, pages))}}  {_title(page)}")
    say("")
    say("floaty docs TOPIC prints a page; floaty docs WORD WORD finds pages")


def pages_of(folder: Path) -> dict[str, Path]:
    """Return the pages by their topics, the first ones to read first."""
    return {page.stem: page for part in PARTS for page in sorted((folder / part).glob("*.md"))}


def _list_found(pages: dict[str, Path], topic: tuple[str, ...]) -> None:
    """List the pages that have all words, those whose lines have all of them first."""
    words = _plain(" ".join(topic)).split()
    found = []
    for name, page in pages.items():
        text = page.read_text(encoding="utf-8")
        if not all(word in _plain(text) for word in words):
            continue
        lines = text.splitlines()
        shares = {index: sum(word in _plain(line) for word in words) for index, line in enumerate(lines)}
        best = sorted((index for index in shares if shares[index]), key=lambda index: (-shares[index], index))
        found.append(
            (shares[best[0]], sum(shares.values()), name, [lines[index] for index in sorted(best[:LINES])])
        )
    if not found:
        near = hint("-".join(topic), pages, "floaty docs lists all pages")
        raise LabError(f"docs {' '.join(topic)}: neither a page nor words of one; {near}")
    for _, _, name, lines in sorted(found, key=lambda one: (-one[0], -one[1])):
        say(f"{name}  {_title(pages[name])}")
        for line in lines:
            say(f"    {line.strip()}")


def _plain(text: str) -> str:
    return re.sub(r"[\s-]+", " ", text.lower())


def _title(page: Path) -> str:
    with page.open(encoding="utf-8") as lines:
        return next(lines).removeprefix("# ").strip()
