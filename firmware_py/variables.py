"""The log variables of the firmware: names as on the Crazyflie and on the original Floaty, values from the running core.

Units are Floaty's (angles in rad) except where Crazyflie's own programs read: attitudes in `stateEstimate` and `stabilizer`
are in degrees with the nose up positive, `gyro` and `acc` in deg/s and g. Position, velocity and yaw are in the frame
of the poses: the goal frame for corrections, because the board knows only its error; the cameras' for absolute poses.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterator
from functools import partial
from math import degrees

from firmware_py.core_runner import CoreBlocks
from firmware_py.drivers.imu import acceleration, rates
from firmware_py.links.log import LogVariable
from firmware_py.rtos.statistics import ProcessorLoad
from firmware_py.running import Running
from firmware_py.table import CORE_VARIABLES, CoreVariable
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.telemetry import LEGACY_DEGREES

# Of a cell at rest, 0 to 90 % (LiPoTypicalChargeCurve in pm_stm32f4.c).
CHARGE_CURVE_MV = (3000, 3780, 3830, 3870, 3890, 3920, 3960, 4000, 4040, 4100)
# The least time over which the processor's load is averaged.
LOAD_US = 100_000
PM_BATTERY, PM_LOW = 0, 3  # pm.state

F32, U8, I8, U16, I16, U32 = Scalar.F32, Scalar.U8, Scalar.I8, Scalar.U16, Scalar.I16, Scalar.U32


def log_variables(running: Running) -> tuple[LogVariable, ...]:
    """Return the table, in the order of the log TOC."""
    core, crazyflie = running.core, running.pilot.stabilizer.supervisor
    control = core.control.fields
    own = () if core.logic is None else core.logic.loaded.variables
    return (
        *(_declared(core, variable) for variable in (*CORE_VARIABLES, *own)),
        *_parts("stateEstimate", "roll pitch yaw", "deg", partial(_legacy_angle, running)),
        *_crazyflie(running),
        LogVariable("motors_ctrp.min_angle", F32, "rad", lambda: control.flap.min()),
        LogVariable("motors_ctrp.max_angle", F32, "rad", lambda: control.flap.max()),
        LogVariable("supervisor.info", U16, "", running.platform.bits),
        LogVariable("sys.canfly", U8, "", partial(getattr, crazyflie, "can_fly")),
        LogVariable("sys.isFlying", U8, "", partial(getattr, crazyflie, "flying")),
        LogVariable("sys.isTumbled", U8, "", partial(getattr, crazyflie, "tumbled")),
        *_counters(running),
    )


def _declared(core: CoreBlocks, variable: CoreVariable) -> LogVariable:
    place = variable.place
    read = partial(core.named[place.block].memory[place.field].item, 0, *place.index)
    return LogVariable(variable.name, variable.scalar, variable.unit, read)


def _fields(group: str, names: str, counters: object) -> Iterator[LogVariable]:
    """Name counters by their own names."""
    for name in names.split():
        yield LogVariable(f"{group}.{name}", U32, "", partial(getattr, counters, name))


def _parts(group: str, names: str, unit: str, read: Callable[[int], float]) -> Iterator[LogVariable]:
    """Name the parts of a vector that are computed on demand, each by its index."""
    for index, name in enumerate(names.split()):
        yield LogVariable(f"{group}.{name}", F32, unit, partial(read, index))


def _legacy_angle(running: Running, axis: int) -> float:
    return LEGACY_DEGREES[axis] * running.core.report.fields.attitude.item(axis)


def _crazyflie(running: Running) -> Iterator[LogVariable]:
    """Yield variables that only the Crazyflie's own programs read."""
    board, bias = running.board, running.core.data.fields.gyro_bias
    parameters = running.core.parameters.fields

    def rate(axis: int) -> float:
        return degrees(rates(board.imu.tolist(), bias.tolist())[axis])

    def battery_level() -> float:
        return 10 * min(9, bisect_left(CHARGE_CURVE_MV, board.read_battery_mv()))

    def battery_state() -> float:
        return PM_LOW if board.read_battery_mv() < parameters.low_battery_mv else PM_BATTERY

    yield from _parts("stabilizer", "roll pitch yaw", "deg", partial(_legacy_angle, running))
    yield LogVariable("stabilizer.thrust", F32, "", lambda: 0.0)
    yield from _parts("gyro", "x y z", "deg/s", rate)
    yield from _parts("acc", "x y z", "g", lambda axis: acceleration(board.imu.tolist())[axis])
    yield LogVariable("pm.vbat", F32, "V", lambda: board.read_battery_mv() * 1e-3)
    yield LogVariable("pm.vbatMV", U16, "mV", board.read_battery_mv)
    yield LogVariable("pm.state", I8, "", battery_state)
    yield LogVariable("pm.batteryLevel", U8, "%", battery_level)


def _counters(running: Running) -> Iterator[LogVariable]:
    """Yield counts of losses, and the load of the processor."""
    yield from _fields("crtp", "malformed unserved dropped", running.stack)
    if running.mavlink is not None:
        yield from _fields("mavlink", "frames lost bad", running.mavlink.counters)
        yield from _fields("mavlink", "refused dropped overruns", running.mavlink)
    load = ProcessorLoad(running.stack.kernel, LOAD_US)
    yield LogVariable("system.load", F32, "%", lambda: 100 * load())
    yield LogVariable("sensors.dropped", U32, "", partial(getattr, running.measurements, "dropped"))
    yield LogVariable("app.overflows", U32, "", partial(getattr, running.platform, "app_overflows"))
    yield LogVariable("memTst.errCntW", U32, "", partial(getattr, running.tester, "errors"))
