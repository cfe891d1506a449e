"""The constants that are flashed: one section per part of the flight core, filled from a profile.

No value has a default here: a profile states them all, with their reasons. Units are SI, angles in radians.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from firmware_py.core.structs import HORIZON_LIMIT, Parameters
from firmware_py.core.subset import Block
from firmware_py.drivers.imu import GYRO_SCALE

Gain = Annotated[float, Field(ge=-20, le=20)]
Coupling = Annotated[float, Field(ge=-5000, le=5000)]
Variance = Annotated[float, Field(gt=0, le=100)]
Excitation = Annotated[float, Field(ge=0, le=0.3)]
Frequency = Annotated[float, Field(ge=0.1, le=10)]
Trim = Annotated[float, Field(ge=-12000, le=12000)]


class Section(BaseModel):
    """A strict, immutable part of the configuration."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ModelConfig(Section):
    """The linear model on board: the paper's f_{affected, influencing} at hover, couplings to vx and vy included."""

    flap_rate: float = Field(gt=1, le=1000, description="inverse time constant of servo and linkage [1/s]")
    roll_u1: Coupling = Field(description="roll acceleration per u1 [1/s^2]")
    roll_roll: Coupling = Field(description="roll acceleration per roll [1/s^2]")
    roll_rate: Coupling = Field(description="roll acceleration per roll rate [1/s]")
    roll_vy: Coupling = Field(description="roll acceleration per velocity to the left [rad/s/m]")
    y_u1: Coupling = Field(description="y acceleration per u1 [m/s^2/rad]")
    y_roll: Coupling = Field(description="y acceleration per roll [m/s^2/rad]")
    y_vy: Coupling = Field(description="y acceleration per y velocity [1/s]")
    pitch_u2: Coupling = Field(description="pitch acceleration per u2 [1/s^2]")
    pitch_pitch: Coupling = Field(description="pitch acceleration per pitch [1/s^2]")
    pitch_rate: Coupling = Field(description="pitch acceleration per pitch rate [1/s]")
    pitch_vx: Coupling = Field(description="pitch acceleration per x velocity [rad/s/m]")
    x_u2: Coupling = Field(description="x acceleration per u2 [m/s^2/rad]")
    x_pitch: Coupling = Field(description="x acceleration per pitch [m/s^2/rad]")
    x_vx: Coupling = Field(description="x acceleration per x velocity [1/s]")
    yaw_u3: Coupling = Field(description="yaw acceleration per u3 [1/s^2]")
    yaw_rate: Coupling = Field(description="yaw acceleration per yaw rate [1/s]")
    z_u4: Coupling = Field(description="z acceleration per u4 [m/s^2/rad]")
    z_vz: Coupling = Field(description="z acceleration per z velocity [1/s]")


class EstimatorConfig(Section):
    """Noise, gate and bounds of the Kalman filter."""

    process_position: Variance = Field(description="variance per 10 ms tick [m^2]")
    process_velocity: Variance = Field(description="variance per tick [m^2/s^2]")
    process_attitude: Variance = Field(description="variance per tick [rad^2]")
    process_rate: Variance = Field(description="variance per tick [rad^2/s^2]")
    process_flap: Variance = Field(description="variance per tick [rad^2]")
    measured_position: Variance = Field(description="variance of a mocap position [m^2]")
    measured_attitude: Variance = Field(description="variance of a mocap angle [rad^2]")
    measured_rate: Variance = Field(description="variance of a gyro sample, mean of 10 [rad^2/s^2]")
    gate_sigma: float = Field(gt=1, le=100, description="innovation gate [standard deviations]")
    gate_position: float = Field(gt=0, le=10, description="the gate never refuses less than this [m]")
    gate_attitude: float = Field(gt=0, le=4, description="the gate never refuses less than this [rad]")
    bound_position: float = Field(gt=0, le=10, description="bound on each position [m]")
    bound_velocity: float = Field(gt=0, le=20, description="bound on each velocity [m/s]")
    bound_tilt: float = Field(gt=0, le=1.5, description="bound on roll and pitch [rad]")
    bound_rate: float = Field(gt=0, le=40, description="bound on body rates [rad/s]")


class PredictorConfig(Section):
    """Delay compensation."""

    enabled: bool = Field(description="false: every pose counts as current, as in the original firmware")
    age: Literal["measured", "fixed"] = Field(
        description="measured: poses state their age and the horizon follows it; fixed: always `horizon` ticks"
    )
    horizon: int = Field(ge=1, le=HORIZON_LIMIT, description="first or fixed horizon [ticks of 10 ms]")
    default_age_us: int = Field(ge=0, le=120_000, description="age of a pose that does not state it [us]")


