"""The columns of a flight log: names, units, frames and the source of each value.

Counters are cumulative. `estimate.flap_*` are deviations from the hover angle, as in the filter's state.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from firmware_py.elementary import cos, sin
from firmware_py.firmware import DEADLINES_US
from firmware_py.logic.plugs import GROUP
from firmware_py.signals import COUNTERS, Signals
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


def flight_channels(
    robot: Robot,
    trajectory: Trajectory,
    line: Sequence[Channel],
    ground: Sequence[Channel] = (),
    more: Sequence[Channel] = (),
) -> tuple[Channel, ...]:
    """Return the channels of a robot, its line and its ground station; the recorder adds the first column, `t`."""
    body, board, firmware = robot.body, robot.board, robot.firmware
    imu = Channel("int16", lambda: board.imu, (quantity("imu", "gx gy gz ax ay az", "counts", "S"),))
    return (
        Channel("int8", lambda: (robot.free, firmware.signals.supervisor.state), STATES),
        Channel("float64", _view(body.state), TRUTH),
        *body.channels(),
        *robot.sensors.channels(),
        Channel("float32", _view(body.flow_W), (quantity("flow", "x y z", "m/s", "W"),)),
        Channel("float64", lambda: coordinates(trajectory.at(board.now_us)), GOAL),
        *(
            _core_channels(firmware.signals, imu)
            if firmware.signals.counters.size
            else _stock_channels(robot, trajectory, imu)
        ),
        *_scheduler_channels(firmware),
        *line,
        battery_channel(robot.battery),
        *ground,
        *((marker_channel(robot.mocap),) if robot.mocap.markers else ()),
        *more,
        *board_channels(firmware),
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


def coordinates(goal: Goal) -> tuple[float, ...]:
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
