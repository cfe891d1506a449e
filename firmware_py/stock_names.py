"""Names of the stock Crazyflie firmware that its clients use, beside those for which Floaty has a quantity of its own.

They are live where the board has the quantity. The rest belongs to hardware or controllers that Floaty lacks: as on a
Crazyflie without that deck, or with another controller in charge, the values are there, can be set and stored, and do
nothing. `tests/vectors/stock_names.json` holds the clients' list with the types of crazyflie-firmware 2a18fc29.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from math import degrees

from firmware_py.core.subset import Logged
from firmware_py.geometry import Vector, rotate, yaw_quaternion
from firmware_py.links.log import LogVariable
from firmware_py.links.parameters import Parameter
from firmware_py.running import Running
from firmware_py.table import whole_names
from firmware_py.variables import F32, I8, U8, U16, U32
from firmware_py.wire.scalars import Scalar

SIGNAL_DBM = 40  # radio.rssi: below 0 dBm, what the virtual radio chip measures
INTEGER_LIMITS = {U8: 0xFF, U16: 0xFFFF, U32: 0xFFFFFFFF}
FLOAT_LIMIT = 1e6
VELOCITY_LIMITS = (0.01, 10.0)  # [m/s]


RESTING = (  # log variables that stay zero
    Logged("deg", "controller.roll pitch"),  # Floaty's controller wants the body level
    Logged("deg/s", "controller.rollRate pitchRate yawRate"),
    Logged("m/s", "posCtl.targetVX targetVY targetVZ"),
    Logged("", "health.motorPass", type="U8"),  # no propellers: never tested
    Logged("V", "health.batterySag"),
    Logged("%", "colorLedBot.throttlePct", type="U8"),
    Logged("%", "colorLedTop.throttlePct", type="U8"),
    Logged("", "lighthouse.bsActive bsAvailable bsCalCon bsCalUd bsCalVal bsGeoVal bsReceive", type="U16"),
    Logged("", "lighthouse.status", type="U8"),  # no base stations
    Logged("", "loco.mode", type="U8"),
    Logged("", "motion.deltaX deltaY", type="I16"),
    Logged("mm", "range.back front left right up zrange", type="U16"),
    Logged("m", "ranging." + " ".join(f"distance{anchor}" for anchor in range(8))),
    Logged("s", "ring.fadeTime"),
    Logged("m", "locSrv.x y z"),  # of the service that the app replaces
    Logged("", "locSrv.qw qx qy qz"),
)


@dataclass(frozen=True, slots=True)
class InertGroup:
    """Parameters of one group that are stored and have no effect, with the stock defaults."""

    names: str  # "group.one two three"
    scalar: Scalar
    defaults: tuple[float, ...]
    persistent: bool = False
    unit: str = ""


SETTINGS = (
    InertGroup("activeMarker.back", U8, (3,), True),
    InertGroup("colorLedBot.brightCorr", U8, (1,)),
    InertGroup("colorLedBot.wrgb8888", U32, (0,)),
    InertGroup("colorLedTop.brightCorr", U8, (1,)),
    InertGroup("colorLedTop.wrgb8888", U32, (0,)),
    InertGroup("commander.enHighLevel", U8, (0,)),  # without effect on the stock board, too
    InertGroup("flightmode.althold", U8, (0,)),
    InertGroup("kalman.initialX initialY initialZ", F32, (0, 0, 0), unit="m"),  # the next pose decides
    InertGroup("kalman.initialYaw", F32, (0,), unit="rad"),
    InertGroup("led.bitmask", U8, (0,)),
    InertGroup("led_deck_ctrl.rgb888", U32, (0,)),
    InertGroup("lighthouse.bsCalibReset", U8, (0,)),
    InertGroup("lighthouse.systemType", U8, (2,)),
    InertGroup("locSrv.enLhAngleStream", U8, (0,)),
    InertGroup("loco.mode", U8, (0,)),
    InertGroup("pid_attitude.roll_kp roll_ki roll_kd", F32, (6, 3, 0), True),
    InertGroup("pid_attitude.pitch_kp pitch_ki pitch_kd", F32, (6, 3, 0), True),
    InertGroup("pid_attitude.yaw_kp yaw_ki yaw_kd", F32, (6, 1, 0.35), True),
    InertGroup("pid_rate.roll_kp roll_ki roll_kd", F32, (250, 500, 2.5), True),
    InertGroup("pid_rate.pitch_kp pitch_ki pitch_kd", F32, (250, 500, 2.5), True),
    InertGroup("pid_rate.yaw_kp yaw_ki yaw_kd", F32, (120, 16.7, 0), True),
    InertGroup("posCtlPid.xKp xKi xKd", F32, (2, 0, 0), True),
    InertGroup("posCtlPid.yKp yKi yKd", F32, (2, 0, 0), True),
    InertGroup("posCtlPid.zKp zKi zKd", F32, (2, 0.5, 0), True),
    InertGroup("posCtlPid.thrustBase", U16, (36000,), True),
    InertGroup("velCtlPid.vxKp vxKi vxKd vxKFF", F32, (25, 1, 0, 0), True),
    InertGroup("velCtlPid.vyKp vyKi vyKd vyKFF", F32, (25, 1, 0, 0), True),
    InertGroup("velCtlPid.vzKp vzKi vzKd", F32, (25, 15, 0), True),
    InertGroup("ring.effect", U8, (6,), True),
    InertGroup("ring.fadeColor", U32, (0,)),
    InertGroup("ring.fadeTime", F32, (0.5,), unit="s"),
    InertGroup("ring.headlightEnable", U8, (0,)),
    InertGroup("ring.solidRed solidGreen solidBlue", U8, (20, 20, 20)),
    InertGroup("sound.effect", U8, (0,), True),
    InertGroup("stabilizer.estimator", U8, (2,)),  # whatever its value, Floaty's own estimator runs
    InertGroup("stabilizer.controller", U8, (0,)),  # and controls
    InertGroup("tdoaEngine.logId logOthrId", U8, (0, 0)),
)


def stock_variables(running: Running) -> Iterator[LogVariable]:
    stack, supervisor, core = running.stack, running.supervisor, running.core
    parameters = core.parameters.fields

    def along(axis: int) -> float:
        """Return the target in the axes of the poses."""
        return _target(running)[0][axis]

    def across(axis: int) -> float:
        """Return the target in axes that turn with the body's yaw."""
        return rotate(yaw_quaternion(-running.core.report.fields.attitude.item(2)), _target(running)[0])[axis]

    for axis, name in enumerate("xyz"):
        yield LogVariable(f"ctrltarget.{name}", F32, "m", partial(along, axis))
        yield LogVariable(f"posCtl.target{name.upper()}", F32, "m", partial(across, axis))
    yield LogVariable("controller.yaw", F32, "deg", lambda: degrees(_target(running)[1]))
    yield LogVariable("radio.isConnected", U8, "", lambda: stack.connected)
    yield LogVariable("radio.numRxUc", U16, "", lambda: stack.unicasts & 0xFFFF)
    yield LogVariable("radio.numRxBc", U16, "", lambda: stack.broadcasts & 0xFFFF)
    yield LogVariable(
        "health.batteryPass", U8, "", lambda: supervisor.battery_mv >= int(parameters.low_battery_mv)
    )
    yield LogVariable("sys.testLogParam", I8, "", lambda: running.stock.test_value)
    yield LogVariable("radio.rssi", U8, "dBm", lambda: SIGNAL_DBM)
    for rest in RESTING:
        for name in whole_names(rest.names):
            yield LogVariable(name, Scalar[rest.type or "F32"], rest.unit, lambda: 0)


