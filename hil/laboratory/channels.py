"""The columns of a flight log: names, units, frames and the source of each value.

Counters are cumulative. `estimate.flap_*` are deviations from the hover angle, as in the filter's state. The log of a
real flight has its ground station's values, NaN before the first: `station_channels`.
"""

from collections.abc import Callable, Sequence
from math import nan
from typing import TYPE_CHECKING, Any

from firmware_py.elementary import cos, sin
from firmware_py.firmware import DEADLINES_US
from firmware_py.logic.plugs import GROUP
from firmware_py.signals import COUNTERS, Signals
from firmware_py.table import whole_names
from firmware_py.wire.telemetry import ATTITUDE, BLOCKS, SLOW_BLOCKS, TIMESTAMP_MASK
from ground_station.latency import STAGES
from ground_station.tracker import Tracker
from ground_station.trajectory import Goal, Trajectory
from hil.board.board_firmware import BoardFirmware
from hil.board.cameras import VirtualMocap
from hil.board.radio import VirtualRadio
from hil.board.uart import VirtualSerial
from hil.laboratory.faults import Fault
from hil.laboratory.robot import Robot
from hil.world.battery import Battery
from hil.world.body import Channel, Quantity

if TYPE_CHECKING:
    from ground_station.links.mavlink import MavlinkLink  # needs pymavlink
    from ground_station.program import StationSession

UNKNOWN = (nan, nan, nan)  # a vector without a measurement
UNKNOWN_STATE = 4  # of the supervisor, beside those of `firmware_py.wire.supervisor`
WRAP = 1 << 16  # the board's counters of poses are uint16
AGE_UNIT_US = 100  # of locSrv.age
LOOP = "loop"  # group of variables of a real board in the loop
MEASUREMENTS = "measurements"  # the queue of poses on board


def quantity(prefix: str, names: str, unit: str = "", frame: str = "") -> Quantity:
    return Quantity(tuple(f"{prefix}.{name}" for name in names.split()), unit, frame)


FLAPS = "flap_1 flap_2 flap_3 flap_4"
STATES = (quantity("flight", "free"), quantity("supervisor", "state"))
TRUTH = (
    quantity("truth", "x y z", "m", "W"),
    quantity("truth", "vx vy vz", "m/s", "W"),
    quantity("truth", "qw qx qy qz", "", "W"),
    quantity("truth", "p q r", "rad/s", "B"),
)
GOAL = (quantity("goal", "x y z", "m", "W"), quantity("goal", "yaw", "rad", "W"))
ESTIMATE = (
    quantity("estimate", "x y z", "m", "G"),
    quantity("estimate", "vx vy vz", "m/s", "G"),
    quantity("estimate", "roll pitch yaw", "rad", "G"),
    quantity("estimate", "p q r", "rad/s", "B"),
)
INPUTS = quantity("control", "u1 u2 u3 u4", "rad")
MOTORS = quantity("motor", "m1 m2 m3 m4", "counts")
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


def radio_channel(radio: VirtualRadio) -> Channel:
    """Return the radio's counters."""
    up, down, air = radio.up, radio.down, radio.air
    names = "up_sent up_delivered up_dropped down_sent down_delivered down_dropped retried unanswered"
    return Channel(
        "int64",
        lambda: (
            up.sent, up.delivered, up.dropped, down.sent, down.delivered, down.dropped,
            air.retried, air.unanswered, up.latency_sum_us, down.latency_sum_us,
        ),
        (quantity("link", names), quantity("link", "up_latency_sum down_latency_sum", "us")),
    )  # fmt: skip


