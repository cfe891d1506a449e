"""The constants that are flashed: one section per part of the flight core, filled from a profile.

No value has a default here: a profile sets them all, with their reasons. Units are SI, angles in radians. Keys that
clients may set, too, are declared at the fields of the core.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, create_model

from firmware_py.core.structs import Parameters
from firmware_py.core.subset import Block, f32, i32
from firmware_py.drivers.imu import GYRO_SCALE
from firmware_py.section import Section
from firmware_py.table import CORE_PARAMETERS, ProfileKey, profile_keys, value_in

SIGNALS = ("off", "multisine", "chirp")  # by their numbers in excite.signal

S = TypeVar("S", bound="Section")


def _declared(section: str) -> Callable[[type[S]], type[S]]:
    """Return the decorator that gives a section the keys which the table of variables declares for it."""

    def filled(model: type[S]) -> type[S]:
        fields: dict[str, Any] = {
            key.name: (
                _kind(key),
                Field(description=f"{key.mark.meaning} [{key.mark.unit}]".removesuffix(" []")),
            )
            for key in profile_keys(section)
        }
        return create_model(
            model.__name__, __base__=model, __doc__=model.__doc__, __module__=model.__module__, **fields
        )

    return filled


def _kind(key: ProfileKey) -> Any:
    """Return the type of a key, with its bounds."""
    low, high = key.mark.low, key.mark.high
    if key.base == "i32" and (low, high) == (0, 1):
        return bool
    number: Any = int if key.base == "i32" else float
    bounded: Any = Annotated[number, Field(ge=low, le=high)]
    return bounded if key.count == 1 else tuple.__class_getitem__((bounded,) * key.count)


class Declared(Section):
    """A section whose keys are declared at the fields that they set: `firmware_py.table`."""

    if TYPE_CHECKING:

        def __getattr__(self, key: str) -> Any:
            """Return the value of a declared key."""


@_declared("model")
class ModelConfig(Declared):
    """The linear model on board: the paper's f_{affected, influencing} at hover, couplings to vx and vy included."""


@_declared("estimator")
class EstimatorConfig(Declared):
    """Noise, gate and bounds of the Kalman filter."""


@_declared("predictor")
class PredictorConfig(Declared):
    """Delay compensation."""

    age: Literal["measured", "fixed"] = Field(
        description="measured: poses state their age and the horizon follows it; fixed: always `horizon` ticks"
    )


@_declared("controller")
class ControllerConfig(Declared):
    """Gains in the paper's signs: u = gain (target - estimate) - gains (velocity, attitude, rate)."""


@_declared("allocation")
class AllocationConfig(Declared):
    """Hover angle and range of the flaps, as openings (positive for every flap)."""


@_declared("excitation")
class ExcitationConfig(Declared):
    """The signal added to the inputs for identification, once `excite.signal` on board switches it on."""

    signal: Literal["multisine", "chirp"] = Field(
        description="multisine: all inputs at once, each at separate frequencies; chirp: one input"
    )

    @property
    def rms(self) -> tuple[float, float, float, float]:
        """The rms of u1 to u4 [rad]."""
        return (self.u1, self.u2, self.u3, self.u4)


@_declared("servo")
class ServoConfig(Declared):
    """Trim and direction of the four servo outputs."""

    direction: tuple[Literal[-1, 1], Literal[-1, 1], Literal[-1, 1], Literal[-1, 1]] = Field(
        description="sense of rotation"
    )


@_declared("supervisor")
class SupervisorConfig(Declared):
    """When the loop is closed."""


@_declared("box")
class BoxConfig(Declared):
    """Where goals may be, an upright cylinder around home: outside it the robot cannot hover."""


Cost = Annotated[int, Field(ge=0, le=100_000)]


