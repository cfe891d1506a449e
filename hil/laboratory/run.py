"""A run: one flight into its folder, with log, telemetry, events, result, recording and report.

`runs/<experiment>-<seed>/` holds `log.parquet`, `events.jsonl`, `telemetry.csv`, `result.json`, `flight.rrd` and
`report.html`. Whatever ends the flight (its time, a crash, Ctrl-C, an error in a task), the data up to then are kept.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pyarrow as pa

from firmware_py.errors import FirmwareError
from firmware_py.export.boards import BOARDS, CORTEX_M4, PYTHON, runner_of
from firmware_py.logic.loading import digest_of
from firmware_py.rtos import WatchdogError
from ground_station.errors import LinkError
from ground_station.links.schemes import SCHEMES
from ground_station.telemetry_log import TELEMETRY
from hil.arguments import checked
from hil.clock import Clock
from hil.config import DEFAULT_PROFILE, LabConfig, Overrides, load_config, settings_of
from hil.devices.board_firmware import Executor, PythonBoard
from hil.devices.image_firmware import ChipImage
from hil.devices.real_core import is_link, real_core
from hil.errors import LabError, require, writing
from hil.installation import commit, versions
from hil.laboratory.ages import ages_of, reported_ages, with_goals_sent
from hil.laboratory.experiment import Experiment
from hil.laboratory.faults import Fault, check, parse
from hil.laboratory.flight import Flight
from hil.laboratory.laboratory import Progress
from hil.laboratory.lockstep import LOCKSTEP, MAVLINK, lockstep_flight
from hil.laboratory.metrics import check_limits, free_flight, judge, limits_of, measure
from hil.laboratory.recorder import EVENTS, Onlooker, Recorder, load_log
from hil.laboratory.result import (
    RESULT,
    Origin,
    Outcome,
    QueueReport,
    Result,
    with_resets,
    write_result,
)
from hil.stm32f405.gdb import GdbServer

OLDER = "older-run"  # in a run folder, until the next flight begins
LOADED_US = 250_000  # every part of the core has been called by then
BUILD = Path("runs/build")
DURATION_MAX_S = 86_400.0
SEED_MAX = 2**62


@checked
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
        if not self.in_lockstep and self.link.partition(":")[0] not in SCHEMES:
            raise LabError(
                f"--link {self.link}: expected radio, mavlink, radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:PORT, "
                "mavlink:pty or mavlink:PATH"
            )
        if not 0 <= self.seed <= SEED_MAX:
            raise LabError(f"--seed {self.seed}: expected a whole number, 0 to {SEED_MAX}")
        if not 0.0 < self.duration_s <= DURATION_MAX_S:
            raise LabError(
                f"--duration {self.duration_s:g}: expected seconds, above 0 and up to {DURATION_MAX_S:g}"
            )
        self._require_packages()
        check(self.faults, self.duration_s, self.link, self.config.markers.enabled)
        check_limits(self.limits, self.experiment.metrics)
        self.experiment.check_goals(self.config.flight.home, self.duration_s, partial(why_left, self.config))

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
            require(board, "deploy", "unicorn", "cffi", "elftools")

    @classmethod
    @checked
    def of(
        cls,
        experiment: Experiment,
        profile: str = DEFAULT_PROFILE,
        overrides: Overrides = (),
        seed: int = 1,
        duration_s: float | None = None,
        link: str = "radio",
        faults: Sequence[Fault | str] = (),
        board: str = PYTHON,
        elf: Path | None = None,
    ) -> Request:
        """Return the request for an experiment: its settings on the profile, `overrides` on both. Raises `LabError`."""
        settings = (*experiment.settings, *settings_of(overrides))
        config = load_config(profile, settings)
        duration_s = experiment.duration_s if duration_s is None else duration_s
        chosen = tuple(parse(one) if isinstance(one, str) else one for one in faults)
        return cls(experiment, config, profile, settings, seed, duration_s, link, chosen, board, elf)

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
        """The limits of the flight."""
        return limits_of(self.experiment.limits, self.config.limits.get(self.experiment.name))

    def origin(self) -> Origin:
        """Return the origin that log and result state."""
        faults = tuple(map(str, (*self.experiment.faults, *self.faults)))
        return Origin(
            self.experiment.name, self.profile, self.overrides, self.seed, self.duration_s, self.link, self.board,
            faults, versions(), commit(), self.experiment.source, digest_of(self.config.logic),
        )  # fmt: skip


# (request, telemetry, clock, trace_all, what is closed after the flight)
MakeFlight = Callable[["Request", Path, Clock | None, bool, ExitStack], Flight]


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
    with ExitStack() as stack:
        try:
            flight = (flight_of or lockstep)(request, folder / TELEMETRY, clock, trace_all, stack)
        except BaseException:
            _bring_back(folder)
            raise
        shutil.rmtree(folder / OLDER, ignore_errors=True)
        origin = request.origin()
        metadata = {**origin.metadata(), "config": request.config.model_dump_json()}
        recorder = Recorder(folder, flight.channels(), metadata, onlooker)
        pace = _Pace()

        def on_progress(now_us: int) -> None:
            pace.begin(now_us)
            if progress is not None:
                progress(now_us, flight)

        try:
            outcome, cause = _fly_to_the_end(flight, on_progress, recorder)
        finally:
            factor = pace.end(flight.now_us)
            digest = _close(flight, recorder, folder)
    log, firmware = load_log(folder), flight.robot.firmware
    lost = outcome == "lost" or flight.lost is not None
    metrics = _metrics_of(request.experiment, log, lost, flight.resets)
    outcome, cause = with_resets(outcome, cause, flight.resets)
    result = Result(
        **origin.fields(),
        outcome=outcome,
        cause=cause,
        metrics=metrics,
        own_metrics=request.experiment.metrics,
        verdicts=tuple(judge(metrics, request.limits, request.experiment.metrics)),
        tasks=tuple(firmware.statistics.reports()),
        queues=tuple(
            QueueReport(one.name, one.length, one.high_water, one.dropped)
            for one in (firmware.scheduler.queues if firmware.scheduler is not None else ())
        ),
        usage=firmware.usage,
        ages=ages_of(reported_ages(folder), log, request.link),
        hash=digest,
        real_time_factor=round(factor, 2),
        stood_still_ms=flight.lab.clock.stood_still_us / 1000,
        folder=folder,
        image=None if firmware.flashed is None else firmware.flashed.report(),
    )
    write_result(result)
    return result


def _fly_to_the_end(flight: Flight, progress: Progress, recorder: Recorder) -> tuple[Outcome, str | None]:
    """Fly; return the outcome and its cause, which goes into the event log when the firmware ended the flight."""
    try:
        end = flight.run(progress, recorder)
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


def _metrics_of(experiment: Experiment, log: pa.Table, lost: bool, resets: int) -> dict[str, float]:
    """Return the metrics of every flight and the experiment's own; NaN where the flight was too short."""
    metrics = measure(log, lost, resets) | dict.fromkeys(experiment.metrics, math.nan)
    if (free := free_flight(log)).num_rows > 1:
        metrics.update(experiment.measured(free))
    return metrics


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