def serial_channel(uart: VirtualSerial, firmware: BoardFirmware, link: "MavlinkLink | None") -> Channel:
    """Return the counters of a serial line with MAVLink; without a `link` the station's frames are unknown and stay 0.

    `link.*` counts chunks of the stream, `serial.*` bytes, bits and frames.
    """
    assert firmware.mavlink is not None
    up, down, board = uart.up, uart.down, firmware.mavlink.counters

    def counts() -> tuple[int, ...]:
        at_station = link.counters if link else None
        return (
            up.deliveries, down.deliveries, up.latency_sum_us, down.latency_sum_us,
            up.busy_us, down.busy_us, up.sent_bytes, down.sent_bytes, up.overrun_bytes,
            up.dropped_bytes + down.dropped_bytes, up.cut_bytes + down.cut_bytes, up.wrong_bits + down.wrong_bits,
            board.bad, board.lost, at_station.bad if at_station else 0, at_station.lost if at_station else 0,
        )  # fmt: skip

    return Channel(
        "int64",
        counts,
        (
            quantity("link", "up_delivered down_delivered"),
            quantity("link", "up_latency_sum down_latency_sum", "us"),
            quantity("serial", "up_busy down_busy", "us"),
            quantity("serial", "up_bytes down_bytes overrun no_room cut", "bytes"),
            quantity("serial", "wrong_bits up_bad up_lost down_bad down_lost"),
        ),
    )


def battery_channel(battery: Battery) -> Channel:
    """Return voltage of a cell, power and charge of the battery."""
    return Channel(
        "float32",
        lambda: (battery.voltage, battery.power, battery.charge),
        (
            quantity("battery", "voltage", "V"),
            quantity("battery", "power", "W"),
            quantity("battery", "charge"),
        ),
    )


def tracker_channel(tracker: Tracker) -> Channel:
    """Return the tracker's outputs."""
    counters = tracker.counters
    return Channel(
        "int32",
        lambda: (tracker.quality, counters.refused, counters.restarts),
        (quantity("tracker", "quality refused restarts"),),
    )


def board_channels(firmware: BoardFirmware) -> tuple[Channel, ...]:
    """Return the user logic's variables, the delays of the loop through a real board, and the board's own time."""
    own = [variable for variable in firmware.variables if variable.name.partition(".")[0] in (GROUP, LOOP)]
    channels = []
    for dtype, is_float in (("float32", True), ("int32", False)):
        chosen = [variable for variable in own if variable.scalar.is_float is is_float]
        quantities = tuple(Quantity((variable.name,), variable.unit) for variable in chosen)
        if chosen:
            channels.append(Channel(dtype, _all([variable.read for variable in chosen]), quantities))
    if firmware.clock_us is not None:
        channels.append(
            Channel("int64", lambda: (firmware.clock_us,), (quantity("clock", "board_us", "us"),))
        )
    return tuple(channels)


def _all(reads: Sequence[Callable[[], float]]) -> Callable[[], list[float]]:
    return lambda: [read() for read in reads]


def excitation_channel(firmware: BoardFirmware) -> Channel:
    """Return the excitation added to the inputs for identification."""
    reads = [variable.read for variable in firmware.variables if variable.name.startswith("excite.")]
    return Channel("float32", _all(reads), (quantity("excite", "u1 u2 u3 u4", "rad"),))


def fault_channel(active: Sequence[Fault]) -> Channel:
    """Return the number of active faults."""
    return Channel("int8", lambda: len(active), (quantity("fault", "active"),))


def marker_channel(mocap: VirtualMocap) -> Channel:
    """Return the markers of the last exposure (bit 0: marker 1), the number of unlabelled points, and the fit's error."""

    def read() -> tuple[float, ...]:
        seen = mocap.sighting
        if seen is None:
            return (0.0, 0.0, 0.0)
        return (seen.bits, len(seen.unlabelled), seen.error)

    return Channel(
        "float32", read, (quantity("markers", "visible unlabelled"), quantity("markers", "error", "m"))
    )


def _view(array: Any) -> Callable[[], Any]:
    return lambda: array


def flight_channels(robot: Robot, trajectory: Trajectory) -> tuple[Channel, ...]:
    """Return the channels of any flight; the recorder adds the first column, `t`."""
    body, board, firmware = robot.body, robot.board, robot.firmware
    imu = Channel("int16", lambda: board.imu, (quantity("imu", "gx gy gz ax ay az", "counts", "S"),))
    return (
        Channel("int8", lambda: (robot.free, firmware.signals.supervisor.state), STATES),
        Channel("float64", _view(body.state), TRUTH),
        *body.channels(),
        *robot.sensors.channels(),
        Channel("float32", _view(body.flow_W), (quantity("flow", "x y z", "m/s", "W"),)),
        Channel("float64", lambda: _coordinates(trajectory.at(board.now_us)), GOAL),
        *(
            _core_channels(firmware.signals, imu)
            if firmware.signals.counters.size
            else _stock_channels(robot, trajectory, imu)
        ),
        *_scheduler_channels(firmware),
    )


