"""Compares an image with the Python board in flights from one seed, within bounds.

A second flight takes the supervisor through its states, which must be the same in the same order.

The two are never equal bit for bit: boot time, gyro zero, the estimator's phase and the board's microsecond differ
(`hil.research.studies.two_boards`). The bounds are about twice the largest difference of ten correct flights: seeds 1 to 5,
the app compiled by gcc 12.2 and by clang 22. Each is a hover of 4 s with a push and a cut link; the largest differences are
0.96 mm of position and 370 servo counts (rms). The first pose after the cut is about as old as the filter's horizon, and the
phase decides whether it is fused: if one board fuses it and the other waits for the next one, the estimate differs by 5 cm
in one row of 400, which is 2.7 mm rms.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from hil.board.cores.boards import C
from hil.deploy.drill import DRILL
from hil.laboratory.experiments.position import HOVER
from hil.laboratory.files.recorder import load_events
from hil.laboratory.files.result import Result
from hil.laboratory.flight import Flight
from hil.laboratory.metrics import column, free_flight
from hil.laboratory.request import Options, Request
from hil.laboratory.run import fly
from hil.pictures.compare import FlownRun, load_flown

SECONDS, SEED = 4.0, 1
ANNOUNCED = "supervisor: "
FAULTS = ("push.y@0.5=1", "radio.cut@2:0.8")


@dataclass(frozen=True, slots=True)
class Bound:
    """How much a column may differ: a kind of `SIZES`, in `unit`, at most `limit`."""

    name: str
    columns: tuple[str, ...]
    size: str
    limit: float
    unit: str = ""
    factor: float = 1.0


# Of the differences between two columns:
SIZES: dict[str, Callable[[NDArray[np.float64]], float]] = {
    "rms": lambda difference: float(np.sqrt((difference**2).mean())),
    "mean": lambda difference: abs(float(difference.mean())),
    "final": lambda difference: abs(float(difference[-1])),
    "share of time": lambda difference: float((difference != 0).mean()),
}
BOUNDS = (
    Bound("position", ("truth.x", "truth.y", "truth.z"), "rms", 2.0, "mm", 1e3),
    Bound("body rates", ("truth.p", "truth.q", "truth.r"), "rms", 0.25, "rad/s"),
    Bound("estimated position", ("estimate.x", "estimate.y", "estimate.z"), "rms", 7.0, "mm", 1e3),
    Bound("estimated rates", ("estimate.p", "estimate.q", "estimate.r"), "mean", 0.004, "rad/s"),
    Bound("servo counts", tuple(f"motor.m{servo}" for servo in range(1, 5)), "rms", 750.0),
    Bound("servo counts", tuple(f"motor.m{servo}" for servo in range(1, 5)), "mean", 17.0),
    Bound("age of poses", ("estimator.pose_age_us",), "mean", 1.0, "ms", 1e-3),
    Bound("poses fused", ("estimator.fused",), "final", 2.0),
    Bound("poses not fused", tuple(f"estimator.{one}" for one in ("refused", "jumps", "too_old", "invalid")), "final", 4.0),
    Bound("supervisor's state", ("supervisor.state",), "share of time", 1.0, "%", 100.0),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Compared:
    """A bound, the column that differs most, and by how much."""

    bound: Bound
    column: str
    found: float

    @property
    def held(self) -> bool:
        """Whether the difference is within the bound; NaN is not."""
        return self.found <= self.bound.limit

    def __str__(self) -> str:
        unit = f" {self.bound.unit}" if self.bound.unit else ""
        what = f"{self.bound.name}, {self.bound.size}"
        return f"{what}: {self.found:.3g}{unit} apart ({self.column}), at most {self.bound.limit:g}{unit}"


def compare_flights(first: FlownRun, second: FlownRun) -> Iterator[Compared]:
    """Yield the differences between the free flights of two runs, each with its bound."""
    flights = [free_flight(run.log) for run in (first, second)]
    rows = min(flight.num_rows for flight in flights)
    for bound in BOUNDS:
        sizes = {}
        for name in bound.columns:
            a, b = (column(flight, name)[:rows] for flight in flights)
            sizes[name] = bound.factor * SIZES[bound.size](b - a) if rows else float("nan")
        worst = max(sizes, key=lambda name: np.inf if np.isnan(sizes[name]) else sizes[name])
        yield Compared(bound, worst, sizes[worst])


def fly_beside_python(
    image: Path, profile: str, overrides: tuple[str, ...], progress: Callable[[str, int, Flight], None]
) -> tuple[list[Compared], list[str], list[str]]:
    """Fly an image and the Python board; return the differences in columns, outcomes and states."""
    options: Options = {"profile": profile, "overrides": overrides, "seed": SEED}
    disturbed: Options = {**options, "duration_s": SECONDS, "faults": FAULTS}
    requests = Request.of(HOVER, **disturbed), Request.of(DRILL, **options)
    with TemporaryDirectory(prefix="floaty-") as folder:
        place = Path(folder)
        pairs = [_fly_both(one, image, place / one.experiment.name, progress) for one in requests]
        hovers, drills = ([result.folder for result in pair] for pair in pairs)
        ends = [text for pair in pairs for text in _ends(*pair)]
        return list(compare_flights(*map(load_flown, hovers))), ends, list(compare_states(*drills))


def _fly_both(
    request: Request, image: Path, folder: Path, progress: Callable[[str, int, Flight], None]
) -> tuple[Result, Result]:
    """Fly a request on the Python board and on an image; Ctrl-C raises `KeyboardInterrupt`."""
    results = []
    for name, board in (("python", C), ("image", str(image))):
        on_board = replace(request, bench=replace(request.bench, board=board))
        show = partial(progress, f"{request.experiment.name}, {name}")
        results.append(fly(on_board, folder / name, progress=show))
        if results[-1].outcome == "interrupted":
            raise KeyboardInterrupt
    return results[0], results[1]


def states_of(folder: Path) -> list[str]:
    """Return the states, with their causes, that the supervisor of a flight announced on its console."""
    texts = (one["text"].partition(ANNOUNCED) for one in load_events(folder) if one["source"] == "board")
    return [state for _, found, state in texts if found]


def compare_states(python: Path, image: Path) -> Iterator[str]:
    """Yield the first supervisor state that only one board reached."""
    both = zip_longest(states_of(python), states_of(image), fillvalue="the end")
    for number, (first, second) in enumerate(both, 1):
        if first != second:
            yield f"number {number} differs: python {first}, image {second}"
            return


def _ends(python: Result, image: Result) -> Iterator[str]:
    if (python.outcome, python.cause) != (image.outcome, image.cause):
        ends = (f"{one.outcome}{f' ({one.cause})' if one.cause else ''}" for one in (python, image))
        yield "the flight ends otherwise: python {}, image {}".format(*ends)
    if image.image is not None and (resets := image.image.watchdog_resets + image.image.software_resets):
        yield f"the board reset {resets} times in flight"
