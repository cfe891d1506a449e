"""The fixture `floaty`: flights into the test's own folders, and boards without a world."""

import hashlib
import math
import os
import re
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Unpack

import pytest

from firmware_py.errors import FirmwareError
from firmware_py.logic.loading import check_file
from hil.api import Run, Swarm, command_of, fly_swarm, maker_of, request_of
from hil.board.cores.boards import BOARDS, runner_of
from hil.config import DEFAULT_PROFILE, Overrides, load_config, settings_of
from hil.errors import LabError, RefusedFileError
from hil.laboratory.arguments import checked
from hil.laboratory.experiment import Experiment
from hil.laboratory.files.folder import reserved
from hil.laboratory.metric_pairs import REL
from hil.laboratory.request import MAVLINK, RADIO, Options, Request
from hil.laboratory.run import fly
from hil.testing.board import BareBoard
from hil.testing.choices import why_no_board

SHOWN = 3  # flights of a test; of more, only the last
PICTURE = "flight.png"
NAME_MAX = 80


@dataclass(frozen=True, slots=True)
class Flown:
    """A flight of a test."""

    number: int
    request: Request
    run: Run


@dataclass(slots=True)
class Item:
    """One test: its choice, folder and flights."""

    name: str  # pytest's
    home: Path  # of the test file
    folder: Path
    choice: Options  # default options of its flights
    flown: list[Flown] = field(default_factory=list)
    written: list[str] = field(default_factory=list)  # baselines
    failed: bool = False


