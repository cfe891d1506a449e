"""The columns of a real flight's log: what its ground station sees; NaN before the first value of each."""

from collections.abc import Callable
from math import nan

from firmware_py.table import whole_names
from firmware_py.wire.telemetry import ATTITUDE, BLOCKS, SLOW_BLOCKS, TIMESTAMP_MASK
from ground_station.latency import STAGES
from ground_station.program import StationSession
from ground_station.trajectory import Goal
from hil.laboratory.channels import (
    ESTIMATE,
    FLAPS,
    GOAL,
    INPUTS,
    MOTORS,
    STATES,
    coordinates,
    quantity,
    tracker_channel,
)
from hil.world.body import Channel

UNKNOWN = (nan, nan, nan)  # a vector without a measurement
UNKNOWN_STATE = 4  # of the supervisor, beside those of `firmware_py.wire.supervisor`
WRAP = 1 << 16  # the board's counters of poses are uint16
AGE_UNIT_US = 100  # of locSrv.age
CAMERAS = (
    quantity("cameras", "exposed", "us"),
    quantity("cameras", "x y z", "m", "W"),
    quantity("cameras", "qw qx qy qz", "", "W"),
    quantity("cameras", "vx vy vz", "m/s", "W"),
    quantity("cameras", "p q r", "rad/s", "B"),
)
TELEMETRY = (
    *ESTIMATE,
    quantity("telemetry", FLAPS, "rad", "B"),
    MOTORS,
    INPUTS,
    quantity("estimator", "pose_age_us", "us"),
    quantity("estimator", "poses rejected"),
)
# The log variables of these columns, in their order.
REPORTED = [
    name
    for listed in (
        "stateEstimate.x y z vx vy vz roll pitch yaw roll_rate pitch_rate yaw_rate flap_1 flap_2 flap_3 flap_4",
        "motor.m1 m2 m3 m4", "controller.u1 u2 u3 u4", "locSrv.age poses rejected",
    )
    for name in whole_names(listed)
]  # fmt: skip
STATION = (
    quantity("link", "sent late"),
    quantity("station", "frames unusable samples malformed"),
    quantity("link", "latency", "us"),
)


class Unwrapped:
    """A 16-bit counter of the board, relative to its first value, on a clock in ms that wraps as well.

    A clock that went back was reset, and the counter with it: it counts from 0 again.
    """

    def __init__(self) -> None:
        self._last: tuple[float, int] | None = None
        self._total = 0.0

    def __call__(self, value: float, clock_ms: int) -> float:
        if self._last is not None:
            before, before_ms = self._last
            reset = clock_ms - before_ms & TIMESTAMP_MASK > TIMESTAMP_MASK // 2
            self._total += value if reset else (value - before) % WRAP
        self._last = value, clock_ms
        return self._total


class StationView:
    """A ground station's current values as rows of a log; `start_us` is the log's time 0."""

    def __init__(self, session: StationSession, start_us: int) -> None:
        self._link, self._ground, self._start_us = session.link, session.ground, start_us
        self._poses, self._rejected = Unwrapped(), Unwrapped()

    def state(self) -> int:
        """Return the supervisor's state."""
        state = self._link.supervisor_state
        return UNKNOWN_STATE if state is None else state

    def cameras(self) -> tuple[float, ...] | float:
        """Return CAMERAS, with the velocities of the tracker."""
        frame, track = self._ground.frame, self._ground.track
        if frame is None:
            return nan
        v_WB, w_B = (UNKNOWN, UNKNOWN) if track is None else (track.v_WB, track.w_B)
        return (frame.t_us - self._start_us, *frame.p_WB, *frame.q_WB, *v_WB, *w_B)

    def telemetry(self) -> tuple[float, ...] | float:
        """Return TELEMETRY once every block has a sample."""
        newest = self._ground.telemetry
        if any(block.id not in newest for block in BLOCKS):
            return nan
        reported = {
            variable.name: value
            for block in BLOCKS
            for variable, value in zip(block.variables, newest[block.id].values, strict=True)
        }
        *measured, age, poses, rejected = (reported[name] for name in REPORTED)
        clock_ms = newest[ATTITUDE.id].timestamp_ms
        counts = self._poses(poses, clock_ms), self._rejected(rejected, clock_ms)
        return (*measured, AGE_UNIT_US * age, *counts)

    def slow(self) -> tuple[float, ...]:
        """Battery and load."""
        samples = [self._ground.telemetry.get(block.id) for block in SLOW_BLOCKS]
        return tuple(nan if sample is None else sample.values[0] for sample in samples)

    def counts(self) -> tuple[float, ...]:
        """STATION."""
        link, counters = self._link, self._ground.counters
        return (
            link.sent, link.late, counters.frames, counters.invalid, counters.samples, counters.malformed,
            link.latency.us,
        )  # fmt: skip

    def air(self) -> tuple[float, ...]:
        """Quality and signal strength of the radio."""
        return (self._link.quality, self._link.rssi)


def station_channels(
    session: StationSession, free: Callable[[], bool], goal: Callable[[], Goal], start_us: int
) -> tuple[Channel, ...]:
    """Return the channels of a flight that only its ground station sees; `start_us` is the log's time 0."""
    view, ground = StationView(session, start_us), session.ground
    tracker = () if ground.tracker is None else (tracker_channel(ground.tracker),)
    return (
        Channel("int8", lambda: (free(), view.state()), STATES),
        Channel("float64", view.cameras, CAMERAS),
        Channel("float64", lambda: coordinates(goal()), GOAL),
        Channel("float64", view.telemetry, TELEMETRY),
        Channel("int64", view.counts, STATION),
        Channel("float32", view.slow, (quantity("battery", "voltage", "V"), quantity("board", "load", "%"))),
        Channel("float32", view.air, (quantity("link", "quality", "%"), quantity("link", "rssi", "-dBm"))),
        Channel("float64", ground.budget.last, (quantity("age", " ".join(STAGES), "us"),)),
        *tracker,
    )