def why_left(config: LabConfig, p_W: Sequence[float]) -> str:
    """Return why a robot at a place [m] has left the flow, by the limits of the plant; empty when it has not."""
    limits, height = config.plant.limits, p_W[2] - config.tunnel.hover_height
    if (radius := math.sqrt(p_W[0] * p_W[0] + p_W[1] * p_W[1])) > limits.radius:
        return f"{radius:.2f} m from the axis; up to {limits.radius:g} m"
    if not -limits.below <= height <= limits.above:
        where = "below" if height < 0.0 else "above"
        return f"{abs(height):.2f} m {where} the hover point; up to {getattr(limits, where):g} m"
    return ""


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
    stack: ExitStack,
    debugger: GdbServer | None = None,
) -> Flight:
    """Return a flight over a modelled link. Raises `LabError` when its board is not available here."""
    try:
        return lockstep_flight(request, telemetry, clock, trace_all, _executor(request, stack, debugger))
    except LinkError as error:
        raise LabError(f"--board {error}") from None


def _executor(request: Request, stack: ExitStack, debugger: GdbServer | None) -> Executor:
    if is_link(request.board):
        return PythonBoard(real_core(request.board, stack))
    try:
        if request.is_image:
            return image_at(request.board, request.elf, debugger)
        return PythonBoard(runner_of(request.board, BUILD, request.config.logic))
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
