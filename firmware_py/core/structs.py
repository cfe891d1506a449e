"""The state structs of the flight core: everything it remembers, nothing else.

Frames: G is the goal frame (origin at the goal, z up, x along the goal's heading), B the body (x forward, y left, z up).
The state vector holds, in this order: position in G (3) [m], velocity in G (3) [m/s], roll, pitch, yaw of B in G [rad],
body rates p, q, r [rad/s], and the four flap angles as deviations from the hover angles [rad].
"""

from typing import Annotated

from firmware_py.core.subset import F32s, I32s, Struct, f32, i32

STATES = 16
POSITION = 0
VELOCITY = 3
ATTITUDE = 6
RATE = 9
FLAP = 12
TICK_US = 10000  # period of the estimator and of the controller
HISTORY = 32  # ticks of commands, gyro samples and poses that are kept; a power of two
HORIZON_LIMIT = 12  # ticks, 120 ms

MODE_HOVER = 0  # flaps at the hover angles
MODE_FLY = 1  # closed loop
MODE_MANUAL = 2  # flap angles come from outside

EXCITE_OFF = 0
EXCITE_MULTISINE = 1
EXCITE_CHIRP = 2

POSE_ON_TIME = 0
POSE_TOO_OLD = 1
POSE_INVALID = 2


class Parameters(Struct):
    """What may be tuned: set at start from the profile, in flight by parameter messages."""

    hover_angle: f32  # [rad] opening of every flap at hover
    opening_min: f32  # [rad]
    opening_max: f32  # [rad]
    flap_rate: f32  # [1/s] inverse time constant of servo and linkage
    # linear model at hover, the paper's f_{affected, influencing}
    roll_u1: f32
    roll_roll: f32
    roll_rate: f32
    roll_vy: f32
    y_u1: f32
    y_roll: f32
    y_vy: f32
    pitch_u2: f32
    pitch_pitch: f32
    pitch_rate: f32
    pitch_vx: f32
    x_u2: f32
    x_pitch: f32
    x_vx: f32
    yaw_u3: f32
    yaw_rate: f32
    z_u4: f32
    z_vz: f32
    # process noise, variance per tick
    process_position: f32
    process_velocity: f32
    process_attitude: f32
    process_rate: f32
    process_flap: f32
    # measurement noise, variance
    measured_position: f32
    measured_attitude: f32
    measured_rate: f32
    # gate and bounds
    gate_sigma: f32  # innovations beyond this many standard deviations are refused
    gate_position: f32  # [m] but never below this
    gate_attitude: f32  # [rad] nor this
    bound_position: f32  # [m]
    bound_velocity: f32  # [m/s]
    bound_tilt: f32  # [rad]
    bound_rate: f32  # [rad/s]
    # delay predictor
    predict: i32  # 0: every pose is taken as current
    age_measured: i32  # 1: the age comes with the pose and the horizon follows it; 0: always `horizon`
    horizon: i32  # ticks, 1..12: the fixed age, or the first one
    default_age_us: i32  # of a pose that does not state its age
    # controller: proportional, integrator on z only
    gain_y: f32
    gain_vy: f32
    gain_roll: f32
    gain_p: f32
    gain_x: f32
    gain_vx: f32
    gain_pitch: f32
    gain_q: f32
    gain_yaw: f32
    gain_r: f32
    gain_z: f32
    gain_vz: f32
    gain_iz: f32
    limit_xy: f32  # [m] on the position errors
    limit_u: f32  # [rad] on u1, u2, u4
    limit_u3: f32  # [rad]
    limit_iz: f32  # [m s]
    # servos
    trim: Annotated[F32s, 4]  # [1/65535 of the servo range] added to the word
    direction: Annotated[F32s, 4]  # +1 or -1
    # IMU
    gyro_scale: f32  # [rad/s per count]
    # set-point in G, normally zero: the correction that arrives is already relative to the goal
    target: Annotated[F32s, 4]  # x, y, z [m], yaw [rad]
    # excitation, for identification
    excite_kind: i32  # EXCITE_OFF, EXCITE_MULTISINE or EXCITE_CHIRP
    excite_rms: Annotated[F32s, 4]  # [rad] of u1..u4
    excite_low: f32  # [Hz] the band
    excite_high: f32


class Input(Struct):
    """What the tasks hand to the core."""

    gyro_sum: Annotated[I32s, 3]  # [counts] sum over the samples since the last tick, sensor frame
    gyro_samples: i32
    gyro_bias: Annotated[F32s, 3]  # [counts]
    pose_position: Annotated[F32s, 3]  # [m] p_GB
    pose_quaternion: Annotated[F32s, 4]  # q_GB, w x y z
    pose_age_us: i32  # at the next tick; negative: unknown
    mode: i32
    manual: Annotated[F32s, 4]  # [rad] flap angles of MODE_MANUAL


class Estimator(Struct):
    """The delayed Kalman filter, its history, and the state that was brought to now."""

    x: Annotated[F32s, 16]  # at `filtered_tick`
    P: Annotated[F32s, 16, 16]
    now: Annotated[F32s, 16]  # at `tick`: what the controller reads
    tick: i32
    filtered_tick: i32
    quiet_ticks: i32  # since a pose was older than the horizon minus one
    started: i32  # a first pose has been fused
    # history, indexed by tick modulo HISTORY
    gyro: Annotated[F32s, 32, 3]  # [rad/s] body rates
    command: Annotated[F32s, 32, 4]  # [rad] commanded deviation from hover that held from this tick on
    pose: Annotated[F32s, 32, 6]  # position [m] and attitude [rad] in G
    pose_lag: Annotated[F32s, 32]  # [s] the pose was true this long before its tick
    pose_waiting: Annotated[I32s, 32]
    # a refused pose, kept to distinguish a jump of the goal from an outlier
    suspect: Annotated[F32s, 6]
    suspect_tick: i32
    suspect_waiting: i32
    # counters, and what an observer wants to see with them
    fused: i32
    refused: i32
    jumps: i32
    too_old: i32
    invalid: i32
    bounded: i32
    resets: i32
    horizon: i32  # ticks by which the filter runs behind
    pose_age_us: i32  # of the last pose that was accepted for fusion, at its tick
    # work space, no meaning between ticks
    work_1: Annotated[F32s, 16]
    work_2: Annotated[F32s, 16]
    work_3: Annotated[F32s, 16]
    work_P: Annotated[F32s, 16, 16]


class Control(Struct):
    """The controller's memory and what it put out last."""

    u: Annotated[F32s, 4]  # [rad] u1 roll, u2 pitch, u3 yaw, u4 height
    integral_z: f32  # [m s]
    flap: Annotated[F32s, 4]  # [rad] commanded flap angles
    command: Annotated[F32s, 4]  # [rad] the same as deviations from hover
    word: Annotated[I32s, 4]
    count: Annotated[I32s, 4]
    excitation: Annotated[F32s, 4]  # [rad] its part of u
    excite_tick: i32  # of its period
