"""A run: one flight into its folder, with log, telemetry, events, result, recording and report.

`runs/<experiment>-<seed>/` holds `log.parquet`, `events.jsonl`, `telemetry.csv`, `result.json`, `flight.rrd` and
`report.html`. Whatever ends the flight (its time, a crash, Ctrl-C, an error in a task), the data up to then are kept.
"""

from __future__ import annotations

import hashlib
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from firmware_py.errors import FirmwareError
from firmware_py.export.boards import BOARDS, CORTEX_M4, PYTHON, runner_of
from firmware_py.export.cortex_m4 import CortexM4Runner
from firmware_py.logic.loading import digest_of
from firmware_py.rtos import WatchdogError
from ground_station.errors import LinkError
from ground_station.telemetry_log import TELEMETRY
from hil.clock import Clock
from hil.config import DEFAULT_PROFILE, LabConfig, load_config
from hil.devices.real_core import RealCore, is_link, real_core
from hil.devices.stm32f405.chip import SOFTWARE, WATCHDOG
from hil.devices.stm32f405.firmware import ChipImage, ImageFirmware
from hil.devices.stm32f405.gdb import GdbServer
from hil.errors import LabError, require, writing
from hil.installation import commit, versions
from hil.laboratory.ages import ages_of, reported_ages, with_goals_sent
from hil.laboratory.experiment import Experiment
from hil.laboratory.faults import Fault, check
from hil.laboratory.flight import Flight
from hil.laboratory.laboratory import Progress
from hil.laboratory.lockstep import LOCKSTEP, MAVLINK, lockstep_flight
from hil.laboratory.metrics import check_limits, free_flight, judge, measure
from hil.laboratory.recorder import EVENTS, Onlooker, Recorder, load_log
from hil.laboratory.result import (
    RESULT,
    ImageReport,
    Origin,
    Outcome,
    QueueReport,
    Result,
    write_result,
)
from hil.laboratory.robot import Executor

OLDER = "older-run"  # in a run folder, until the next flight begins
LOADED_US = 250_000  # every part of the core has been called by then
BUILD = Path("runs/build")
DURATION_MAX_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Request:
    """The user's request for a flight."""

    experiment: Experiment
    config: LabConfig
    profile: str
    overrides: tuple[str, ...]
    seed: int
    duration_s: float
    link: str = "radio"  # radio and mavlink: in lockstep; a URI: a station in a process of its own, paced
    faults: tuple[Fault, ...] = ()  # on top of the experiment's own; `LabError` for those that cannot act
    board: str = PYTHON  # what executes the flight core, or the path of an image that is flashed whole
    elf: Path | None = None  # with the symbols of an image that has none

    def __post_init__(self) -> None:
        if self.is_image:
            check_image(self.board)
        if self.is_image and self.link.startswith(MAVLINK):
            raise LabError(f"--link {self.link}: {self.board} speaks CRTP over its radio, not MAVLink")
        if self.elf is not None and not self.is_image:
            raise LabError(f"--elf {self.elf}: goes with an image as --board, not with {self.board}")
        if self.board != PYTHON and not self.is_image and not self.in_lockstep:
            raise LabError(
                f"--board {self.board}: --link {self.link}: only python flies over a link, and an image"
            )
        if not 0.0 < self.duration_s <= DURATION_MAX_S:
            raise LabError(
                f"--duration {self.duration_s:g}: expected seconds, above 0 and up to {DURATION_MAX_S:g}"
            )
        self._require_packages()
        check(self.faults, self.duration_s, self.link, self.config.markers.enabled)
        check_limits(self.limits, self.experiment.metrics)
        self.experiment.check_goals(self.config.flight.home, self.duration_s)

    def _require_packages(self) -> None:
        """Raise `LabError` for a package of the link or board that is missing: before anything is written."""
        link, board = f"--link {self.link}", f"--board {self.board}"
        if self.link.startswith(MAVLINK):
            require(link, "mavlink", "pymavlink", *(() if self.in_lockstep else ("serial",)))
        elif not self.in_lockstep:
            require(link, "radio", "cflib")
        if is_link(self.board):
            require(board, "radio", "cflib")
        elif self.board == CORTEX_M4:
            require(board, "deploy", "unicorn", "elftools", "ziglang")
        elif self.is_image:
            require(board, "deploy", "unicorn", "elftools")

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        profile: str = DEFAULT_PROFILE,
        overrides: Sequence[str] = (),
        seed: int = 1,
        duration_s: float | None = None,
        link: str = "radio",
        faults: Sequence[Fault] = (),
        board: str = PYTHON,
        elf: Path | None = None,
    ) -> Request:
        """Return the request for an experiment: its settings on the profile, `overrides` on both. Raises `LabError`."""
        overrides = (*experiment.settings, *overrides)
        config = load_config(profile, overrides)
        duration_s = experiment.duration_s if duration_s is None else duration_s
        return cls(experiment, config, profile, overrides, seed, duration_s, link, tuple(faults), board, elf)

    @property
    def is_image(self) -> bool:
        """Whether the board executes an image that is flashed whole."""
        return self.board not in BOARDS and not is_link(self.board)

    @property
    def in_lockstep(self) -> bool:
        """Whether station and board share one time line."""
        return self.link in LOCKSTEP

    @property
    def limits(self) -> Mapping[str, float]:
        """The limits of the flight: the profile's for the experiment, or the experiment's own."""
        return self.config.limits.get(self.experiment.name, self.experiment.limits)

    def origin(self) -> Origin:
        """Return the origin that log and result state."""
        faults = tuple(map(str, (*self.experiment.faults, *self.faults)))
        return Origin(
            self.experiment.name, self.profile, self.overrides, self.seed, self.duration_s, self.link, self.board,
            faults, versions(), commit(), self.experiment.source, digest_of(self.config.logic),
        )  # fmt: skip


