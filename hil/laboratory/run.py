"""A run: one flight into its folder, with log, telemetry, events, result, recording and report.

`runs/<experiment>-<seed>/` holds `log.parquet`, `events.jsonl`, `telemetry.csv`, `result.json`, `flight.rrd` and
`report.html`. Whatever ends the flight (its time, a crash, Ctrl-C, an error in a task), earlier data are kept.
"""

import gc
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from firmware_py.rtos import WatchdogError
from ground_station.errors import LinkError
from ground_station.telemetry_log import TELEMETRY
from hil.board.clock import Pace
from hil.config import check_logic
from hil.laboratory.files.ages import with_goals_sent
from hil.laboratory.files.coverage import Executed, add_executed
from hil.laboratory.files.cpu_profile import write_profile
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
from hil.laboratory.laboratory import Progress
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
    request.experiment.check_known()  # a request from a run folder was not checked
    check_logic(request.config)
    with ExitStack() as stack:
        stack.callback(gc.set_threshold, *gc.get_threshold())
        gc.set_threshold(*COLLECTIONS)
        with replacing_older(folder):
            flight = flight_of(request, folder / TELEMETRY, stack)
        program = Program.of(request.config)
        metadata = metadata_of(request, program, flight.robot.body.look)
        recorder = Recorder(folder, flight.channels(), metadata, observer)
        pace = Pace(LOADED_US)

        def on_progress(now_us: int) -> None:
            pace.look(now_us)
            if progress is not None:
                progress(now_us, flight)

        try:
            ended = _fly_to_the_end(flight, on_progress, recorder)
        finally:
            factor = pace.factor(flight.now_us)
            digest = _close(flight, recorder, folder)
    log, firmware, failures = load_log(folder), flight.robot.firmware, flight.robot.failures
    lost = ended[0] == "lost" or flight.lost is not None
    metrics = request.experiment.metrics_of(log, lost, flight.resets)
    ended = with_failures(*with_resets(*ended, metrics["resets"]), failures)
    queues = firmware.scheduler.queues if firmware.scheduler is not None else ()
    result = replace(
        judged(request, program, ended, metrics, log, digest, folder),
        failures=failures,
        tasks=tuple(firmware.reports()),
        queues=tuple(QueueReport(one.name, one.length, one.high_water, one.dropped) for one in queues),
        usage=firmware.usage,
        real_time_factor=round(factor, 2),
        stood_still_ms=flight.lab.clock.stood_still_us / 1000,
        image=None if firmware.flashed is None else firmware.flashed.report(),
    )
    write_result(result)
    bench = request.bench
    if bench.coverage is not None and firmware.flashed is not None and result.image is not None:
        flown = Executed(result.image.sha256, 1, firmware.flashed.passages, bench.board, bench.elf)
        add_executed(bench.coverage, flown)
    if bench.profile_cpu is not None and firmware.flashed is not None and result.image is not None:
        write_profile(bench.profile_cpu, folder, firmware.flashed.cpu_profile(), result.image)
    return result


def _fly_to_the_end(flight: Flight, progress: Progress, recorder: Recorder) -> tuple[Outcome, str | None]:
    """Fly; return the outcome and its cause, and log the cause when the firmware ended the flight."""
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
    """Finish the files of a flight and release its resources; return the hash of the record."""
    record = flight.line.record
    with closing(flight):  # even when the recorder cannot write to a full disk
        digest = recorder.close(None if record is None else partial(with_goals_sent, record))
    flight.write_schedule(folder)
    return digest
