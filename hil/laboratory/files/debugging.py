"""Flies a finished flight of an image again, up to a time before its crash, where it waits for GDB."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from hil.board.image_firmware import read_image
from hil.errors import LabError, reading
from hil.laboratory.files.recorder import load_events
from hil.laboratory.files.result import Result
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import in_lockstep
from hil.laboratory.request import Request

CRASH = "crash"
LOST = "lost: "  # the begin of the laboratory's line on a crash


def debugged_request(result: Result) -> Request:
    """Return the request of a run for another flight of it under GDB. Raises `LabError` if that is not the same flight."""
    request, folder = result.request, result.folder
    bench = request.bench
    if not bench.is_image or not bench.in_lockstep or bench.realtime:
        raise LabError(
            f"{folder}: --board {bench.board} --link {bench.link}: only flights of an image in lockstep are debugged"
        )
    request.experiment.check_known()
    with reading(Path(bench.board)):
        now = read_image(Path(bench.board), bench.elf)[0].sha256
    if result.image is not None and result.image.sha256 != now:
        raise LabError(f"{bench.board}: another image than the one that flew in {folder}: fly it again")
    return replace(request, bench=replace(bench, gdb=0))


def begin_us(result: Result, at: str, before_s: float) -> int:
    """Return the laboratory's time [us] so long before a crash or a time in s. Raises `LabError` for none of them."""
    if at == CRASH:
        return _crash_us(result) - round(before_s * 1e6)
    try:
        at_s = float(at)
    except ValueError:
        at_s = -1.0
    if not 0.0 <= at_s < 1e6:
        raise LabError(f"--at {at}: expected {CRASH}, or a time of the flight in seconds")
    return round((at_s - before_s) * 1e6)


def _crash_us(result: Result) -> int:
    """Return when the image failed first or, if it did not, when the robot crashed."""
    events = load_events(result.folder)
    for event in events:
        if event["text"] in result.failures:
            return int(event["t_us"])
    for event in events:
        if event["source"] == "lab" and event["text"].startswith(LOST):
            return int(event["t_us"])
    raise LabError(f"--at {CRASH}: {result.folder} has no crash: give the time in seconds")


def waiting_flight(port: int, from_us: int) -> Callable[[Request, Path | None, ExitStack], Flight]:
    """Return the function that assembles a flight which waits for GDB on a port, at a time of the laboratory."""

    def flight_of(request: Request, telemetry: Path | None, stack: ExitStack) -> Flight:
        waiting = replace(request, bench=replace(request.bench, gdb=port))
        return in_lockstep(waiting, telemetry, stack, from_us)

    return flight_of