class Flights:
    """The fixture `floaty`. `seed`, `profile`, `link`, `faults` and `target`, the board, are the test's."""

    def __init__(
        self,
        home: Path,
        folder: Path,
        usual_profile: str = DEFAULT_PROFILE,
        update: bool = False,
        coverage: Path | None = None,
    ) -> None:
        self.home = home  # pytest's root folder: paths of profiles and experiments are relative to it
        self._folder = folder  # of all tests' runs
        self._usual_profile = usual_profile  # of pytest's configuration
        self._update = update  # the baselines
        self._coverage = coverage  # where flights of images add theirs
        self._item: Item | None = None

    def begin(self, name: str, file: Path, choice: Options) -> Item:
        """Start flying for a test of a file."""
        self._item = Item(name, file.parent, self._folder / folder_of(name), choice)
        shutil.rmtree(self._item.folder, ignore_errors=True)
        return self._item

    @property
    def choice(self) -> Options:
        """The choice of the current test."""
        assert self._item is not None
        return self._item.choice

    @property
    def seed(self) -> int:
        """The seed of all random numbers."""
        return self.choice["seed"]

    @property
    def profile(self) -> str:
        """The profile."""
        return self.choice["profile"]

    @property
    def target(self) -> str:
        """The runner of the flight core: c, python or cortex-m4."""
        return self.choice["board"]

    @property
    def link(self) -> str:
        """The link between station and board."""
        return self.choice["link"]

    @property
    def faults(self) -> tuple[str, ...]:
        """The faults of the mark, which act on every flight of the test."""
        return tuple(map(str, self.choice.get("faults", ())))

    @checked
    def fly(self, experiment: Experiment | str = "hover", **options: Unpack[Options]) -> Run:
        """Fly once; the test's mark and the command line give the default options.

        Options are those of `hil.fly`; `faults` are added to the mark's. A failed limit is not an error: the test reads
        `passed`, `metrics`, `verdicts`.
        Skips the test when a board is not available here. Raises `LabError` for bad input.
        """
        item = self._item
        assert item is not None
        if isinstance(experiment, str):
            experiment = self._placed(experiment)
        request = request_of(experiment, **self._chosen(options))
        number = len(item.flown) + 1
        place = item.folder / str(number)
        with reserved(request, place):  # not `hil.fly`, which writes the coverage after every flight
            run = Run(fly(request, place, flight_of=maker_of(request)))
        item.flown.append(Flown(number, request, run))
        return run

    @checked
    def check(self, file: str) -> None:
        """Check a control law or an estimator without a flight. Raises `LabError` with a line for each refusal."""
        try:
            check_file(self.home / file)
        except FirmwareError as error:
            raise RefusedFileError(str(error)) from None

    @checked
    def fly_swarm(self, experiment: Experiment | str, robots: int, **options: Unpack[Options]) -> Swarm:
        """Fly several robots together, with options as for `fly`; each of them is a flight of the test.

        Skips the test when a board is not available here. Raises `LabError` for bad input.
        """
        item = self._item
        assert item is not None
        if isinstance(experiment, str):
            experiment = self._placed(experiment)
        number = len(item.flown) + 1
        swarm = fly_swarm(experiment, robots, item.folder / str(number), **self._chosen(options))
        item.flown += [Flown(number + i, run.request, run) for i, run in enumerate(swarm.robots)]
        return swarm

    def _chosen(self, options: Options) -> Options:
        """Return the options of a flight of the test. Skips the test when a board is not available here."""
        chosen: Options = {**self.choice, **options}
        chosen["faults"] = (*self.faults, *options.get("faults", ()))
        chosen["profile"] = self._placed(chosen["profile"])
        self._need(chosen["board"])
        if self._coverage is not None and chosen["board"] not in BOARDS:
            chosen["coverage"] = self._coverage
        return chosen

    @checked
    def board(self, link: str = RADIO, profile: str | None = None, overrides: Overrides = ()) -> BareBoard:
        """Boot a board without a world. With `link="mavlink"` it speaks MAVLink over its UART.

        Skips the test when the board is not available here. Raises `LabError` for bad input.
        """
        if link not in (RADIO, MAVLINK):
            raise LabError(f"board: link {link!r}: expected {RADIO} or {MAVLINK}")
        self._need(self.target)
        config = load_config(self._placed(profile or self.profile), settings_of(overrides))
        return BareBoard(config, runner_of(self.target, config.logic), link == MAVLINK)

    @checked
    def baseline(self, name: str, rel: float = REL, metrics: Sequence[str] = ()) -> None:
        """Compare the flights of the test with `baselines/NAME.json` beside its file; `--floaty-update` writes it.

        Fails with the metrics of both and the first row that differs when an outcome has changed or a metric has left
        `rel` of the baseline's, for better or worse. `metrics` are those that count; by default all. Flights with
        another seed, profile, link or fault of the mark have their own file; boards share one. Raises `LabError` without it.
        """
        __tracebackhide__ = True
        from hil.testing import baselines

        item = self._item
        assert item is not None
        if not item.flown:
            raise LabError(f"baseline {name!r}: this test has not flown yet")
        for metric in metrics:
            item.flown[-1].run.unit_of(metric)  # raises for an unknown one
        path = baselines.file_of(item.home, "-".join([name, *self._unusual(item.choice)]))
        shown = path.relative_to(self.home) if path.is_relative_to(self.home) else path
        if self._update:
            baselines.write(path, [baselines.Pinned.of(one.run) for one in item.flown])
            item.written.append(str(shown))
            return
        command = f"pytest --floaty-update {shlex.quote(item.name)}"
        if not path.is_file():
            raise LabError(f"baseline {shown}: there is none; `{command}` writes it, then commit it")
        kept = baselines.read(path)
        if len(kept) != len(item.flown):
            raise LabError(
                f"baseline {shown}: of {len(kept)} flights, now {len(item.flown)}; `{command}` writes it again"
            )
        pairs = zip(kept, item.flown, strict=True)
        lines = [line for old, one in pairs for line in baselines.difference(old, one.run, rel, metrics)]
        if lines:
            raise AssertionError(
                "\n".join([f"baseline {shown}:", *lines, f"accept the new flights: {command}"])
            )

    def _unusual(self, choice: Options) -> list[str]:
        """Return the parts of a choice that make another flight than usual, as parts of a file's name."""
        link = "" if choice["link"] == RADIO else choice["link"].partition(":")[0]
        profile = "" if choice["profile"] == self._usual_profile else Path(choice["profile"]).stem
        faults = (re.sub(r"[^\w.-]+", "-", str(fault)) for fault in choice.get("faults", ()))
        seed = "" if choice["seed"] == 1 else f"seed{choice['seed']}"
        return list(filter(None, (*faults, profile, link, seed)))

    def _need(self, board: str) -> None:
        if board in BOARDS and (reason := why_no_board(board)):
            pytest.skip(f"floaty: {reason}")

    def _placed(self, name: str) -> str:
        """Return a path relative to the root folder as an absolute one; another name unchanged."""
        path, end, variable = name.partition(".py:") if ".py:" in name else (name, "", "")
        placed = self.home / (path + end.rstrip(":"))
        is_path = placed.suffix in (".py", ".toml", ".csv") and placed.is_file()
        return f"{self.home / path}{end}{variable}" if is_path else name


