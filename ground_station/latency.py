"""The parts of a pose's age: camera, processing, network, station and link, from the exposure to the board.

Camera: until the motion capture computer has the images. Processing: until the pose leaves it. Network: until the
station has it. Station: until the link gets it. Link: until the board has it. "mocap" is the sum of the first three, for
sources that do not report them separately. Times in microseconds.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil, isnan, nan

from ground_station.mocap import MocapFrame

STAGES = ("camera", "processing", "network", "mocap", "station", "link")
SENT_POSES = 250  # in the budget: 5 s at 50 Hz

Row = tuple[float, ...]  # the time of one pose in each of `STAGES`; nan: not reported


@dataclass(frozen=True, slots=True)
class LinkLatency:
    """The latency of a pose on a link to the board."""

    medium: str
    us: int
    measured: bool  # False: assumed

    def __str__(self) -> str:
        return self.medium if self.measured else f"{self.medium} (assumed)"


@dataclass(frozen=True, slots=True)
class Stage:
    """The time of many poses in a stage."""

    name: str
    mean_us: float
    p99_us: float  # 99 of 100 spent no more


def row_of(frame: MocapFrame, sent_us: int, link_us: int) -> Row:
    """Return the latency by stages of a pose that the link got at `sent_us`."""
    arrived_us = sent_us if frame.arrived_us is None else frame.arrived_us
    rest = (arrived_us - frame.t_us, sent_us - arrived_us, link_us)
    if frame.received_us is None or frame.transmitted_us is None:
        return (nan, nan, nan, *rest)
    camera_us, processing_us = frame.received_us - frame.t_us, frame.transmitted_us - frame.received_us
    return (camera_us, processing_us, arrived_us - frame.transmitted_us, *rest)


def columns_of(rows: Sequence[Row]) -> dict[str, tuple[float, ...]]:
    """Return the times of many poses by stage; empty without poses."""
    return dict(zip(STAGES, zip(*rows, strict=True), strict=True)) if rows else {}


def budget_of(columns: Mapping[str, Sequence[float]], medium: str) -> tuple[Stage, ...]:
    """Return the reported stages, and the age on board as "pose" ahead of them; empty without poses."""
    if not columns:
        return ()
    pose = _stage("pose", [sum(parts) for parts in zip(*(columns[name] for name in STAGES[3:]), strict=True)])
    stages = (_stage(medium if name == "link" else name, columns[name]) for name in reported_stages(columns))
    return (pose, *stages)


def reported_stages(columns: Mapping[str, Sequence[float]]) -> tuple[str, ...]:
    """Return the stages that add up to the age: "mocap" only where one of its parts is not reported."""
    apart = [name for name in STAGES[:3] if not isnan(sum(columns[name]))]
    return (*(apart if len(apart) == 3 else ("mocap",)), *STAGES[4:])


def _stage(name: str, times: Sequence[float]) -> Stage:
    return Stage(name, sum(times) / len(times), sorted(times)[ceil(0.99 * len(times)) - 1])


def budget_line(budget: Sequence[Stage]) -> str:
    if not budget:
        return "no pose sent"
    pose, *parts = budget
    shares = " + ".join(f"{part.name} {part.mean_us / 1000:.1f}" for part in parts)
    return f"pose {pose.mean_us / 1000:.1f} ms old on arrival (99 %: {pose.p99_us / 1000:.1f}): {shares}"


class LatencyBudget:
    """The latencies of the last poses sent."""

    def __init__(self) -> None:
        self._link: LinkLatency | None = None  # of the last pose
        self._sent: deque[tuple[MocapFrame, int, int]] = deque(maxlen=SENT_POSES)

    def add(self, frame: MocapFrame, sent_us: int, link: LinkLatency) -> None:
        """Add a pose that the link got at `sent_us`."""
        self._link = link
        self._sent.append((frame, sent_us, link.us))

    def last(self) -> Row:
        """Return the latency of the last pose by stages, all nan before the first."""
        return row_of(*self._sent[-1]) if self._sent else (nan,) * len(STAGES)

    def __str__(self) -> str:
        return budget_line(budget_of(columns_of([row_of(*sent) for sent in self._sent]), str(self._link)))