def _target(running: Running) -> tuple[Vector, float]:
    """Return the target in the frame of the poses, position and yaw."""
    frame = running.pilot.frame()
    if frame is not None:
        return frame.position, frame.yaw
    x, y, z, yaw = running.core.parameters.fields.target.tolist()
    return (x, y, z), yaw


def stock_parameters(running: Running) -> Iterator[Parameter]:
    for setting in SETTINGS:
        limit = INTEGER_LIMITS.get(setting.scalar)
        low, high = (-FLOAT_LIMIT, FLOAT_LIMIT) if limit is None else (0, limit)
        for whole, default in zip(whole_names(setting.names), setting.defaults, strict=True):
            running.stock.settings[whole] = default
            yield Parameter(
                whole, setting.scalar, setting.unit,
                partial(running.stock.settings.__getitem__, whole),
                partial(running.stock.settings.__setitem__, whole),
                low, high, setting.persistent,
            )  # fmt: skip
    commander, (slow, fast) = running.commander, VELOCITY_LIMITS
    for name, attribute in (("vtoff", "take_off_velocity"), ("vland", "landing_velocity")):
        yield Parameter(
            f"hlCommander.{name}", F32, "m/s", partial(getattr, commander, attribute),
            partial(setattr, commander, attribute), slow, fast,
        )  # fmt: skip
    yield Parameter(
        "hlCommander.groupmask", U8, "", lambda: commander.groups,
        lambda value: setattr(commander, "groups", int(value)), 0, 0xFF,
    )  # fmt: skip
    yield Parameter("lighthouse.bsAvailable", U16, "", lambda: 0)
    for name in ("imu_sensors.AK8963", "deck.bcColorLedBot", "deck.bcColorLedTop"):  # not there
        yield Parameter(name, U8, "", lambda: 0)
    yield Parameter(
        "system.testLogParam", U8, "", lambda: running.stock.test_value,
        lambda value: setattr(running.stock, "test_value", value), 0, 0xFF,
    )  # fmt: skip
    for name, lines in (
        ("system.taskDump", _task_lines),
        ("system.storageStats", _storage_lines),
        ("system.assertInfo", lambda running: ("No assert information found",)),
        ("health.startPropTest", lambda running: ("health: there are no propellers to test",)),
        ("health.startBatTest", _battery_lines),
    ):
        yield _button(running, name, lines)


def _button(running: Running, name: str, lines: Callable[[Running], Iterable[str]]) -> Parameter:
    """Return a parameter that prints lines on the console when it is set, and reads 0 again at once."""

    def press(value: float) -> None:
        if value:
            for line in lines(running):
                running.print_line(line)

    return Parameter(name, U8, "", lambda: 0, press, 0, 0xFF)


def _task_lines(running: Running) -> Iterator[str]:
    """Yield each task's share of the processor's time since boot."""
    kernel = running.stack.kernel
    yield "Task dump"
    yield "Load\tName"
    for task in kernel.tasks:
        yield f"{100 * kernel.run_time_us(task) / max(1, kernel.now_us):.2f}\t{task.name}"


def _storage_lines(running: Running) -> Iterator[str]:
    """Yield how full the parameters' memory is."""
    used, size, items = running.storage.used, running.storage.size, len(running.storage.load())
    yield f"Used storage: {items} items stored, {used} of {size} bytes ({100 * used // size} %)"


def _battery_lines(running: Running) -> Iterator[str]:
    voltage, least = running.supervisor.battery_mv, running.core.parameters.fields.low_battery_mv
    yield f"health: battery {voltage} mV, at least {least} needed"
