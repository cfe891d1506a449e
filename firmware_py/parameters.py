"""The parameters of the firmware: what may be changed on the running board, with limits.

Names are the Crazyflie's and the original Floaty's. Limits are those of the configuration, where there is one.
"""

from collections.abc import Iterator
from functools import partial
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from firmware_py.config import (
    AllocationConfig,
    ControllerConfig,
    EstimatorConfig,
    ExcitationConfig,
    ModelConfig,
    PredictorConfig,
    SupervisorConfig,
)
from firmware_py.core.structs import Parameters
from firmware_py.core.subset import F32s
from firmware_py.links.parameters import Parameter
from firmware_py.links.stream import TelemetryStream
from firmware_py.logic.plugs import GROUP
from firmware_py.running import Running
from firmware_py.supervisor import Manual
from firmware_py.variables import F32, I8, I16, SCALARS, U8, U16, U32
from firmware_py.wire.parameter_names import CORE, GAINS, SIGNALS
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.telemetry import STREAM

FLAPS = ("m1", "m2", "m3", "m4")
TRIM_LIMIT = 12_000  # as in ServoConfig
SETPOINT_LIMIT = 5.0  # [m]
STD_LIMITS = (1e-4, 1.0)  # [m], [rad]

FloatArray = F32s | NDArray[np.float64]


def parameters(running: Running, stream: TelemetryStream) -> tuple[Parameter, ...]:
    """Return the table, in the order of the parameter TOC."""
    core = running.core.parameters.fields
    return (
        *(
            _field(f"extCtrl.{name}", "", core, field, ControllerConfig, sign=sign)
            for name, (field, sign) in GAINS.items()
        ),
        *_manual(running),
        _element("extCtrl.target_yaw", "rad", core.target, 3, pi),
        _element("setpoint.X", "m", core.target, 0, SETPOINT_LIMIT),
        _element("setpoint.Y", "m", core.target, 1, SETPOINT_LIMIT),
        _element("setpoint.Z", "m", core.target, 2, SETPOINT_LIMIT),
        _element("setpoint.Yaw", "rad", core.target, 3, pi),
        _field("RandConsts.flapHoverAng", "rad", core, "hover_angle", AllocationConfig),
        _field("RandConsts.flapTimeConst", "1/s", core, "flap_rate", ModelConfig),
        Parameter(
            "delayComp.activate", U8, "", lambda: int(core.predict),
            lambda value: setattr(core, "predict", int(value)), 0, 1, persistent=True,
        ),
        _field("delayComp.horizon", "10 ms", core, "horizon", PredictorConfig, U8),
        _field("delayComp.defaultAge", "us", core, "default_age_us", PredictorConfig, Scalar.I32),
        *(_field(name, "", core, key, section) for name, key, section in core_fields()),
        *_excitation(core),
        *_kalman(running),
        *_supervision(running, stream),
        *_own_logic(running),
        Parameter(
            "memTst.resetW", U8, "", lambda: 0, lambda value: setattr(running.tester, "errors", 0), 0, 255
        ),
        *_identity(),
    )  # fmt: skip


def core_fields() -> Iterator[tuple[str, str, type[BaseModel]]]:
    """Yield what of the core the original had no name for: the board's name, the core's, its configuration."""
    sections: dict[str, type[BaseModel]] = {
        "model": ModelConfig, "estimator": EstimatorConfig, "controller": ControllerConfig, "allocation": AllocationConfig,
    }  # fmt: skip
    for path, name in CORE.items():
        section, key = path.split(".")
        yield name, key, sections[section]


def configured_limits(section: type[BaseModel], field: str) -> tuple[float, float]:
    """Return the inclusive limits of a configuration field; an exclusive lower one excludes only itself here."""
    low = high = 0.0
    for limit in section.model_fields[field].metadata:
        low = getattr(limit, "ge", getattr(limit, "gt", low))
        high = getattr(limit, "le", high)
    return low, high


def _field(
    name: str,
    unit: str,
    fields: Parameters,
    field: str,
    section: type[BaseModel],
    scalar: Scalar = F32,
    sign: int = 1,
) -> Parameter:
    """A persistent parameter that is a number in the core, with the limits of its configuration."""
    low, high = sorted(sign * limit for limit in configured_limits(section, field))
    return Parameter(
        name, scalar, unit,
        lambda: sign * getattr(fields, field).item(), lambda value: setattr(fields, field, sign * value),
        low, high, persistent=True,
    )  # fmt: skip


def _element(name: str, unit: str, array: F32s, index: int, limit: float) -> Parameter:
    """An element of an array, between -limit and limit."""
    return Parameter(
        name,
        F32,
        unit,
        lambda: array.item(index),
        lambda value: array.__setitem__(index, value),
        -limit,
        limit,
    )


def _manual(running: Running) -> Iterator[Parameter]:
    """Flap angles, words and trims from outside."""
    manual, trim = running.manual, running.core.parameters.fields.trim

    def element(
        name: str, scalar: Scalar, unit: str, array: FloatArray, index: int, low: float, high: float
    ) -> Parameter:
        def write(value: float) -> None:
            array[index] = value
            manual.apply()

        return Parameter(name, scalar, unit, lambda: array.item(index), write, low, high, array is trim)

    def set_mode(value: float) -> None:
        manual.mode = Manual(int(value))
        manual.apply()

    def set_words(value: float) -> None:
        manual.use_words = value == 1
        manual.apply()

    yield Parameter("extCtrl.manual", U8, "", lambda: manual.mode, set_mode, 0, len(Manual) - 1)
    yield Parameter("motorPowerSet.enable", U8, "", lambda: manual.use_words, set_words, 0, 1)
    for index, name in enumerate(FLAPS):
        yield element(f"extCtrl.{name}", F32, "rad", manual.angles, index, -pi / 2, pi / 2)
        yield element(f"motorPowerSet.{name}", U16, "words", manual.words, index, 0, 0xFFFF)
        yield element(f"motorShifts.{name}", I16, "words", trim, index, -TRIM_LIMIT, TRIM_LIMIT)


