"""A run: one flight into its folder, with log, telemetry, events, result, recording and report.

`runs/<experiment>-<seed>/` holds `log.parquet`, `events.jsonl`, `telemetry.csv`, `result.json`, `flight.rrd` and
`report.html`. Whatever ends the flight (its time, a crash, Ctrl-C, an error in a task), earlier data are kept.
"""

import gc
import math
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

from firmware_py.rtos import WatchdogError
from ground_station.errors import LinkError
from ground_station.telemetry_log import TELEMETRY
from hil.board.clock import Pace
from hil.config import check_logic
from hil.laboratory.files.folder import replacing_older
from hil.laboratory.files.recorder import Observer, Recorder, load_log
from hil.laboratory.files.result import (
    Outcome,
    Program,
    QueueReport,
    Result,
    judged,
    metadata_of,
    with_failures,
    with_resets,
    write_result,
)
from hil.laboratory.flight import Flight
from hil.laboratory.flight import Outcome as Ended
from hil.laboratory.lockstep import in_lockstep
from hil.laboratory.request import Request

LOADED_US = 250_000  # every part of the core has run by then

COLLECTIONS = (100_000, 20, 50)  # Python's defaults take a tenth of a flight, which makes little garbage

# (request, telemetry log, stack closed after the flight)
MakeFlight = Callable[[Request, Path | None, ExitStack], Flight]


def fly(
    request: Request,
    folder: Path,
    progress: Callable[[int, Flight], None] | None = None,
    observer: Observer | None = None,
    flight_of: MakeFlight = in_lockstep,
) -> Result:
    """Fly once and write everything but the pictures into `folder`, replacing an older run.

    `flight_of` assembles the flight. An error of the firmware ends in the outcome "error", Ctrl-C in "interrupted".
    """
    with ExitStack() as stack:
        started = Started(request, folder, stack, observer, flight_of)
        try:
            started.fly(progress)
        finally:
            started.close()
    return started.result()


class Started:
    """A flight that has begun, with its run folder: `fly` it, or `fly_to` some instants in turn with others."""

    def __init__(
        self,
        request: Request,
        folder: Path,
        stack: ExitStack,
        observer: Observer | None = None,
        flight_of: MakeFlight = in_lockstep,
    ) -> None:
        """Begin; `stack` releases what the flight has opened."""
        request.experiment.check_known()  # a request from a run folder was not checked
        check_logic(request.config)
        stack.callback(gc.set_threshold, *gc.get_threshold())
        gc.set_threshold(*COLLECTIONS)
        with replacing_older(folder):
            self.flight = flight_of(request, folder / TELEMETRY, stack)
        self._request, self._folder = request, folder
        self._program = Program.of(request.config)
        metadata = metadata_of(request, self._program, self.flight.robot.body.look)
        self._recorder = Recorder(folder, self.flight.channels(), metadata, observer)
        self._pace = Pace(LOADED_US)
        self._ended: tuple[Outcome, str | None] | None = None
        self._factor, self._digest = math.nan, ""

    @property
    def over(self) -> bool:
        """Whether it has ended."""
        return self._ended is not None

    def fly(self, progress: Callable[[int, Flight], None] | None = None) -> None:
        """Fly to the end."""

        def on_progress(now_us: int) -> None:
            self._pace.start_when_due(now_us)
            if progress is not None:
                progress(now_us, self.flight)

        self._ended = _ended(self.flight, lambda: self.flight.run(on_progress, self._recorder))

    def begin(self) -> None:
        """Record from now on, before `fly_to`."""
        self.flight.record_in(self._recorder)

    def fly_to(self, us: int) -> None:
        """Fly to an instant, unless the flight is over; Ctrl-C is the caller's."""

        def on() -> Ended | None:
            flight = self.flight
            flight.lab.run_to(us)
            return flight.end() if flight.now_us >= flight.end_us else None

        self._pace.start_when_due(us)
        if self._ended is None:
            self._ended = _ended(self.flight, on)

    def interrupt(self) -> None:
        """End it now, as by Ctrl-C."""
        if self._ended is None:
            self._ended = _ended(self.flight, lambda: self.flight.end(interrupted=True))

    def close(self) -> None:
        """Finish the files and release what the flight has opened."""
        self._factor = self._pace.factor(self.flight.now_us)
        self._digest = _close(self.flight, self._recorder, self._folder)

    def result(self) -> Result:
        """Return the judged result, which is also written; only after the end and `close`."""
        assert self._ended is not None
        flight, folder, request = self.flight, self._folder, self._request
        log, firmware, failures = load_log(folder), flight.robot.firmware, flight.robot.failures
        lost = self._ended[0] == "lost" or flight.lost is not None
        metrics = request.experiment.metrics_of(log, lost, flight.resets)
        ended = with_failures(*with_resets(*self._ended, metrics["resets"]), failures)
        queues = firmware.scheduler.queues if firmware.scheduler is not None else ()
        result = replace(
            judged(request, self._program, ended, metrics, log, self._digest, folder),
            failures=failures,
            tasks=tuple(firmware.reports()),
            queues=tuple(QueueReport(one.name, one.length, one.high_water, one.dropped) for one in queues),
            usage=firmware.usage,
            real_time_factor=round(self._factor, 2),
            stood_still_ms=flight.lab.clock.stood_still_us / 1000,
            image=None if firmware.flashed is None else firmware.flashed.report(),
        )
        write_result(result)
        if firmware.flashed is not None:
            firmware.flashed.report_observed(folder)
        return result


def _ended(flight: Flight, fly: Callable[[], Ended | None]) -> tuple[Outcome, str | None] | None:
    """Fly; return outcome and cause, None when it flies on, and log the cause when the firmware ended the flight."""
    try:
        end = fly()
    except WatchdogError as error:
        flight.note("board", str(error))
        return "lost", str(error)
    except Exception as error:
        first = error.__cause__ or error
        cause = f"board {first}" if isinstance(first, LinkError) else f"{type(error).__name__}: {error}"
        flight.note("lab", cause)
        return "error", cause
    if end is None:
        return None
    if flight.logic_failed is not None and not end.interrupted:
        return "error", "; ".join(filter(None, (flight.logic_failed, end.lost)))
    return "interrupted" if end.interrupted else "lost" if end.lost else "completed", end.lost


def _close(flight: Flight, recorder: Recorder, folder: Path) -> str:
    """Finish the files of a flight and release its resources; return the hash of the record."""
    with closing(flight):  # even when the recorder cannot write to a full disk
        digest = recorder.close(flight.line.correct)
    flight.write_schedule(folder)
    return digest