def folder_of(name: str) -> str:
    """Return a unique folder name for a test."""
    plain = re.sub(r"[^\w.-]+", "-", name).strip("-")
    if len(plain) <= NAME_MAX and plain == name:
        return plain
    return f"{plain[-NAME_MAX:].lstrip('-.')}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def shown_of(item: Item) -> list[Flown]:
    """Return the flights shown on a failure: all if few, else the last, the smallest that Hypothesis found."""
    return item.flown if len(item.flown) <= SHOWN else item.flown[-1:]


def text_of(item: Item, kept: bool, options: str, root: Path) -> str:
    """Return the text on a failed test's flights, with paths relative to pytest's root folder.

    `options` are the pytest options that chose the flights.
    """
    texts = []
    for one in shown_of(item):
        request, result = one.request, one.run.result
        how = f"{result.outcome}: {result.cause}" if result.cause else result.outcome
        lines = [
            f"{request.experiment.name}, seed {request.seed}, board {request.bench.board}, profile {request.profile}, "
            f"{request.bench.link}: {how}"
        ]
        lines += [f"  limit    {verdict}" for verdict in result.failed]
        lines += [f"  fault    {fault}" for fault in request.faults]
        lines += [f"  folder   {one.run.folder}"] if kept else []
        lines += [f"  picture  {one.run.folder / PICTURE}"] if (one.run.folder / PICTURE).is_file() else []
        if result.stood_still_ms:
            lines += [f"  machine  was too slow: time stood still for {result.stood_still_ms:.0f} ms"]
        again = command_of(request) or f"pytest {options}'{item.name}'"
        lines.append(f"  again    {again}")
        if kept and request.bench.is_image:
            at = "" if result.failures or result.outcome == "lost" else f" --at {request.duration_s:g}"
            lines.append(f"  debug    floaty debug {shlex.quote(str(one.run.folder))}{at}")
        texts.append("\n".join(lines))
    if more := len(item.flown) - len(texts):
        texts.append(f"({more} flights before that are not shown)")
    return _below(root, "\n".join(texts))


def _below(root: Path, text: str) -> str:
    return text.replace(f"{root}{os.sep}", "")


def without_deleted(item: Item, kept: bool, text: str) -> str:
    """Return a text on a test without the folders of flights that are deleted."""
    shown = {one.number for one in shown_of(item)} if kept else set()
    for one in item.flown:
        if one.number not in shown:
            text = text.replace(f"; {one.run.folder}>", ">")
    return text


def properties_of(item: Item, kept: bool, root: Path) -> list[tuple[str, str]]:
    """Return a test's properties for a JUnit file: hash, command, folder if it is kept, and every metric with a value.

    A metric is a number, in the unit that its name ends with, like `floaty.rms_x [m]`.
    """
    found = []
    shown = shown_of(item)
    for one in shown:
        prefix = "floaty." if len(shown) == 1 else f"floaty.{one.number}."
        values = {"hash": one.run.hash, "outcome": one.run.outcome}
        values |= {"folder": _below(root, str(one.run.folder))} if kept else {}
        values["again"] = _below(root, command_of(one.request) or "")
        values |= {
            f"{name} [{unit}]" if (unit := one.run.unit_of(name)) else name: f"{value:.9g}"
            for name, value in one.run.metrics.items()
            if math.isfinite(value)
        }
        found += [(prefix + name, value) for name, value in values.items()]
    return found


def draw(item: Item) -> None:
    """Draw one picture into the folder of every flight shown on a failure."""
    from hil.pictures.drawing import png
    from hil.pictures.figures import errors

    for one in shown_of(item):
        if one.run.log.num_rows > 1:
            (one.run.folder / PICTURE).write_bytes(png(errors, one.run.log))


def trim(item: Item, keep: bool) -> None:
    """Drop the flights of a finished test, and remove those that a failure would not show."""
    shown = {one.number for one in shown_of(item)}
    for one in item.flown:
        if not keep and one.number not in shown:
            shutil.rmtree(one.run.folder, ignore_errors=True)
    item.flown.clear()
