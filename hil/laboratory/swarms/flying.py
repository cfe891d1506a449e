"""A flight of several robots: laboratories that run in turn, `SLICE_US` at a time, on one clock.

After each turn the robots feel one another (`hil.world.neighbours`) and hear what their boards have sent to one another, so
the flight is the same whatever the machine does. A robot whose flight is over is out of the room. Each robot has
its own Crazyradio on the ground; the radios do not interfere.
"""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np

from ground_station.errors import LinkError
from hil.errors import refusing
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import ModelledLine, executor_of, lockstep_flight
from hil.laboratory.request import Request
from hil.laboratory.run import Started
from hil.laboratory.swarms.neighbourhood import ABSENT, Neighbourhood, row_of
from hil.laboratory.swarms.request import SwarmRequest
from hil.laboratory.swarms.result import Nearest, SwarmResult, folder_name, write_swarm

SLICE_US = 2_000  # a contact of 150 N/m with 30 g turns within 40 ms
SHOWN_US = 250_000


class Crowd:
    """The robots of a swarm, between two turns."""

    def __init__(self, request: SwarmRequest, started: list[Started]) -> None:
        self.nearest: Nearest | None = None  # after the release
        self._started, self._flights = started, [one.flight for one in started]
        self._origins = request.origins
        self._packets: list[tuple[int, bytes]] = []  # index of the sender, packet
        self._neighbourhood = Neighbourhood(request.config, len(started), request.still_air)
        for index, flight in enumerate(self._flights):
            _line(flight).join(partial(self._take, index))

    def _take(self, index: int, now_us: int, packet: bytes) -> None:
        self._packets.append((index, packet))

    def exchange(self, now_us: int) -> None:
        """Let the robots act on one another at an instant that all of them have reached."""
        rows = [
            ABSENT if one.over else row_of(one.flight.robot, now_us, origin)
            for one, origin in zip(self._started, self._origins, strict=True)
        ]
        self._neighbourhood.interact(np.array(rows))
        for index, flight in enumerate(self._flights):
            self._neighbourhood.act_on(index, flight.robot)
        self._deliver(now_us)
        if all(flight.robot.free for flight in self._flights):
            self._note_distance(now_us)

    def _note_distance(self, now_us: int) -> None:
        near = self._neighbourhood.near
        if self.nearest is None or near.least < self.nearest.distance:
            robots = (int(near.one) + 1, int(near.other) + 1)
            since_s = 1e-6 * (now_us - self._flights[0].release_us)
            self.nearest = Nearest(float(near.least), robots, since_s)

    def _deliver(self, now_us: int) -> None:
        """Let all boards hear what the others have sent."""
        packets, self._packets = self._packets, []
        for sender, packet in packets:
            for i, flight in enumerate(self._flights):
                if i != sender and not self._started[i].over:
                    _line(flight).hear_peer(now_us, packet)


def fly_swarm(
    request: SwarmRequest, folder: Path, progress: Callable[[int, int], None] | None = None
) -> SwarmResult:
    """Fly robots together and write everything but the pictures into `folder`, with a run folder for each.

    `progress` gets the time and the end [us]. A robot's loss is a result. Raises `LabError` if a board is not available.
    """
    with ExitStack() as stack:
        with refusing("--board ", LinkError):
            executor = executor_of(request.robots[0], stack)

        def flight_of(number: int, one: Request, telemetry: Path | None, _: ExitStack) -> Flight:
            return lockstep_flight(one, telemetry, executor, number=number)

        started: list[Started] = []
        for number, one in enumerate(request.robots, 1):
            place = folder / folder_name(number)
            started.append(Started(one, place, stack, flight_of=partial(flight_of, number)))
            stack.callback(started[-1].close)
        crowd = Crowd(request, started)
        _fly_in_turn(started, crowd, progress)
    results = tuple(one.result() for one in started)
    result = SwarmResult.of(request, folder, results, crowd.nearest)
    write_swarm(result)
    return result


def _fly_in_turn(started: list[Started], crowd: Crowd, progress: Callable[[int, int], None] | None) -> None:
    now_us = 0
    for one in started:
        one.begin()
    try:
        while not all(one.over for one in started):
            now_us += SLICE_US
            for one in started:
                one.fly_to(now_us)
            crowd.exchange(now_us)
            if progress is not None and now_us % SHOWN_US == 0:
                progress(now_us, max(one.flight.end_us for one in started))
    except KeyboardInterrupt:
        for one in started:
            one.interrupt()


def _line(flight: Flight) -> ModelledLine:
    line = flight.line
    assert isinstance(line, ModelledLine)
    return line