class CpuConfig(Section):
    """Processor time that the tasks take on the 168 MHz Cortex-M4F; all zero switches the model off."""

    sensors_us: Cost = Field(description="SENSORS, per IMU sample [us]")
    stabilizer_us: Cost = Field(description="STABILIZER, per tick without the controller [us]")
    controller_us: Cost = Field(description="STABILIZER, controller and servo mapping, per 100 Hz step [us]")
    kalman_us: Cost = Field(description="KALMAN, per tick without a step [us]")
    estimator_us: Cost = Field(
        description="KALMAN, per 100 Hz step, with the poses filed since the last [us]"
    )
    measured: bool = Field(
        description="a board that counts cycles (cortex-m4) takes them instead of controller_us and estimator_us"
    )
    syslink_us: Cost = Field(description="SYSLINK, per packet [us]")
    crtp_us: Cost = Field(description="CRTP-RX and CRTP-TX, per packet [us]")
    log_us: Cost = Field(description="LOG, per packet [us]")
    mavlink_us: Cost = Field(description="MAV-RX and MAV-TX, per message [us]")


Rate = Annotated[float, Field(ge=0, le=1000)]


class StreamRates(Section):
    """How often the board sends each message unasked after boot; 0 switches it off. [Hz]"""

    heartbeat: Rate = Field(description="HEARTBEAT; clients give up after some seconds without one")
    sys_status: Rate = Field(description="SYS_STATUS")
    battery_status: Rate = Field(description="BATTERY_STATUS")
    attitude: Rate = Field(description="ATTITUDE")
    attitude_quaternion: Rate = Field(description="ATTITUDE_QUATERNION")
    local_position: Rate = Field(description="LOCAL_POSITION_NED")
    servo_output: Rate = Field(description="SERVO_OUTPUT_RAW")
    estimator_status: Rate = Field(description="ESTIMATOR_STATUS")
    named_values: Rate = Field(description="NAMED_VALUE_FLOAT, all of them")
    flight_array: Rate = Field(description="DEBUG_FLOAT_ARRAY floaty")
    system_time: Rate = Field(description="SYSTEM_TIME")
    current_mode: Rate = Field(description="CURRENT_MODE, beside every change")
    position_target: Rate = Field(description="POSITION_TARGET_LOCAL_NED")
    vfr_hud: Rate = Field(description="VFR_HUD")
    actuator_output: Rate = Field(description="ACTUATOR_OUTPUT_STATUS")
    home_position: Rate = Field(description="HOME_POSITION")
    odometry: Rate = Field(description="ODOMETRY")


class MavlinkConfig(Section):
    """The serial line: the board's identity on it, and what it sends."""

    system: int = Field(ge=1, le=255, description="system id")
    component: int = Field(ge=1, le=255, description="component id")
    home: tuple[float, float, float] = Field(description="goal until one arrives, W, yaw 0 [m]")
    signing_key: str = Field(
        pattern="^([0-9a-fA-F]{64})?$",
        description="MAVLink 2 signing, 32 bytes in hexadecimal; empty: unsigned",
    )
    rates: StreamRates


class LogicConfig(BaseModel):
    """The user's own modules in the core, and values of their parameters (`floaty docs own-logic`)."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)
    __pydantic_extra__: dict[str, float] = Field(init=False)

    controller: str = Field(
        "", description="file with the control law, or the name of one that ships; empty: the core's"
    )
    estimator: str = Field("", description="file with the estimator; empty: the core's")

    @property
    def values(self) -> dict[str, float]:
        """The parameters' values that differ from the modules' own."""
        return dict(self.__pydantic_extra__)


class FirmwareConfig(Section):
    """Everything that is flashed."""

    model: ModelConfig
    estimator: EstimatorConfig
    predictor: PredictorConfig
    controller: ControllerConfig
    allocation: AllocationConfig
    excitation: ExcitationConfig
    servo: ServoConfig
    supervisor: SupervisorConfig
    box: BoxConfig
    cpu: CpuConfig
    mavlink: MavlinkConfig
    # A profile may set only a part of this section.
    logic: LogicConfig = Field(default_factory=LogicConfig)


def parameters_of(config: FirmwareConfig) -> Block[Parameters]:
    """Return the core's parameter block for a configuration."""
    block = Parameters.allocate()
    for parameter in CORE_PARAMETERS:
        place = parameter.place
        if parameter.key and place.block == "parameters":
            block.memory[place.field][(0, *place.index)] = value_in(config, parameter.key)
    block.fields.gyro_scale = f32(GYRO_SCALE)
    block.fields.age_measured = i32(config.predictor.age == "measured")
    block.fields.direction[:] = config.servo.direction
    block.fields.home[:] = config.mavlink.home
    return block
