"""The ground station: frames in, poses and goals out, telemetry into the log. It never reads a clock: callers
pass the time.

The tracker, if there is one, decides which frames are used. A tracked pose is sent with the present goal, as in
the original: a new goal counts at once, not after the camera's latency.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from firmware_py.wire import WireError
from firmware_py.wire.telemetry import SLOW_BLOCKS, Sample
from ground_station.config import StationConfig
from ground_station.latency import LatencyBudget, LinkLatency
from ground_station.mocap import MocapFrame, judged
from ground_station.tracker import Track, Tracker
from ground_station.trajectory import Goal, Trajectory
from ground_station.unused import Event, UnusedPoses

TELEMETRY_TIMEOUT_US = 500_000  # of silence, after which the board is asked again

# Takes a sample of telemetry with the station's own data, as `ground_station.telemetry_log.TelemetryLog.write` does.
WriteSample = Callable[[int, Sample, Goal, MocapFrame | None, Track | None, LatencyBudget], object]


class Link(Protocol):
    """A link to the board with its protocol."""

    def start_telemetry(self, now_us: int) -> None:
        """Ask the board for its telemetry."""

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Send a tracked pose and the goal in the form that the board needs."""

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """Return the telemetry in `data`, empty if it is something else; `WireError` if it is malformed."""

    @property
    def latency(self) -> LinkLatency:
        """The latency from `send` to the board."""


@dataclass(slots=True)
class StationCounters:
    frames: int = 0  # from motion capture
    invalid: int = 0  # of these, not used; `GroundStation.unused` has the reasons
    sent: int = 0  # handed to the link
    received: int = 0  # packets, or pieces of a stream, from the board
    samples: int = 0  # of telemetry in these
    malformed: int = 0  # of these, not decodable


class Slots:
    """When corrections are due: evenly, on the exposures' clock, at any rate of the frames.

    A frame up to an eighth of the period early takes its slot, so that cameras about as fast as the corrections lose
    none to jitter. The slots keep their phase: a late frame does not delay the next one.
    """

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._early_us = period_us // 8
        self._next_us: int | None = None  # None until the first frame sets the phase

    def due(self, t_us: int) -> bool:
        """Return whether the frame exposed at `t_us` belongs to a free slot; the first one does."""
        if self._next_us is None or t_us < self._next_us - self._period_us - self._early_us:  # clock set back
            self._next_us = t_us
        return t_us >= self._next_us - self._early_us

    def fill_slot(self, t_us: int) -> None:
        """Fill the slot of the frame exposed at `t_us`, and unused earlier ones."""
        assert self._next_us is not None
        passed = (t_us + self._early_us - self._next_us) // self._period_us
        self._next_us += (passed + 1) * self._period_us


class GroundStation:
    """Passive: call `on_frame` for each frame of motion capture, `on_packet` for all data from the board."""

    def __init__(
        self,
        link: Link,
        trajectory: Trajectory,
        write_sample: WriteSample | None,
        config: StationConfig,
        tracker: Tracker | None = None,
    ) -> None:
        self.counters = StationCounters()
        self.unused = UnusedPoses()
        self.tracker = tracker
        self.budget = LatencyBudget()
        self._link = link
        self._trajectory = trajectory
        self._write_sample = write_sample
        self._slots = Slots(round(1e6 / config.corrections_hz))
        self.frame: MocapFrame | None = None  # the last one used
        self.track: Track | None = None  # the tracker's result for the last frame
        self.telemetry: dict[int, Sample] = {}  # the newest of each block, by its number
        self._ask_for_telemetry_us = 0  # postponed by every sample of the stream

    def on_frame(self, frame: MocapFrame, now_us: int) -> None:
        """Send the frame of each slot, or the first usable one after it."""
        counters = self.counters
        counters.frames += 1
        if now_us >= self._ask_for_telemetry_us:
            self._link.start_telemetry(now_us)
            self._ask_for_telemetry_us = now_us + TELEMETRY_TIMEOUT_US
        frame = judged(frame)
        due = self._slots.due(frame.t_us)
        event = Event.NONE
        if self.tracker is not None:
            self.track = self.tracker.track_frame(frame)
            frame, event = self.track.frame, self.track.event
        self.unused.note(now_us, frame.t_us, None if frame.valid else frame.unused, event)
        if not frame.valid:
            counters.invalid += 1
            return
        self.frame = frame
        if not due:
            return
        self._link.send(now_us, frame, self._trajectory.at(now_us))
        counters.sent += 1
        self.budget.add(frame, now_us, self._link.latency)
        self._slots.fill_slot(frame.t_us)

    def notices(self) -> list[str]:
        """Return lines for the user since the last call."""
        return self.unused.due()

    def on_packet(self, now_us: int, data: bytes) -> None:
        """Take bytes from the board: telemetry is logged, unreadable bytes are counted."""
        self.counters.received += 1
        try:
            samples = self._link.receive(now_us, data)
        except WireError:
            self.counters.malformed += 1
            return
        self.counters.samples += len(samples)
        for sample in samples:
            if sample.block not in SLOW_BLOCKS:
                self._ask_for_telemetry_us = now_us + TELEMETRY_TIMEOUT_US
            self.telemetry[sample.block.id] = sample
            if self._write_sample is not None:
                goal = self._trajectory.at(now_us)
                self._write_sample(now_us, sample, goal, self.frame, self.track, self.budget)
