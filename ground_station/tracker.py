"""The tracker between motion capture and link: it refuses wrong poses and estimates the velocity.

Good frames pass unchanged: smoothing would add a delay unknown to the board's filter. A pose is refused when it is
further from the prediction than noise and pushes explain. Without a good pose for `reacquire_us` the track is lost, and it
restarts when three poses fit one another, which wrong ones rarely do. The first track starts the same way.
"""

from collections import deque
from dataclasses import dataclass, replace
from enum import IntEnum
from math import degrees, nan, sqrt

from firmware_py.elementary import atan2
from firmware_py.geometry import Vector
from ground_station.config import TrackerConfig
from ground_station.mocap import MocapFrame
from ground_station.pose_filter import PoseFilter

GATHER_US = 500_000


@dataclass(slots=True)
class TrackNotices:
    """Collects events until a line is due; times are from frames."""

    _refused: int = 0
    _distance: float = 0.0  # the largest [m]
    _angle: float = 0.0  # [rad]
    _lost: bool = False
    _gap_us: int | None = None  # before a track that began again
    _due_us: int | None = None

    def refused(self, t_us: int, distance: float, angle: float) -> None:
        """Note a pose refused at this distance from the prediction [m, rad]."""
        self._refused += 1
        self._distance = max(self._distance, distance)
        self._angle = max(self._angle, angle)
        self._happened(t_us)

    def lost(self, t_us: int) -> None:
        """Note a lost track."""
        self._lost = True
        self._happened(t_us)

    def restarted(self, t_us: int, gap_us: int) -> None:
        """Note a new track, `gap_us` after the last good pose."""
        self._gap_us = gap_us
        self._happened(t_us)

    def due(self, t_us: int) -> list[str]:
        """Return at most one line, by a clock that may jump."""
        if self._due_us is None or 0 < self._due_us - t_us <= GATHER_US:
            return []
        notices = []
        if self._refused:
            poses = "1 pose" if self._refused == 1 else f"{self._refused} poses"
            notices.append(
                f"{poses} refused, up to {self._distance:.2f} m and {degrees(self._angle):.0f} deg from the prediction"
            )
        if self._gap_us is not None:
            notices.append(f"track restarted after {self._gap_us * 1e-6:.1f} s")
        elif self._lost:
            notices.append("track lost")
        self._refused, self._distance, self._angle = 0, 0.0, 0.0
        self._lost, self._gap_us, self._due_us = False, None, None
        return [f"motion capture: {'; '.join(notices)}"]

    def _happened(self, t_us: int) -> None:
        if self._due_us is None:
            self._due_us = t_us + GATHER_US


POSES = 3  # that begin a track
FIT_US = 50_000  # between them, or two and a half frames if that is longer; a later one does not confirm the others
WIDEN_US = 60_000  # refused poses widen the gate only until then, else it would accept them
UNKNOWN: Vector = (nan, nan, nan)


class Quality(IntEnum):
    """The tracker's decision about a frame."""

    NONE = 0  # no track, or the body was not seen
    REFUSED = 1  # it fits neither the track nor the time
    TRACKED = 3  # good; records of earlier versions have 2 for a predicted pose


@dataclass(slots=True)
class Track:
    """The frame to be used, and the robot's motion; NaN without a track."""

    frame: MocapFrame
    v_WB: Vector  # [m/s]
    w_B: Vector  # [rad/s]
    quality: Quality


@dataclass(slots=True)
class TrackerCounters:
    refused: int = 0
    restarts: int = 0  # tracks begun but the first