MakeFlight = Callable[["Request", Path, Clock | None, bool], Flight]  # (request, telemetry, clock, trace_all)


def fly(
    request: Request,
    folder: Path,
    clock: Clock | None = None,
    progress: Callable[[int, Flight], None] | None = None,
    onlooker: Onlooker | None = None,
    trace_all: bool = False,
    flight_of: MakeFlight | None = None,
) -> Result:
    """Fly once and write everything but the pictures into `folder`, which `prepare` has made.

    `flight_of` assembles the flight; by default in lockstep.

    An error of the firmware ends in the outcome "error", Ctrl-C in "interrupted".
    """
    try:
        flight = (flight_of or lockstep)(request, folder / TELEMETRY, clock, trace_all)
    except BaseException:
        _bring_back(folder)
        raise
    shutil.rmtree(folder / OLDER, ignore_errors=True)
    origin = request.origin()
    metadata = {**origin.metadata(), "config": request.config.model_dump_json()}
    recorder = flight.recorder = Recorder(folder, flight.channels(), metadata, onlooker)
    pace = _Pace()

    def on_progress(now_us: int) -> None:
        pace.begin(now_us)
        if progress is not None:
            progress(now_us, flight)

    try:
        outcome, cause = _fly_to_the_end(flight, on_progress)
    finally:
        factor = pace.end(flight.now_us)
        digest = _close(flight, recorder, folder)
    log, firmware = load_log(folder), flight.robot.firmware
    metrics = _metrics_of(request.experiment, log, outcome == "lost" or flight.lost is not None)
    result = Result(
        **origin.fields(),
        outcome=outcome,
        cause=cause,
        metrics=metrics,
        own_metrics=request.experiment.metrics,
        verdicts=tuple(judge(metrics, request.limits, request.experiment.metrics)),
        tasks=tuple(firmware.statistics.reports()),
        queues=tuple(map(_queue_report, firmware.kernel.queues)),
        usage=firmware.runner.usage if isinstance(firmware.runner, CortexM4Runner | RealCore) else None,
        ages=ages_of(reported_ages(folder), log, request.link),
        hash=digest,
        real_time_factor=round(factor, 2),
        stood_still_ms=flight.lab.clock.stood_still_us / 1000,
        folder=folder,
        image=_image_report(firmware) if isinstance(firmware, ImageFirmware) else None,
    )
    write_result(result)
    return result


def _queue_report(queue: Any) -> QueueReport:
    return QueueReport(queue.name, queue.length, queue.high_water, queue.dropped)


def _fly_to_the_end(flight: Flight, progress: Progress) -> tuple[Outcome, str | None]:
    """Fly; return the outcome and its cause, which goes into the event log when the firmware ended the flight."""
    try:
        end = flight.run(progress)
    except WatchdogError as error:
        flight.note("board", str(error))
        return "lost", str(error)
    except Exception as error:
        first = error.__cause__ or error
        cause = f"board {first}" if isinstance(first, LinkError) else f"{type(error).__name__}: {error}"
        flight.note("lab", cause)
        return "error", cause
    if flight.logic_failed is not None and not end.interrupted:
        return "error", "; ".join(filter(None, (flight.logic_failed, end.lost)))
    return "interrupted" if end.interrupted else "lost" if end.lost else "completed", end.lost


