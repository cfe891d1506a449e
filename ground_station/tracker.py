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
from firmware_py.geometry import Quaternion, Vector
from ground_station.config import TrackerConfig
from ground_station.mocap import MocapFrame
from ground_station.pose_filter import PoseFilter
from ground_station.unused import Event, Reason, Unused

POSES = 3  # that begin a track
FIT_US = 50_000  # between them, or two and a half frames if that is longer; a later one does not confirm the others
WIDEN_US = 60_000  # refused poses widen the gate only until then, else it would accept them
PLACE = 0.05  # [m] beyond which a pose counts as one of another place, within as one of another orientation
RETURNS = 3  # after which poses alternate
BEGINS: Unused = (Reason.TRACK_BEGINS, ())
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
    event: Event = Event.NONE


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
        self._event = Event.NONE  # with the last frame
        self._stray: tuple[Vector, Quaternion] | None = None  # the last pose that did not fit
        self._returns = 0  # of strays to the place of the one before, in sequence
        self._poses = 0  # that fit one another, up to `POSES`
        self._tracking = False  # there are `POSES` of them
        self._t_us = 0  # of the newest frame
        self._gaps_us: deque[int] = deque(
            maxlen=2
        )  # between the newest frames; the first one's is meaningless
        self._good_us = 0  # of the newest frame accepted by the filter
        self._was_lost = False  # a track, before
        self._refused_in_a_row = 0
        self._widening = max(1, WIDEN_US // period_us)

    def track_frame(self, frame: MocapFrame) -> Track:
        """Return the frame to be used in place of `frame`."""
        self._event = Event.NONE
        track = self._judge_frame(frame)
        track.event = self._event
        self.quality = track.quality
        return track

    def summary(self) -> str:
        """Return a few words on the state."""
        counters = self.counters
        return f"{self.quality.name.lower()} ({counters.refused} refused, {counters.restarts} restarts)"

    @property
    def _patience_us(self) -> int:
        """How old the last good frame may be: the cameras may be slower than the profile has it."""
        if self._tracking:
            return self._config.reacquire_us
        return max(FIT_US, min(5 * min(self._gaps_us, default=0) // 2, self._config.reacquire_us))

    def _judge_frame(self, frame: MocapFrame) -> Track:
        t_us = frame.t_us
        if t_us > self._t_us:
            self._gaps_us.append(t_us - self._t_us)
        if self._poses and abs(t_us - self._good_us) >= self._patience_us:
            self._lose()
        if not self._poses:
            self._t_us = t_us
            if frame.valid:
                self._begin(frame)
            return _without(frame, Quality.NONE, BEGINS if frame.valid else frame.unused)
        elapsed_us = t_us - self._t_us
        if elapsed_us <= 0:
            self.counters.refused += 1
            unused = frame.unused
            if frame.valid:
                late_ms, at_s = -elapsed_us * 1e-3, t_us * 1e-6
                unused = (Reason.LATE, (late_ms,)) if elapsed_us else (Reason.REPEATED, (at_s,))
            return _without(frame, Quality.REFUSED, unused)
        self._t_us = t_us
        steps = 1 if elapsed_us <= self._period_us else round(elapsed_us / self._period_us)
        self._filter.predict(steps, self._refused_in_a_row < self._widening)
        if not frame.valid:
            return self._without_pose(frame, Quality.NONE, frame.unused)
        distance2, angle2, theta = self._filter.deviation(frame.p_WB, frame.q_WB)
        position2, rotation2 = self._filter.variances
        if distance2 > self._gate2 * position2 or angle2 > self._gate2 * rotation2:
            return self._refuse(frame, sqrt(distance2), 2.0 * atan2(sqrt(angle2), 2.0))
        v_WB, w_B = self._filter.update(frame.p_WB, theta)
        self._good_us = t_us
        self._refused_in_a_row = 0
        if not self._tracking:
            self._fit()
            if not self._tracking:
                return _without(frame, Quality.NONE, BEGINS)
        return Track(frame, v_WB, w_B, Quality.TRACKED)

    def _refuse(self, frame: MocapFrame, distance: float, angle: float) -> Track:
        """Return the track without a pose that is this far from the prediction [m, rad]; without a track it begins one."""
        returns = self._refused_in_a_row == 0 and _is_return(frame, self._stray, distance, angle)
        self._returns = self._returns + 1 if returns else 0
        if self._returns < RETURNS:
            reason = Reason.DEVIATES if self._tracking else Reason.SCATTERED
        else:
            reason = Reason.PLACES if distance > PLACE else Reason.ORIENTATIONS
        unused = reason, (distance, degrees(angle))
        if not self._tracking:  # one of them is wrong: start again with the newest
            self._stray = self._filter.pose
            self._begin(frame)
            return _without(frame, Quality.NONE, unused)
        self._stray = frame.p_WB, frame.q_WB
        self.counters.refused += 1
        self._refused_in_a_row += 1
        return self._without_pose(frame, Quality.REFUSED, unused)

    def _begin(self, frame: MocapFrame) -> None:
        """Take the first pose of a track."""
        self._filter.begin(frame.p_WB, frame.q_WB)
        self._poses = 1
        self._good_us = frame.t_us
        self._refused_in_a_row = 0

    def _fit(self) -> None:
        """Count one more pose that fits those before it."""
        self._poses += 1
        if self._poses < POSES:
            return
        self._tracking = True
        if self._was_lost:
            self.counters.restarts += 1
            self._event = Event.RESTARTED

    def _lose(self) -> None:
        if self._tracking:
            self._was_lost = True
            self._event = Event.LOST
        self._poses = 0
        self._tracking = False

    def _without_pose(self, frame: MocapFrame, quality: Quality, unused: Unused) -> Track:
        """Predict the velocity without a pose: it is missing or wrong, and none is sent."""
        v_WB, w_B = self._filter.leave_out()
        if not self._tracking:
            return _without(frame, quality, unused)
        return Track(replace(frame, valid=False, unused=unused), v_WB, w_B, quality)


def tracker_of(config: TrackerConfig, period_us: int) -> Tracker | None:
    """Return a profile's tracker, None if it has none."""
    return Tracker(config, period_us) if config.enabled else None


def _without(frame: MocapFrame, quality: Quality, unused: Unused) -> Track:
    """Return a track without pose and motion."""
    return Track(replace(frame, valid=False, unused=unused), UNKNOWN, UNKNOWN, quality)


def _is_return(
    frame: MocapFrame, stray: tuple[Vector, Quaternion] | None, distance: float, angle: float
) -> bool:
    """Return whether a pose that does not fit is much nearer to the one before that did not fit."""
    if stray is None:
        return False
    p, q = stray
    if distance > PLACE:
        return sqrt(sum((a - b) * (a - b) for a, b in zip(frame.p_WB, p, strict=True))) < 0.5 * distance
    cosine = min(1.0, abs(sum(a * b for a, b in zip(frame.q_WB, q, strict=True))))
    return 2.0 * atan2(sqrt(1.0 - cosine * cosine), cosine) < 0.5 * angle
