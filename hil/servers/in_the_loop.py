"""A flight with a real board in the loop: the plant's clock follows the board's, everything else is as in lockstep.

The board flies by its own tasks with the samples of the virtual IMU (`hil.devices.real_firmware`); cameras, ground station
and the modelled radio with its faults are those of a flight in lockstep, behind which the corrections go to the board.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from ground_station.errors import LinkError
from hil.clock import Clock, Paced
from hil.devices.real_core import is_link, open_real_core
from hil.devices.real_firmware import RealBoard
from hil.errors import LabError
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import RADIO, lockstep_flight
from hil.laboratory.run import MakeFlight, Request

HOLD_US = 2_000_000  # in the holder at least: the gyro's zero has to be found through the link


def in_the_loop(moving: bool) -> MakeFlight:
    """Return what puts such flights together; `moving`: the board's servos move as well."""

    def flight_of(
        request: Request, telemetry: Path, clock: Clock | None, trace_all: bool, stack: ExitStack
    ) -> Flight:
        if not is_link(request.board) or request.link != RADIO:
            raise LabError(
                f"--hil: --board {request.board} --link {request.link}: expected the link to a real board as --board"
            )
        paced = Paced()
        board = RealBoard(open_real_core(request.board, "--board", stack), moving, paced)
        stack.callback(board.leave)
        return flight_in_the_loop(request, board, paced, telemetry)

    return flight_of


def flight_in_the_loop(
    request: Request, board: RealBoard, clock: Clock, telemetry: Path | None = None
) -> Flight:
    """Return a flight on a clock that follows the wall. Raises `LabError` when there is no board."""
    held = max(request.config.flight.release_us, HOLD_US)
    start = request.config.flight.model_copy(update={"release_us": held})
    order = replace(request, config=request.config.model_copy(update={"flight": start}))
    try:
        flight = lockstep_flight(order, telemetry, clock, executor=board)
    except LinkError as error:
        raise LabError(f"--board {error}") from None
    flight.events.at(0, lambda now_us: flight.note("board", str(flight.robot.firmware)))
    return flight
