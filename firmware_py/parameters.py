"""The parameters of the firmware: those of the table of variables, and those of a running board only.

Names are the Crazyflie's and the original Floaty's.
"""

from collections.abc import Iterator
from math import sqrt

from firmware_py.links.parameters import Parameter
from firmware_py.running import Running
from firmware_py.table import CORE_PARAMETERS, CoreParameter
from firmware_py.variables import F32, I8, U8, U16, U32

STD_LIMITS = (1e-4, 1.0)  # [m], [rad]


def parameters(running: Running) -> tuple[Parameter, ...]:
    """Return the table, in the order of the parameter TOC."""
    logic = running.core.logic
    own = () if logic is None else logic.loaded.parameters
    return (
        *(_declared(running, parameter) for parameter in (*CORE_PARAMETERS, *own)),
        *_kalman(running),
        *_supervision(running),
        Parameter(
            "memTst.resetW", U8, "", lambda: 0, lambda value: setattr(running.tester, "errors", 0), 0, 255
        ),
        *_identity(),
    )


def _declared(running: Running, declared: CoreParameter) -> Parameter:
    """Return a parameter of the table of variables."""
    place, scale = declared.place, declared.scale
    array, index = running.core.named[place.block].memory[place.field], (0, *place.index)

    def put(value: float) -> None:
        array[index] = scale * value

    return Parameter(
        declared.name, declared.scalar, declared.unit, lambda: array.item(*index) / scale, put,
        declared.low, declared.high, declared.persistent,
    )  # fmt: skip


def _kalman(running: Running) -> Iterator[Parameter]:
    """Yield the estimator's noise as deviations, and its reset, which reads 0 again at once."""
    core = running.core

    def reset(value: float) -> None:
        if value:
            core.run.call("reset")

    def deviation(name: str, unit: str, field: str) -> Parameter:
        fields = core.parameters.fields
        low, high = STD_LIMITS
        return Parameter(
            name, F32, unit,
            lambda: sqrt(getattr(fields, field)), lambda value: setattr(fields, field, value * value), low, high,
        )  # fmt: skip

    yield Parameter("kalman.resetEstimation", U8, "", lambda: 0, reset, 0, 1)
    yield Parameter("FloatyKalm.resetKalman", U8, "", lambda: 0, reset, 0, 1)
    yield deviation("locSrv.extPosStdDev", "m", "measured_position")
    yield deviation("locSrv.extQuatStdDev", "rad", "measured_attitude")


def _supervision(running: Running) -> Iterator[Parameter]:
    """Yield the stops. That of the Crazyflie firmware holds until a reboot, Floaty's own can be undone."""
    supervisor, crazyflie = running.supervisor, running.pilot.stabilizer.supervisor

    def lock(value: float) -> None:
        if value:
            crazyflie.stop_wanted = True

    def stop(value: float) -> None:
        if value:
            supervisor.stop()
        else:
            supervisor.recover()

    yield Parameter("stabilizer.stop", U8, "", lambda: supervisor.locked, lock, 0, 1)
    yield Parameter("floaty.stop", U8, "", lambda: supervisor.stopped and not supervisor.locked, stop, 0, 1)
    yield Parameter(
        "floaty.armed", U8, "", lambda: supervisor.armed, lambda value: supervisor.arm(value == 1), 0, 1
    )


# cfclient's flight and lighthouse tabs and Bitcraze's QA suite read these without asking whether they exist: without them
# they end in KeyError. Other decks have no entry.
ABSENT_DECKS = (
    "bcAI", "bcDWM1000", "bcFlow", "bcFlow2", "bcLighthouse4", "bcLoco", "bcMultiranger", "bcUSD", "bcZRanger",
    "bcZRanger2",
)  # fmt: skip


def _identity() -> Iterator[Parameter]:
    """Yield the board's identity; read only."""
    for name, scalar, value in (
        ("system.selftestPassed", I8, 1),
        *((f"deck.{name}", U8, 0) for name in ABSENT_DECKS),
        ("imu_sensors.BMI088", U8, 1),
        ("imu_sensors.BMP3XX", U8, 0),
        ("imu_sensors.HMC5883L", U8, 0),
        ("imu_sensors.MS5611", U8, 0),
        ("firmware.revision0", U32, 0x0F10A717),
        ("firmware.revision1", U16, 0x0001),
        ("firmware.modified", U8, 0),
        ("cpu.flash", U16, 1024),  # [KiB]
        ("cpu.id0", U32, 0x00F10A71),
        ("cpu.id1", U32, 0),
        ("cpu.id2", U32, 1),
    ):
        yield Parameter(name, scalar, "", lambda value=value: value)  # type: ignore[misc]
