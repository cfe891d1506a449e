"""A flight with a real board in the loop: the plant's clock follows the board's, everything else is as in lockstep.

The board's own tasks fly on samples of the virtual IMU (`hil.board.real_firmware`). Cameras, ground station and the
modelled radio with its faults are those of a flight in lockstep; corrections pass through them to the board.
"""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from ground_station.errors import LinkError
from hil.board.clock import Clock, Paced
from hil.board.real_core import open_real_core
from hil.board.real_firmware import RealBoard
from hil.errors import LabError
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request

HOLD_US = 2_000_000  # in the holder at least: the board finds its gyro's zero through the link


def in_the_loop(request: Request, telemetry: Path | None, stack: ExitStack) -> Flight:
    """Return such a flight, on a clock that follows the wall clock. Raises `LabError` without a board."""
    paced = Paced()
    core = open_real_core(request.bench.board, "--board", stack)
    board = RealBoard(core, request.bench.in_loop == "moving", paced)
    stack.callback(board.leave)
    return flight_in_the_loop(request, board, paced, telemetry)


def flight_in_the_loop(
    request: Request, board: RealBoard, clock: Clock, telemetry: Path | None = None
) -> Flight:
    """Return a flight with an opened board, held until its gyro's zero is known."""
    held_us = max(request.config.flight.release_us, HOLD_US)
    held = replace(request, overrides=(*request.overrides, f"flight.release_us={held_us}"))
    try:
        flight = lockstep_flight(held, telemetry, board, clock)
    except LinkError as error:
        raise LabError(f"--board {error}") from None
    flight.events.at(0, lambda now_us: flight.note("board", str(flight.robot.firmware)))
    return flight