def _close(flight: Flight, recorder: Recorder, folder: Path) -> str:
    """Finish the files of a flight and release its resources; returns the hash of what was recorded."""
    record = flight.line.record
    with closing(flight):  # even when the recorder cannot write on a full disk
        digest = recorder.close(None if record is None else partial(with_goals_sent, record))
    flight.write_schedule(folder)
    return digest


def _metrics_of(experiment: Experiment, log: pa.Table, lost: bool) -> dict[str, float]:
    """Return the metrics of every flight and the experiment's own; NaN where the flight was too short."""
    metrics = measure(log, lost) | dict.fromkeys(experiment.metrics, math.nan)
    if (free := free_flight(log)).num_rows > 1:
        metrics.update(experiment.measured(free))
    return metrics


def _image_report(firmware: ImageFirmware) -> ImageReport:
    free, least = firmware.heap_left()
    return ImageReport(
        hashlib.sha256(firmware.image.code).hexdigest(), firmware.stacks_left(), free, least,
        firmware.resets[WATCHDOG], firmware.resets[SOFTWARE],
    )  # fmt: skip


class _Pace:
    """Simulated over real time, counted after the core has been loaded or compiled."""

    def __init__(self) -> None:
        self._us, self._ns = 0, time.monotonic_ns()
        self._begun = False

    def begin(self, now_us: int) -> None:
        """Start counting once the core is loaded; later calls do nothing."""
        if not self._begun and now_us >= LOADED_US:
            self._begun, self._us, self._ns = True, now_us, time.monotonic_ns()

    def end(self, now_us: int) -> float:
        """Return the factor up to now."""
        return (now_us - self._us) * 1e3 / (time.monotonic_ns() - self._ns)


def check_image(board: str) -> None:
    """Raise `LabError` when no file is where `--board` says."""
    if not Path(board).is_file():
        raise LabError(
            f"--board {board}: expected {', '.join(BOARDS)}, an image of a Crazyflie's firmware: an ELF file, or the link "
            "to a real board"
        )


def image_at(board: str, elf: Path | None, debugger: GdbServer | None = None) -> ChipImage:
    """Return the image that `--board` and `--elf` name. Raises `LabError` when it cannot run here."""
    check_image(board)
    try:
        return ChipImage.load(Path(board), elf, BUILD, debugger)
    except FirmwareError as error:
        raise LabError(f"--board {board}: {error}") from None


def lockstep(
    request: Request,
    telemetry: Path | None,
    clock: Clock | None,
    trace_all: bool,
    debugger: GdbServer | None = None,
) -> Flight:
    """Return a flight over a modelled link. Raises `LabError` when its board is not available here."""
    with ExitStack() as stack:
        runner = _runner(request, stack, debugger)
        try:
            flight = lockstep_flight(
                request.config, request.experiment, request.duration_s, request.seed, telemetry, clock, trace_all,
                request.link, request.faults, runner,
            )  # fmt: skip
        except LinkError as error:
            raise LabError(f"--board {error}") from None
        flight.closing = stack.pop_all()
    return flight


def _runner(request: Request, stack: ExitStack, debugger: GdbServer | None) -> Executor:
    if is_link(request.board):
        return real_core(request.board, stack)
    try:
        if request.is_image:
            return image_at(request.board, request.elf, debugger)
        return runner_of(request.board, BUILD, request.config.logic)
    except FirmwareError as error:
        raise LabError(f"--board {request.board}: {error}") from None


def prepare(folder: Path) -> None:
    """Make a folder ready for a run; one that holds something else is left alone. Raises `LabError`.

    An older run there is set aside; `fly` deletes it, or brings it back when there is no board or link to fly with.
    """
    with writing("--out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        _bring_back(folder)  # before a flight that was never begun
        if older := list(folder.iterdir()):
            if not any((folder / name).exists() for name in (RESULT, EVENTS)):
                raise LabError(
                    f"--out {folder}: the folder is not empty and holds no run; choose another one"
                )
            (folder / OLDER).mkdir()
            for path in older:
                path.rename(folder / OLDER / path.name)


def _bring_back(folder: Path) -> None:
    """Undo what `prepare` did to an older run, and what an attempt to fly has left."""
    if (folder / OLDER).exists():
        for path in folder.iterdir():
            if path.name != OLDER:
                path.unlink()
        for path in (folder / OLDER).iterdir():
            path.rename(folder / path.name)
        (folder / OLDER).rmdir()