def _core_channels(signals: Signals, imu: Channel) -> tuple[Channel, ...]:
    """Return the signals of our flight core, with its samples."""
    counters = (quantity("estimator", " ".join(COUNTERS[:-1])), quantity("estimator", COUNTERS[-1], "us"))
    return (
        Channel("float32", _view(signals.estimate), (*ESTIMATE, quantity("estimate", FLAPS, "rad", "B"))),
        Channel("float32", _view(signals.u), (INPUTS,)),
        Channel("float32", _view(signals.flap), (quantity("control", FLAPS, "rad", "B"),)),
        Channel("int32", _view(signals.count), (MOTORS,)),
        imu,
        Channel("int32", _view(signals.counters), counters),
    )


def _stock_channels(robot: Robot, trajectory: Trajectory, imu: Channel) -> tuple[Channel, ...]:
    """Return the signals of the Crazyflie's own firmware, with its samples; its estimate is converted to G."""
    board, firmware = robot.board, robot.firmware

    def estimate() -> Sequence[float]:
        goal, now = trajectory.at(board.now_us), firmware.signals.estimate.tolist()
        c, s = cos(goal.yaw), sin(goal.yaw)
        x, y, z, vx, vy, vz, roll, pitch, yaw, *rates = now
        dx, dy, dz = x - goal.p_WG[0], y - goal.p_WG[1], z - goal.p_WG[2]
        place = (c * dx + s * dy, c * dy - s * dx, dz)
        return (*place, c * vx + s * vy, c * vy - s * vx, vz, roll, pitch, yaw - goal.yaw, *rates)

    return (
        Channel("float32", estimate, ESTIMATE),
        Channel("int32", lambda: firmware.signals.count, (quantity("motor", "m1 m2 m3 m4"),)),
        imu,
    )


def _coordinates(goal: Goal) -> tuple[float, ...]:
    return (*goal.p_WG, goal.yaw)


def _scheduler_channels(firmware: BoardFirmware) -> tuple[Channel, ...]:
    """Return the scheduler's counters; a real board does not report its tasks."""
    scheduler = firmware.scheduler
    if scheduler is None:
        return ()
    tasks = tuple(scheduler.tasks)
    queues = [queue for queue in scheduler.queues if queue.name == MEASUREMENTS]
    timed = [task for task in tasks if task.name in DEADLINES_US]

    def counts() -> list[int]:
        counts = [sum([queue.high_water for queue in queues]), sum([queue.dropped for queue in queues])]
        counts += [task.deadline_misses for task in timed]
        counts += scheduler.run_times_us()[: len(tasks)]
        return counts

    quantities = (
        quantity("rtos", "measurements_high_water measurements_dropped"),
        quantity("late", " ".join(task.name for task in timed)),
        Quantity(tuple(f"cpu.{task.name}" for task in tasks), "us"),
    )
    return (Channel("int64", counts, quantities),) if tasks else ()


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

    def __init__(self, session: "StationSession", start_us: int) -> None:
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
    session: "StationSession", free: Callable[[], bool], goal: Callable[[], Goal], start_us: int
) -> tuple[Channel, ...]:
    """Return the channels of a flight that only its ground station sees; `start_us` is the log's time 0."""
    view, ground = StationView(session, start_us), session.ground
    tracker = () if ground.tracker is None else (tracker_channel(ground.tracker),)
    return (
        Channel("int8", lambda: (free(), view.state()), STATES),
        Channel("float64", view.cameras, CAMERAS),
        Channel("float64", lambda: _coordinates(goal()), GOAL),
        Channel("float64", view.telemetry, TELEMETRY),
        Channel("int64", view.counts, STATION),
        Channel("float32", view.slow, (quantity("battery", "voltage", "V"), quantity("board", "load", "%"))),
        Channel("float32", view.air, (quantity("link", "quality", "%"), quantity("link", "rssi", "-dBm"))),
        Channel("float64", ground.budget.last, (quantity("age", " ".join(STAGES), "us"),)),
        *tracker,
    )
