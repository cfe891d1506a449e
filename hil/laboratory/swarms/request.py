"""Which robots fly together, and where: one request per robot, each with its own seed, place and radio address.

In still air all robots share the frame W of one room, and their home goals are apart. Where fans blow, each robot has a
tunnel of its own, at the robot's place in the room, and its request is that of a single flight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Unpack

from hil.config import settings_of
from hil.errors import LabError
from hil.laboratory.experiment import Experiment
from hil.laboratory.request import Options, Request
from hil.world.config import SwarmConfig
from hil.world.neighbours import ROBOTS_MAX

Place = tuple[float, float, float]  # [m] in W of the room


@dataclass(frozen=True, slots=True)
class SwarmRequest:
    """Robots that fly together."""

    robots: tuple[Request, ...]
    origins: tuple[Place, ...]  # of each robot's own frame W in the room
    still_air: bool

    @property
    def config(self) -> SwarmConfig:
        """Their common settings."""
        return self.robots[0].config.swarm

    @property
    def title(self) -> str:
        """The heading of a page or a table."""
        first = self.robots[0]
        names = dict.fromkeys(one.experiment.name for one in self.robots)
        return f"{', '.join(names)}, {len(self.robots)} robots, seeds {first.seed} to {self.robots[-1].seed}"


def swarm_of(experiments: Sequence[Experiment], **options: Unpack[Options]) -> SwarmRequest:
    """Return the request of one robot per experiment. Raises `LabError` if they cannot fly together."""
    count = len(experiments)
    if not 2 <= count <= ROBOTS_MAX:
        raise LabError(f"--robots {count}: expected 2 to {ROBOTS_MAX}")
    first = Request.of(experiments[0], **options)
    first.bench.check_many("--robots", count)
    places = places_of(first.config.swarm, count)
    still_air = first.config.tunnel.fan_factor == 0.0
    robots = []
    for index, (experiment, place) in enumerate(zip(experiments, places, strict=True)):
        own: Options = {**options, "seed": first.seed + index}
        if still_air and any(place):
            home = [a + b for a, b in zip(first.config.flight.home, place, strict=True)]
            own["overrides"] = (
                *settings_of(options.get("overrides", ())),
                *settings_of({"flight.home": home}),
            )
        robots.append(Request.of(experiment, **own))
    if len({round(1e6 * one.duration_s) for one in robots}) > 1:
        longest: Options = {**options, "duration_s": max(one.duration_s for one in robots)}
        return swarm_of(experiments, **longest)
    origins = [(0.0, 0.0, 0.0)] * count if still_air else places
    return SwarmRequest(tuple(robots), tuple(origins), still_air)


def places_of(swarm: SwarmConfig, count: int) -> list[Place]:
    """Return the places of the robots: the profile's, or a V with robot 1 at its point, even ones on the left."""
    if swarm.places:
        if len(swarm.places) < count:
            raise LabError(
                f"swarm.places: {len(swarm.places)} places, expected one for each of {count} robots"
            )
        return list(swarm.places[:count])
    places = [(0.0, 0.0, 0.0)]
    for number in range(2, count + 1):
        behind = swarm.spacing * (number // 2)
        places.append((-behind, behind if number % 2 == 0 else -behind, 0.0))
    return places
