"""What a flight log holds: names, units, frames and where each value comes from.

Counters are cumulative. `estimate.flap_*` are deviations from the hover angle, like in the filter's state. Of a real flight
there is what its ground station knows, NaN before that is anything: `station_channels`.
"""

from collections.abc import Callable, Sequence
from math import nan
from typing import Any

from firmware_py.firmware import DEADLINES_US, Firmware
from firmware_py.logic.plugs import GROUP
from firmware_py.signals import COUNTERS
from firmware_py.wire.telemetry import BLOCKS, SLOW_BLOCKS
from ground_station.latency import STAGES
from ground_station.program import Cockpit
from ground_station.tracker import Tracker
from ground_station.trajectory import Goal, Trajectory
from hil.devices.cameras import VirtualMocap
from hil.devices.radio import VirtualRadio
from hil.devices.real_firmware import RealFirmware
from hil.devices.stm32f405.firmware import ImageFirmware
from hil.laboratory.faults import Fault
from hil.laboratory.recorder import Channel, Quantity
from hil.laboratory.robot import Robot
from hil.world.battery import Battery

UNKNOWN_STATE = 4  # of the supervisor, beside those of `firmware_py.wire.supervisor`
WRAP = 1 << 16  # the board's counters of poses are uint16
AGE_UNIT_US = 100  # of locSrv.age


def quantity(prefix: str, names: str, unit: str = "", frame: str = "") -> Quantity:
    return Quantity(tuple(f"{prefix}.{name}" for name in names.split()), unit, frame)


def radio_channel(radio: VirtualRadio) -> Channel:
    """Return what the radio counts."""
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


def loop_channel(firmware: RealFirmware) -> Channel:
    """Return what the loop through a real board costs and counts."""

    def read() -> tuple[int, ...]:
        told = firmware.told
        counted = (0, 0, 0, 0) if told is None else (told.waiting, told.late, told.lost, told.doubled)
        return (firmware.delay_us, firmware.added_us, *counted)

    return Channel(
        "int32", read, (quantity("loop", "delay added", "us"), quantity("loop", "waiting late lost doubled"))
    )


def tracker_channel(tracker: Tracker) -> Channel:
    """Return what the tracker makes of frames."""
    counters = tracker.counters
    return Channel(
        "int32",
        lambda: (tracker.quality, counters.refused, counters.restarts),
        (quantity("tracker", "quality refused restarts"),),
    )


def logic_channels(firmware: Firmware | ImageFirmware | RealFirmware) -> tuple[Channel, ...]:
    """Return what logic of the user's own logs."""
    own = [variable for variable in firmware.variables if variable.name.startswith(f"{GROUP}.")]
    channels = []
    for dtype, is_float in (("float32", True), ("int32", False)):
        chosen = [variable for variable in own if variable.scalar.is_float is is_float]
        quantities = tuple(Quantity((variable.name,), variable.unit) for variable in chosen)
        if chosen:
            channels.append(Channel(dtype, _all([variable.read for variable in chosen]), quantities))
    return tuple(channels)


def _all(reads: Sequence[Callable[[], float]]) -> Callable[[], list[float]]:
    return lambda: [read() for read in reads]


def excitation_channel(firmware: Firmware | ImageFirmware | RealFirmware) -> Channel:
    """Return what is added to the inputs for identification."""
    reads = [variable.read for variable in firmware.variables if variable.name.startswith("excite.")]
    return Channel("float32", _all(reads), (quantity("excite", "u1 u2 u3 u4", "rad"),))


def fault_channel(active: Sequence[Fault]) -> Channel:
    """Return how many faults are in force."""
    return Channel("int8", lambda: len(active), (quantity("fault", "active"),))


def marker_channel(mocap: VirtualMocap) -> Channel:
    """Return which markers the last exposure saw (bit 0: marker 1), how many points have no label, how well all fit."""

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
    """Return the channels of any flight; the first column, `t`, is the recorder's own."""
    plant, board, firmware = robot.plant, robot.board, robot.firmware
    signals, queue = firmware.signals, firmware.measurements
    kernel: Any = firmware.kernel  # ours or an image's, whose tasks have names and run times alike
    tasks = tuple(kernel.tasks)
    timed = [task for task in tasks if task.name in DEADLINES_US]

    def goal() -> tuple[float, ...]:
        at = trajectory.at(board.now_us)
        return (*at.p_WG, at.yaw)

    def counts() -> tuple[int, ...]:
        return (
            queue.high_water, queue.dropped,
            *[task.deadline_misses for task in timed], *kernel.run_times_us()[: len(tasks)],
        )  # fmt: skip

    scheduler = () if not tasks else (  # a real board does not tell what its tasks do
        Channel(
            "int64", counts, (
                quantity("rtos", "measurements_high_water measurements_dropped"),
                quantity("late", " ".join(task.name for task in timed)),
                Quantity(tuple(f"cpu.{task.name}" for task in tasks), "us"),
            ),
        ),
    )  # fmt: skip
    flaps = "flap_1 flap_2 flap_3 flap_4"
    forces = " ".join(
        f"{part}_{axis}" for part in ("base", "flap1", "flap2", "flap3", "flap4") for axis in "xyz"
    )
    return (
        Channel(
            "int8",
            lambda: (robot.free, signals.supervisor.state),
            (quantity("flight", "free"), quantity("supervisor", "state")),
        ),
        Channel(
            "float64",
            _view(plant.state),
            (
                quantity("truth", "x y z", "m", "W"),
                quantity("truth", "vx vy vz", "m/s", "W"),
                quantity("truth", "qw qx qy qz", "", "W"),
                quantity("truth", "p q r", "rad/s", "B"),
                quantity("truth", flaps, "rad", "B"),
            ),
        ),
        Channel("float32", _view(plant.plate_forces_W.reshape(15)), (quantity("force", forces, "N", "W"),)),
        Channel("float32", _view(plant.flow_W), (quantity("flow", "x y z", "m/s", "W"),)),
        Channel("float64", goal, (quantity("goal", "x y z", "m", "W"), quantity("goal", "yaw", "rad", "W"))),
        Channel(
            "float32",
            _view(signals.estimate),
            (
                quantity("estimate", "x y z", "m", "G"),
                quantity("estimate", "vx vy vz", "m/s", "G"),
                quantity("estimate", "roll pitch yaw", "rad", "G"),
                quantity("estimate", "p q r", "rad/s", "B"),
                quantity("estimate", flaps, "rad", "B"),
            ),
        ),
        Channel("float32", _view(signals.u), (quantity("control", "u1 u2 u3 u4", "rad"),)),
        Channel("float32", _view(signals.flap), (quantity("control", flaps, "rad", "B"),)),
        Channel("int32", _view(signals.count), (quantity("motor", "m1 m2 m3 m4", "counts"),)),
        Channel("int16", lambda: board.imu, (quantity("imu", "gx gy gz ax ay az", "counts", "S"),)),
        Channel(
            "int32",
            _view(signals.counters),
            (quantity("estimator", " ".join(COUNTERS[:-1])), quantity("estimator", COUNTERS[-1], "us")),
        ),
        *scheduler,
    )