class Tracker:
    """`take` every frame, after `judged`; they come `period_us` apart."""

    def __init__(self, config: TrackerConfig, period_us: int) -> None:
        self.counters = TrackerCounters()
        self.quality = Quality.NONE  # of the last frame
        self._config = config
        self._period_us = period_us
        self._gate2 = config.gate * config.gate
        self._filter = PoseFilter(
            period_us * 1e-6,
            config.position_noise,
            config.rotation_noise,
            config.acceleration,
            config.angular_acceleration,
        )
        self._notices = TrackNotices()
        self._poses = 0  # that fit one another, up to `POSES`
        self._tracking = False  # there are `POSES` of them
        self._t_us = 0  # of the newest frame
        self._gaps_us: deque[int] = deque(
            maxlen=2
        )  # between the newest frames; the first one's is meaningless
        self._good_us = 0  # of the newest frame accepted by the filter
        self._lost_us: int | None = None  # of the last good frame before a track was lost
        self._refused_in_a_row = 0
        self._widening = max(1, WIDEN_US // period_us)

    def take(self, frame: MocapFrame) -> Track:
        """Return the frame to be used in place of `frame`."""
        track = self._take(frame)
        self.quality = track.quality
        return track

    def notices(self) -> list[str]:
        """Return lines for the user since the last call, half a second late so that one line has all of them."""
        return self._notices.due(self._t_us)

    def summary(self) -> str:
        """Return a few words on the state."""
        counters = self.counters
        return f"{self.quality.name.lower()} ({counters.refused} refused, {counters.restarts} restarts)"

    @property
    def _patience_us(self) -> int:
        """How old the last good frame may be: the cameras may be slower than the profile has it."""
        if self._tracking:
            return self._config.reacquire_us
        return max(FIT_US, 5 * min(self._gaps_us, default=0) // 2)

    def _take(self, frame: MocapFrame) -> Track:
        t_us = frame.t_us
        if t_us > self._t_us:
            self._gaps_us.append(t_us - self._t_us)
        if self._poses and abs(t_us - self._good_us) >= self._patience_us:
            self._lose()
        if not self._poses:
            self._t_us = t_us
            if frame.valid:
                self._begin(frame)
            return _without(frame, Quality.NONE)
        elapsed_us = t_us - self._t_us
        if elapsed_us <= 0:  # late, or a repetition
            self.counters.refused += 1
            return _without(frame, Quality.REFUSED)
        self._t_us = t_us
        steps = 1 if elapsed_us <= self._period_us else round(elapsed_us / self._period_us)
        self._filter.predict(steps, self._refused_in_a_row < self._widening)
        if not frame.valid:
            return self._without_pose(frame, Quality.NONE)
        distance2, angle2, theta = self._filter.deviation(frame.p_WB, frame.q_WB)
        position2, rotation2 = self._filter.variances
        if distance2 > self._gate2 * position2 or angle2 > self._gate2 * rotation2:
            if not self._tracking:  # one of them is wrong: start again with the newest
                self._begin(frame)
                return _without(frame, Quality.NONE)
            self.counters.refused += 1
            self._refused_in_a_row += 1
            self._notices.refused(t_us, sqrt(distance2), 2.0 * atan2(sqrt(angle2), 2.0))
            return self._without_pose(frame, Quality.REFUSED)
        v_WB, w_B = self._filter.update(frame.p_WB, theta)
        self._good_us = t_us
        self._refused_in_a_row = 0
        if not self._tracking:
            self._fit(t_us)
            if not self._tracking:
                return _without(frame, Quality.NONE)
        return Track(frame, v_WB, w_B, Quality.TRACKED)

    def _begin(self, frame: MocapFrame) -> None:
        """Take the first pose of a track."""
        self._filter.begin(frame.p_WB, frame.q_WB)
        self._poses = 1
        self._good_us = frame.t_us
        self._refused_in_a_row = 0

    def _fit(self, t_us: int) -> None:
        """Count one more pose that fits those before it."""
        self._poses += 1
        if self._poses < POSES:
            return
        self._tracking = True
        if self._lost_us is not None:
            self.counters.restarts += 1
            self._notices.restarted(t_us, t_us - self._lost_us)

    def _lose(self) -> None:
        if self._tracking:
            self._lost_us = self._good_us
            self._notices.lost(self._t_us)
        self._poses = 0
        self._tracking = False

    def _without_pose(self, frame: MocapFrame, quality: Quality) -> Track:
        """Predict the velocity without a pose: it is missing or wrong, and none is sent."""
        v_WB, w_B = self._filter.leave_out()
        if not self._tracking:
            return _without(frame, quality)
        return Track(replace(frame, valid=False), v_WB, w_B, quality)


def tracker_of(config: TrackerConfig, period_us: int) -> Tracker | None:
    """Return a profile's tracker, None if it has none."""
    return Tracker(config, period_us) if config.enabled else None


def _without(frame: MocapFrame, quality: Quality) -> Track:
    """Return a track without pose and motion."""
    return Track(replace(frame, valid=False), UNKNOWN, UNKNOWN, quality)