def _excitation(core: Parameters) -> Iterator[Parameter]:
    """What is added to the inputs for identification; a board that boots excites nothing."""
    yield Parameter(
        "excite.signal", U8, "", lambda: int(core.excite_kind),
        lambda value: setattr(core, "excite_kind", int(value)), 0, len(SIGNALS) - 1,
    )  # fmt: skip
    for index in range(4):
        yield Parameter(
            f"excite.u{index + 1}", F32, "rad", partial(core.excite_rms.item, index),
            partial(core.excite_rms.__setitem__, index), *configured_limits(ExcitationConfig, f"u{index + 1}"),
        )  # fmt: skip
    for end in ("low", "high"):
        field = f"excite_{end}"
        yield Parameter(
            f"excite.{end}", F32, "Hz", partial(getattr, core, field), partial(setattr, core, field),
            *configured_limits(ExcitationConfig, end),
        )  # fmt: skip


def _kalman(running: Running) -> Iterator[Parameter]:
    """Bounds and noise of the estimator, and its reset, which reads 0 again at once."""
    core = running.core

    def reset(value: float) -> None:
        if value:
            core.run.reset()

    def deviation(name: str, unit: str, field: str) -> Parameter:
        fields = core.parameters.fields
        low, high = STD_LIMITS
        return Parameter(
            name, F32, unit,
            lambda: sqrt(getattr(fields, field)), lambda value: setattr(fields, field, value * value), low, high,
        )  # fmt: skip

    yield _field("kalman.maxPos", "m", core.parameters.fields, "bound_position", EstimatorConfig)
    yield _field("kalman.maxVel", "m/s", core.parameters.fields, "bound_velocity", EstimatorConfig)
    yield Parameter("kalman.resetEstimation", U8, "", lambda: 0, reset, 0, 1)
    yield Parameter("FloatyKalm.resetKalman", U8, "", lambda: 0, reset, 0, 1)
    yield Parameter(
        "extPose.absolute", U8, "", lambda: running.pilot.absolute,
        lambda value: setattr(running.pilot, "absolute", value == 1), 0, 1, persistent=True,
    )  # fmt: skip
    yield deviation("locSrv.extPosStdDev", "m", "measured_position")
    yield deviation("locSrv.extQuatStdDev", "rad", "measured_attitude")


def _supervision(running: Running, stream: TelemetryStream) -> Iterator[Parameter]:
    """Failsafe and telemetry. The stop of the Crazyflie firmware holds until a reboot, Floaty's own can be undone."""
    supervisor, kernel = running.supervisor, running.stack.kernel

    def lock(value: float) -> None:
        if value:
            supervisor.emergency_stop()

    def stop(value: float) -> None:
        if value:
            supervisor.stop()
        else:
            supervisor.recover(kernel.now_us)

    low_us, high_us = configured_limits(SupervisorConfig, "pose_timeout_us")
    low_mv, high_mv = configured_limits(SupervisorConfig, "low_battery_mv")
    yield Parameter("stabilizer.stop", U8, "", lambda: supervisor.locked, lock, 0, 1)
    yield Parameter("floaty.stop", U8, "", lambda: supervisor.stopped and not supervisor.locked, stop, 0, 1)
    yield Parameter(
        "floaty.armed", U8, "", lambda: supervisor.armed, lambda value: supervisor.arm(value == 1), 0, 1
    )
    yield Parameter(
        "supervisor.poseTimeout", U16, "ms", lambda: supervisor.pose_timeout_us // 1000,
        lambda value: setattr(supervisor, "pose_timeout_us", int(value) * 1000),
        low_us / 1000, high_us / 1000, persistent=True,
    )  # fmt: skip
    yield Parameter(
        "supervisor.lowBattery", U16, "mV", lambda: supervisor.low_battery_mv,
        lambda value: setattr(supervisor, "low_battery_mv", int(value)), low_mv, high_mv, persistent=True,
    )  # fmt: skip
    yield Parameter(STREAM, U8, "", lambda: stream.on, lambda value: stream.switch(value == 1), 0, 1)


def _own_logic(running: Running) -> Iterator[Parameter]:
    """What the user's modules have declared as Tunable."""
    logic = running.core.logic
    for own in () if logic is None else logic.loaded.parameters:
        array, scalar = running.core.named[own.block].memory[own.name], SCALARS[own.base]
        yield Parameter(
            f"{GROUP}.{own.name}", scalar, own.mark.unit, partial(array.item, 0), partial(array.__setitem__, 0),
            own.mark.low, own.mark.high, persistent=True,
        )  # fmt: skip


# cfclient's flight and lighthouse tabs and Bitcraze's QA suite read these without asking whether they exist: without them
# they end in KeyError. Other absent decks have no entry.
ABSENT_DECKS = (
    "bcAI", "bcDWM1000", "bcFlow", "bcFlow2", "bcLighthouse4", "bcLoco", "bcMultiranger", "bcUSD", "bcZRanger",
    "bcZRanger2",
)  # fmt: skip


def _identity() -> Iterator[Parameter]:
    """What the board is; read only."""
    for name, scalar, value in (
        ("system.selftestPassed", I8, 1),
        ("deck.bcFloaty", U8, 1),
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