class Unwrapped:
    """A counter of 16 bits that goes on where they end; from its first value on, which is NaN before."""

    def __init__(self) -> None:
        self._last = self._total = nan

    def __call__(self, value: float) -> float:
        step = (value - self._last) % WRAP
        self._total = 0.0 if self._total != self._total else self._total + step
        self._last = value
        return self._total


def station_channels(
    cockpit: Cockpit, free: Callable[[], bool], goal: Callable[[], Goal], start_us: int
) -> tuple[Channel, ...]:
    """Return the channels of a flight that only its ground station sees; `start_us` is when the log's time began."""
    link, ground = cockpit.link, cockpit.ground
    count_poses, count_rejected = Unwrapped(), Unwrapped()

    def states() -> tuple[float, ...]:
        state = link.supervisor_state
        return (free(), UNKNOWN_STATE if state is None else state)

    def cameras() -> tuple[float, ...]:
        frame, track = ground.frame, ground.track
        if frame is None:
            return (nan,) * 14
        motion = (nan,) * 6 if track is None else (*track.v_WB, *track.w_B)
        return (frame.t_us - start_us, *frame.p_WB, *frame.q_WB, *motion)

    def where_to() -> tuple[float, ...]:
        at = goal()
        return (*at.p_WG, at.yaw)

    def telemetry() -> tuple[float, ...]:
        samples = [ground.telemetry.get(block.id) for block in BLOCKS]
        if None in samples:
            return (nan,) * 27
        motion, attitude, flaps, health = (sample.values for sample in samples if sample is not None)
        *inputs, _, age, poses, rejected = health
        told = (AGE_UNIT_US * age, count_poses(poses), count_rejected(rejected))
        return (*motion, *attitude, *flaps, *inputs, *told)

    def slow() -> tuple[float, ...]:
        samples = [ground.telemetry.get(block.id) for block in SLOW_BLOCKS]
        return tuple(nan if sample is None else sample.values[0] for sample in samples)

    def counts() -> tuple[float, ...]:
        counters = ground.counters
        return (
            link.sent, link.late, counters.frames, counters.invalid, counters.samples, counters.malformed,
            link.latency.us,
        )  # fmt: skip

    def air() -> tuple[float, ...]:
        return (link.quality, link.rssi)

    tracker = () if ground.tracker is None else (tracker_channel(ground.tracker),)
    return (
        Channel("int8", states, (quantity("flight", "free"), quantity("supervisor", "state"))),
        Channel(
            "float64",
            cameras,
            (
                quantity("cameras", "exposed", "us"),
                quantity("cameras", "x y z", "m", "W"),
                quantity("cameras", "qw qx qy qz", "", "W"),
                quantity("cameras", "vx vy vz", "m/s", "W"),
                quantity("cameras", "p q r", "rad/s", "B"),
            ),
        ),
        Channel(
            "float64", where_to, (quantity("goal", "x y z", "m", "W"), quantity("goal", "yaw", "rad", "W"))
        ),
        Channel(
            "float64",
            telemetry,
            (
                quantity("estimate", "x y z", "m", "G"),
                quantity("estimate", "vx vy vz", "m/s", "G"),
                quantity("estimate", "roll pitch yaw", "rad", "G"),
                quantity("estimate", "p q r", "rad/s", "B"),
                quantity("telemetry", "flap_1 flap_2 flap_3 flap_4", "rad", "B"),
                quantity("motor", "m1 m2 m3 m4", "counts"),
                quantity("control", "u1 u2 u3 u4", "rad"),
                quantity("estimator", "pose_age_us", "us"),
                quantity("estimator", "poses rejected"),
            ),
        ),
        Channel(
            "int64",
            counts,
            (
                quantity("link", "sent late"),
                quantity("station", "frames unusable samples malformed"),
                quantity("link", "latency", "us"),
            ),
        ),
        Channel("float32", slow, (quantity("battery", "voltage", "V"), quantity("board", "load", "%"))),
        Channel("float32", air, (quantity("link", "quality", "%"), quantity("link", "rssi", "-dBm"))),
        Channel("float64", ground.budget.last, (quantity("age", " ".join(STAGES), "us"),)),
        *tracker,
    )
