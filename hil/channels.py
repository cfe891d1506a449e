"""What a flight log holds: names, units, frames and where each value comes from.

Counters are cumulative. `estimate.flap_*` are deviations from the hover angle, like in the filter's state.
"""

from collections.abc import Callable
from typing import Any

from firmware_py.firmware import DEADLINES_US, Firmware
from firmware_py.signals import COUNTERS
from ground_station.trajectory import Trajectory
from hil.plant.plant import Plant
from hil.recorder import Channel, Quantity
from hil.virtual_board import VirtualBoard
from hil.virtual_radio import VirtualRadio


def _of(prefix: str, names: str, unit: str = "", frame: str = "") -> Quantity:
    return Quantity(tuple(f"{prefix}.{name}" for name in names.split()), unit, frame)


def _view(array: Any) -> Callable[[], Any]:
    return lambda: array


def flight_channels(
    plant: Plant,
    board: VirtualBoard,
    firmware: Firmware,
    radio: VirtualRadio,
    trajectory: Trajectory,
    free: Callable[[], bool],
) -> tuple[Channel, ...]:
    """Return the channels of a flight; the first column, `t`, is the recorder's own."""
    signals, queue = firmware.signals, firmware.measurements
    kernel = firmware.kernel
    tasks = kernel.tasks
    timed = [task for task in tasks if task.name in DEADLINES_US]
    up, down, air = radio.up, radio.down, radio.air

    def goal() -> tuple[float, ...]:
        at = trajectory.at(board.now_us)
        return (*at.p_WG, at.yaw)

    def counts() -> tuple[int, ...]:
        return (
            up.sent, up.delivered, up.dropped, down.sent, down.delivered, down.dropped,
            air.retried, air.unanswered, up.latency_sum_us, down.latency_sum_us, queue.high_water, queue.dropped,
            *[task.deadline_misses for task in timed], *[kernel.run_time_us(task) for task in tasks],
        )  # fmt: skip

    flaps = "flap_1 flap_2 flap_3 flap_4"
    forces = " ".join(
        f"{part}_{axis}" for part in ("base", "flap1", "flap2", "flap3", "flap4") for axis in "xyz"
    )
    return (
        Channel(
            "int8",
            lambda: (free(), signals.supervisor.state),
            (_of("flight", "free"), _of("supervisor", "state")),
        ),
        Channel(
            "float64",
            _view(plant.state),
            (
                _of("truth", "x y z", "m", "W"),
                _of("truth", "vx vy vz", "m/s", "W"),
                _of("truth", "qw qx qy qz", "", "W"),
                _of("truth", "p q r", "rad/s", "B"),
                _of("truth", flaps, "rad", "B"),
            ),
        ),
        Channel("float32", _view(plant.plate_forces_W.reshape(15)), (_of("force", forces, "N", "W"),)),
        Channel("float32", _view(plant.flow_W), (_of("flow", "x y z", "m/s", "W"),)),
        Channel("float64", goal, (_of("goal", "x y z", "m", "W"), _of("goal", "yaw", "rad", "W"))),
        Channel(
            "float32",
            _view(signals.estimate),
            (
                _of("estimate", "x y z", "m", "G"),
                _of("estimate", "vx vy vz", "m/s", "G"),
                _of("estimate", "roll pitch yaw", "rad", "G"),
                _of("estimate", "p q r", "rad/s", "B"),
                _of("estimate", flaps, "rad", "B"),
            ),
        ),
        Channel("float32", _view(signals.u), (_of("control", "u1 u2 u3 u4", "rad"),)),
        Channel("float32", _view(signals.flap), (_of("control", flaps, "rad", "B"),)),
        Channel("int32", _view(signals.count), (_of("motor", "m1 m2 m3 m4", "counts"),)),
        Channel("int16", lambda: board.imu, (_of("imu", "gx gy gz ax ay az", "counts", "S"),)),
        Channel(
            "int32",
            _view(signals.counters),
            (_of("estimator", " ".join(COUNTERS[:-1])), _of("estimator", COUNTERS[-1], "us")),
        ),
        Channel(
            "int64",
            counts,
            (
                _of(
                    "link",
                    "up_sent up_delivered up_dropped down_sent down_delivered down_dropped retried unanswered",
                ),
                _of("link", "up_latency_sum down_latency_sum", "us"),
                _of("rtos", "measurements_high_water measurements_dropped"),
                _of("late", " ".join(task.name for task in timed)),
                Quantity(tuple(f"cpu.{task.name}" for task in tasks), "us"),
            ),
        ),
    )