class ControllerConfig(Section):
    """Gains in the paper's signs: u = gain (target - estimate) - gains (velocity, attitude, rate)."""

    gain_y: Gain = Field(description="u1 per y error [rad/m]")
    gain_vy: Gain = Field(description="u1 per -vy [rad s/m]")
    gain_roll: Gain = Field(description="u1 per -roll")
    gain_p: Gain = Field(description="u1 per -p [s]")
    gain_x: Gain = Field(description="u2 per x error [rad/m]")
    gain_vx: Gain = Field(description="u2 per -vx [rad s/m]")
    gain_pitch: Gain = Field(description="u2 per -pitch")
    gain_q: Gain = Field(description="u2 per -q [s]")
    gain_yaw: Gain = Field(description="u3 per yaw error")
    gain_r: Gain = Field(description="u3 per -r [s]")
    gain_z: Gain = Field(description="u4 per z error [rad/m]")
    gain_vz: Gain = Field(description="u4 per -vz [rad s/m]")
    gain_iz: Gain = Field(description="u4 per integral of the z error [rad/m/s]")
    limit_xy: float = Field(gt=0, le=5, description="limit on the x and y errors [m]")
    limit_u: float = Field(gt=0, le=1.5, description="limit on u1, u2 and u4 [rad]")
    limit_u3: float = Field(gt=0, le=1.5, description="limit on u3 [rad]")
    limit_iz: float = Field(ge=0, le=5, description="limit on the integral of the z error [m s]")


class AllocationConfig(Section):
    """Hover angle and range of the flaps, as openings (positive for every flap)."""

    hover_angle: float = Field(ge=0, le=1.2, description="opening at hover, theta_H [rad]")
    opening_min: float = Field(ge=-1, le=1.5, description="least opening [rad]")
    opening_max: float = Field(ge=-1, le=1.5, description="greatest opening [rad]")


class ExcitationConfig(Section):
    """What is added to the inputs for identification, once `excite.signal` on board switches it on."""

    signal: Literal["multisine", "chirp"] = Field(
        description="multisine: all inputs at once, each with lines of its own; chirp: one input"
    )
    u1: Excitation = Field(description="rms of what is added to u1 [rad]; 0: nothing")
    u2: Excitation = Field(description="rms of what is added to u2 [rad]; 0: nothing")
    u3: Excitation = Field(description="rms of what is added to u3 [rad]; 0: nothing")
    u4: Excitation = Field(description="rms of what is added to u4 [rad]; 0: nothing")
    low: Frequency = Field(description="lower end of the band [Hz]")
    high: Frequency = Field(description="upper end of the band [Hz]")

    @property
    def rms(self) -> tuple[float, float, float, float]:
        """Of u1 to u4 [rad]."""
        return (self.u1, self.u2, self.u3, self.u4)


class ServoConfig(Section):
    """Trim and direction of the four servo outputs."""

    trim: tuple[Trim, Trim, Trim, Trim] = Field(description="added to the 16-bit word, 31290 per rad")
    direction: tuple[Literal[-1, 1], Literal[-1, 1], Literal[-1, 1], Literal[-1, 1]] = Field(
        description="sense of rotation"
    )


class SupervisorConfig(Section):
    """When the loop is closed."""

    pose_timeout_us: int = Field(
        ge=20_000, le=5_000_000, description="silence after which the flaps go to hover [us]"
    )
    low_battery_mv: int = Field(ge=0, le=20_000, description="supply below which flight ends after 5 s [mV]")


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
    log_us: Cost = Field(description="LOG and STREAM, per packet [us]")
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


class MavlinkConfig(Section):
    """The serial line: who the board is on it, and what it says there."""

    system: int = Field(ge=1, le=255, description="system id")
    component: int = Field(ge=1, le=255, description="component id")
    home: tuple[float, float, float] = Field(description="goal until one arrives, W, yaw 0 [m]")
    signing_key: str = Field(
        pattern="^([0-9a-fA-F]{64})?$",
        description="MAVLink 2 signing, 32 bytes in hexadecimal; empty: unsigned",
    )
    rates: StreamRates


class LogicConfig(BaseModel):
    """The user's own modules in the core, and values of their parameters (docs/howto/own-logic.md)."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)
    __pydantic_extra__: dict[str, float] = Field(init=False)

    controller: str = Field("", description="file with the control law; empty: the core's")
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
    cpu: CpuConfig
    mavlink: MavlinkConfig
    # The profile states only what it has of this section.
    logic: LogicConfig = Field(default_factory=LogicConfig)


def parameters_of(config: FirmwareConfig) -> Block[Parameters]:
    """Return the core's parameter block for a configuration."""
    block = Parameters.allocate()
    values: dict[str, object] = {"gyro_scale": GYRO_SCALE}
    for section in (config.model, config.estimator, config.controller, config.allocation, config.servo):
        values.update(section.model_dump())
    predictor = config.predictor
    values["predict"] = int(predictor.enabled)
    values["age_measured"] = int(predictor.age == "measured")
    values["horizon"] = predictor.horizon
    values["default_age_us"] = predictor.default_age_us
    excitation = config.excitation
    values |= {"excite_rms": excitation.rms, "excite_low": excitation.low, "excite_high": excitation.high}
    for name, value in values.items():
        block.memory[name] = value
    return block
