"""The result of robots that flew together: those of each, their least distance, and one hash; `swarm.json`."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from hil.laboratory.files.result import Outcome, Result
from hil.laboratory.files.whole_files import write_whole
from hil.laboratory.metrics import Metric, Verdict
from hil.laboratory.swarms.request import Place, SwarmRequest

SWARM = "swarm.json"
DISTANCE = "distance_min"
SWARM_METRICS: Mapping[str, Metric] = {
    DISTANCE: Metric(
        "m", "min", "least distance between the centres of mass of two robots after the release"
    ),
}


def folder_name(number: int) -> str:
    """Return the name of the run folder of robot 1, 2, ...."""
    return f"robot-{number}"


@dataclass(frozen=True, slots=True)
class Nearest:
    """When two robots were nearest to each other."""

    distance: float  # [m]
    robots: tuple[int, int]  # their numbers, from 1
    at_s: float  # since the release

    def __str__(self) -> str:
        one, other = self.robots
        return f"robots {one} and {other}, {self.at_s:.2f} s after the release"


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """Results of the robots, in their order, and what they share."""

    request: SwarmRequest
    folder: Path
    robots: tuple[Result, ...]
    nearest: Nearest | None  # None: they were not all released

    @classmethod
    def of(
        cls, request: SwarmRequest, folder: Path, robots: tuple[Result, ...], nearest: Nearest | None
    ) -> "SwarmResult":
        """Return the result of a flight; robots of which fewer than two ever flew together have no distance."""
        known = nearest is not None and math.isfinite(nearest.distance)
        return cls(request, folder, robots, nearest if known else None)

    @property
    def origins(self) -> tuple[Place, ...]:
        """Where each robot's frame W is in the room [m]."""
        return self.request.origins

    @property
    def metrics(self) -> dict[str, float]:
        """Figures of the whole swarm, in the units of `SWARM_METRICS`; NaN where it has none."""
        return {DISTANCE: math.nan if self.nearest is None else self.nearest.distance}

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """The limits of the whole swarm; those of the robots are in their results."""
        value, bound = self.metrics[DISTANCE], self.request.config.distance_min
        return (Verdict(DISTANCE, value, bound, value >= bound, "m", "min"),)

    @property
    def outcome(self) -> Outcome:
        """The worst of all robots."""
        order: tuple[Outcome, ...] = ("completed", "reset", "lost", "error", "interrupted")
        return max((one.outcome for one in self.robots), key=order.index)

    @property
    def passed(self) -> bool:
        """Whether every robot passed and the swarm's own limits hold."""
        return all(one.passed for one in self.robots) and all(one.holds for one in self.verdicts)

    @property
    def hash(self) -> str:
        """SHA-256 of the hashes of all robots: the same for the same flight."""
        return hashlib.sha256(" ".join(one.hash for one in self.robots).encode()).hexdigest()


def write_swarm(result: SwarmResult) -> None:
    """Write `swarm.json`; a missing number is null."""
    values = {
        "outcome": result.outcome,
        "passed": result.passed,
        "hash": result.hash,
        "metrics": {name: None if math.isnan(value) else value for name, value in result.metrics.items()},
        "nearest": None if result.nearest is None else asdict(result.nearest),
        "limits": {verdict.metric: verdict.bound for verdict in result.verdicts},
        "robots": [
            {
                "folder": one.folder.name,
                "origin": origin,
                "experiment": one.request.experiment.name,
                "seed": one.request.seed,
                "outcome": one.outcome,
                "cause": one.cause,
                "passed": one.passed,
                "hash": one.hash,
            }
            for one, origin in zip(result.robots, result.origins, strict=True)
        ],
    }
    write_whole(result.folder / SWARM, json.dumps(values, indent=2) + "\n")
