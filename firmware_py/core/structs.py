"""The state structs of the flight core: everything it remembers, nothing else.

Frames: G is the goal frame (origin at the goal, z up, x along the goal's heading), B the body (x forward, y left, z up).
The state vector holds, in this order: position in G (3) [m], velocity in G (3) [m/s], roll, pitch, yaw of B in G [rad],
body rates p, q, r [rad/s], and the four flap angles as deviations from the hover angles [rad].
"""

from typing import Annotated

from firmware_py.core.subset import F32s, I32s, Logged, Settable, Struct, f32, i32

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
MODE_MANUAL = 2  # flap angles from outside

EXCITE_OFF = 0
EXCITE_MULTISINE = 1
EXCITE_CHIRP = 2

MANUAL_OFF = 0  # the controller moves the flaps, when the state allows it
MANUAL_ANGLES = 1  # angles from outside, with or without poses, while a client is connected
MANUAL_HOVER = 2

STATE_CALIBRATING = 0  # the gyro's zero is unknown: flaps at hover
STATE_WAITING = 1  # no pose yet: flaps at hover
STATE_FLYING = 2  # loop closed
STATE_FAILSAFE = 3  # flaps at hover, see the cause

CAUSE_NONE = 0
CAUSE_SILENCE = 1
CAUSE_OUT_OF_BOUNDS = 2
CAUSE_EMERGENCY_STOP = 3
CAUSE_LOW_BATTERY = 4
CAUSE_DISARMED = 5
CAUSE_NO_CONTROL = 6  # no controller step ran, or another controller runs
CAUSE_CONTROLLER_NOT_FINITE = 7  # own logic returned NaN or infinity
CAUSE_ESTIMATOR_NOT_FINITE = 8
CAUSE_IMU_STALE = 9  # the gyro's counts do not change

REQUEST_STOP = 1  # until a request to recover
REQUEST_LOCK = 2  # stop until the board reboots
REQUEST_RECOVER = 3
REQUEST_ARM = 4
REQUEST_DISARM = 5

POSE_ON_TIME = 0
POSE_TOO_OLD = 1
POSE_INVALID = 2
POSE_NO_CORRECTION = 3  # too far from the goal
POSE_FROZEN = 4  # repeats the last one, although the robot has turned

GOAL_NONE = 0
GOAL_OF_CORRECTIONS = 1  # in the frame of the corrections
GOAL_ABSOLUTE = 2  # in W
GOAL_STALE = 3  # likewise; the next pose becomes the goal

SETPOINT_NONE = 0  # no command, the goal stays
SETPOINT_POSITION = 1  # a position, perhaps with a yaw
SETPOINT_OTHER = 2  # attitude, rates, velocity, thrust: not flown
SETPOINT_OUTSIDE = 3  # a position outside the box
SETPOINT_OF_CORRECTIONS = 4  # poses are corrections, whose sender has the goal


# fmt: off
class Parameters(Struct):
    """Tunable parameters: set at start from the profile, in flight by parameter messages."""

    hover_angle: Annotated[f32, Settable(
        "allocation", "RandConsts.flapHoverAng", "rad", 0, 1.2, "opening at hover, theta_H")]
    opening_min: Annotated[f32, Settable("allocation", "RandConsts.openMin", "rad", -1, 1.5, "least opening")]
    opening_max: Annotated[f32, Settable("allocation", "RandConsts.openMax", "rad", -1, 1.5, "greatest opening")]
    flap_rate: Annotated[f32, Settable(
        "model", "RandConsts.flapTimeConst", "1/s", 1, 1000, "inverse time constant of servo and linkage")]
    # linear model at hover, the paper's f_{affected, influencing}
    roll_u1: Annotated[f32, Settable("model", "", "1/s^2", -5000, 5000, "roll acceleration per u1")]
    roll_roll: Annotated[f32, Settable("model", "", "1/s^2", -5000, 5000, "roll acceleration per roll")]
    roll_rate: Annotated[f32, Settable("model", "", "1/s", -5000, 5000, "roll acceleration per roll rate")]
    roll_vy: Annotated[f32, Settable("model", "", "rad/s/m", -5000, 5000, "roll acceleration per velocity to the left")]
    y_u1: Annotated[f32, Settable("model", "", "m/s^2/rad", -5000, 5000, "y acceleration per u1")]
    y_roll: Annotated[f32, Settable("model", "", "m/s^2/rad", -5000, 5000, "y acceleration per roll")]
    y_vy: Annotated[f32, Settable("model", "", "1/s", -5000, 5000, "y acceleration per y velocity")]
    pitch_u2: Annotated[f32, Settable("model", "", "1/s^2", -5000, 5000, "pitch acceleration per u2")]
    pitch_pitch: Annotated[f32, Settable("model", "", "1/s^2", -5000, 5000, "pitch acceleration per pitch")]
    pitch_rate: Annotated[f32, Settable("model", "", "1/s", -5000, 5000, "pitch acceleration per pitch rate")]
    pitch_vx: Annotated[f32, Settable("model", "", "rad/s/m", -5000, 5000, "pitch acceleration per x velocity")]
    x_u2: Annotated[f32, Settable("model", "", "m/s^2/rad", -5000, 5000, "x acceleration per u2")]
    x_pitch: Annotated[f32, Settable("model", "", "m/s^2/rad", -5000, 5000, "x acceleration per pitch")]
    x_vx: Annotated[f32, Settable("model", "", "1/s", -5000, 5000, "x acceleration per x velocity")]
    yaw_u3: Annotated[f32, Settable("model", "", "1/s^2", -5000, 5000, "yaw acceleration per u3")]
    yaw_rate: Annotated[f32, Settable("model", "", "1/s", -5000, 5000, "yaw acceleration per yaw rate")]
    z_u4: Annotated[f32, Settable("model", "", "m/s^2/rad", -5000, 5000, "z acceleration per u4")]
    z_vz: Annotated[f32, Settable("model", "", "1/s", -5000, 5000, "z acceleration per z velocity")]
    # process noise
    process_position: Annotated[f32, Settable(
        "estimator", "FloatyKalm.procPos", "m^2", 1e-12, 100, "variance per 10 ms tick")]
    process_velocity: Annotated[f32, Settable("estimator", "FloatyKalm.procVel", "m^2/s^2", 1e-12, 100, "variance per tick")]
    process_attitude: Annotated[f32, Settable("estimator", "FloatyKalm.procAtt", "rad^2", 1e-12, 100, "variance per tick")]
    process_rate: Annotated[f32, Settable("estimator", "FloatyKalm.procRate", "rad^2/s^2", 1e-12, 100, "variance per tick")]
    process_flap: Annotated[f32, Settable("estimator", "FloatyKalm.procFlap", "rad^2", 1e-12, 100, "variance per tick")]
    # measurement noise
    measured_position: Annotated[f32, Settable(
        "estimator", "FloatyKalm.measPos", "m^2", 1e-12, 100, "variance of a mocap position")]
    measured_attitude: Annotated[f32, Settable(
        "estimator", "FloatyKalm.measAtt", "rad^2", 1e-12, 100, "variance of a mocap angle")]
    measured_rate: Annotated[f32, Settable(
        "estimator", "FloatyKalm.measRate", "rad^2/s^2", 1e-12, 100, "variance of a gyro sample, mean of 10")]
    # gate and bounds
    gate_sigma: Annotated[f32, Settable(
        "estimator", "FloatyKalm.gateSigma", "standard deviations", 1, 100, "innovation gate")]
    gate_position: Annotated[f32, Settable(
        "estimator", "FloatyKalm.gatePos", "m", 1e-6, 10, "the gate never refuses less than this")]
    gate_attitude: Annotated[f32, Settable(
        "estimator", "FloatyKalm.gateAtt", "rad", 1e-6, 4, "the gate never refuses less than this")]
    bound_position: Annotated[f32, Settable(
        "estimator", "FloatyKalm.maxPos", "m", 1e-6, 10, "bound on each position", stock="kalman.maxPos")]
    bound_velocity: Annotated[f32, Settable(
        "estimator", "FloatyKalm.maxVel", "m/s", 1e-6, 20, "bound on each velocity", stock="kalman.maxVel")]
    bound_tilt: Annotated[f32, Settable("estimator", "FloatyKalm.maxTilt", "rad", 1e-6, 1.5, "bound on roll and pitch")]
    bound_rate: Annotated[f32, Settable("estimator", "FloatyKalm.maxRate", "rad/s", 1e-6, 40, "bound on body rates")]
    # delay predictor
    predict: Annotated[i32, Settable(
        "predictor", "delayComp.activate", "", 0, 1, "false: every pose counts as current, as in the original firmware",
        key="enabled", type="U8")]
    age_measured: i32  # 1: the age comes with the pose and the horizon follows it; 0: always `horizon`
    horizon: Annotated[i32, Settable(
        "predictor", "delayComp.horizon", "10 ms", 1, HORIZON_LIMIT, "first or fixed horizon, in ticks", type="U8")]
    default_age_us: Annotated[i32, Settable(
        "predictor", "delayComp.defaultAge", "us", 0, 120_000, "age of a pose that does not state it")]
    # controller: proportional, integrator on z only; clients see the gains with the signs of the original, whose inputs of
    # roll and pitch have the opposite signs (u1 = -c1, u2 = -c0)
    gain_y: Annotated[f32, Settable("controller", "extCtrl.y_P", "rad/m", -20, 20, "u1 per y error", scale=-1)]
    gain_vy: Annotated[f32, Settable("controller", "extCtrl.vy_P", "rad s/m", -20, 20, "u1 per -vy", scale=-1)]
    gain_roll: Annotated[f32, Settable("controller", "extCtrl.roll_P", "", -20, 20, "u1 per -roll", scale=-1)]
    gain_p: Annotated[f32, Settable("controller", "extCtrl.roll_rate_P", "s", -20, 20, "u1 per -p", scale=-1)]
    gain_x: Annotated[f32, Settable("controller", "extCtrl.x_P", "rad/m", -20, 20, "u2 per x error", scale=-1)]
    gain_vx: Annotated[f32, Settable("controller", "extCtrl.vx_P", "rad s/m", -20, 20, "u2 per -vx", scale=-1)]
    gain_pitch: Annotated[f32, Settable("controller", "extCtrl.pitch_P", "", -20, 20, "u2 per -pitch", scale=-1)]
    gain_q: Annotated[f32, Settable("controller", "extCtrl.pitch_rate_P", "s", -20, 20, "u2 per -q", scale=-1)]
    gain_yaw: Annotated[f32, Settable("controller", "extCtrl.yaw_P", "", -20, 20, "u3 per yaw error")]
    gain_r: Annotated[f32, Settable("controller", "extCtrl.yaw_rate_P", "s", -20, 20, "u3 per -r")]
    gain_z: Annotated[f32, Settable("controller", "extCtrl.z_P", "rad/m", -20, 20, "u4 per z error")]
    gain_vz: Annotated[f32, Settable("controller", "extCtrl.vz_P", "rad s/m", -20, 20, "u4 per -vz")]
    gain_iz: Annotated[f32, Settable("controller", "extCtrl.z_I", "rad/m/s", -20, 20, "u4 per integral of the z error")]
    limit_xy: Annotated[f32, Settable("controller", "extCtrl.limXY", "m", 1e-6, 5, "limit on the x and y errors")]
    limit_u: Annotated[f32, Settable("controller", "extCtrl.limU", "rad", 1e-6, 1.5, "limit on u1, u2 and u4")]
    limit_u3: Annotated[f32, Settable("controller", "extCtrl.limU3", "rad", 1e-6, 1.5, "limit on u3")]
    limit_iz: Annotated[f32, Settable("controller", "extCtrl.limIz", "m s", 0, 5, "limit on the integral of the z error")]
    # servos
    trim: Annotated[F32s, 4, Settable(
        "servo", "motorShifts.m1 m2 m3 m4", "words", -12_000, 12_000, "added to the 16-bit word, 31290 per rad", type="I16")]
    direction: Annotated[F32s, 4]  # +1 or -1
    # IMU
    gyro_scale: f32  # [rad/s per count]
    # set-point in G, normally zero: a received correction is already relative to the goal
    target: Annotated[  # x, y, z, yaw
        F32s, 4,
        Settable("", "extCtrl.target_yaw", "rad", -3.141592653589793, 3.141592653589793, first=3, persistent=False),
        Settable("", "setpoint.X Y Z", "m", -5, 5, persistent=False),
        Settable("", "setpoint.Yaw", "rad", -3.141592653589793, 3.141592653589793, first=3, persistent=False),
    ]
    # excitation, for identification; a board that boots excites nothing
    excite_kind: Annotated[i32, Settable("", "excite.signal", "", EXCITE_OFF, EXCITE_CHIRP, type="U8", persistent=False)]
    excite_rms: Annotated[F32s, 4, Settable(
        "excitation", "excite.u1 u2 u3 u4", "rad", 0, 0.3, "rms of what is added to this input, 0: nothing",
        key="u1 u2 u3 u4", persistent=False)]
    excite_low: Annotated[f32, Settable(
        "excitation", "excite.low", "Hz", 0.1, 10, "lower end of the band", key="low", persistent=False)]
    excite_high: Annotated[f32, Settable(
        "excitation", "excite.high", "Hz", 0.1, 10, "upper end of the band", key="high", persistent=False)]
    # supervisor
    pose_timeout_us: Annotated[i32, Settable(
        "supervisor", "supervisor.poseTimeout", "us", 20_000, 5_000_000, "silence after which the flaps go to hover",
        type="U16", scale=1000, shown="ms")]
    low_battery_mv: Annotated[i32, Settable(
        "supervisor", "supervisor.lowBattery", "mV", 0, 20_000, "supply below which flight ends after 5 s", type="U16")]
    # where goals may be: an upright cylinder
    box_radius: Annotated[f32, Settable("box", "box.radius", "m", 1e-6, 5, "from the axis through home", key="radius")]
    box_below: Annotated[f32, Settable("box", "box.below", "m", 0, 5, "below home", key="below")]
    box_above: Annotated[f32, Settable("box", "box.above", "m", 0, 5, "above home", key="above")]
    home: Annotated[F32s, 3]  # [m] W


class Input(Struct):
    """The tasks' inputs to the core; instants wrap."""

    tick: i32  # [ms]
    now_us: i32
    gyro: Annotated[I32s, 3]  # [counts] the newest sample, sensor frame
    gyro_again: i32  # 1: repeats the last sample, because the next is late on a link
    gyro_sum: Annotated[I32s, 3]  # [counts] sum over the samples since the last tick, sensor frame
    gyro_samples: i32
    gyro_bias: Annotated[F32s, 3]  # [counts] the gyro's zero
    # the kind of poses over CRTP
    absolute: Annotated[i32, Settable(
        "predictor", "extPose.absolute", "", 0, 1, "true: poses over CRTP are absolute; false: corrections", type="U8")]
    poses_absolute: i32  # 1: the pose and the set-point are in W; 0: the pose is a correction
    pose_waited_us: i32  # since the pose's arrival
    pose_position: Annotated[F32s, 3]  # [m] of B; in G once it is filed
    pose_quaternion: Annotated[F32s, 4]  # likewise, w x y z
    pose_age_us: i32  # at its arrival, then at the next tick; negative: unknown
    battery_mv: i32
    connected: i32  # a client is connected
    goal_kind: i32  # GOAL_...
    goal: Annotated[F32s, 4]  # x, y, z [m] and yaw [rad]
    goal_velocity: Annotated[F32s, 3]  # [m/s]
    setpoint_kind: i32  # SETPOINT_..., of the commander
    setpoint: Annotated[F32s, 4]  # as the goal; a yaw of NaN keeps the goal's
    setpoint_velocity: Annotated[F32s, 3]
    request: i32  # REQUEST_...
    # MANUAL_...
    manual_mode: Annotated[i32, Settable(
        "", "extCtrl.manual", "", MANUAL_OFF, MANUAL_HOVER, type="U8", persistent=False)]
    mode: i32  # MODE_..., decided by the supervisor
    # flap angles of MODE_MANUAL
    manual: Annotated[F32s, 4, Settable(
        "", "extCtrl.m1 m2 m3 m4", "rad", -1.5707963267948966, 1.5707963267948966, persistent=False)]
    # or servo words, which have priority
    by_words: Annotated[i32, Settable("", "", "", 0, 1, stock="motorPowerSet.enable", type="U8", persistent=False)]
    words: Annotated[I32s, 4, Settable(
        "", "", "words", 0, 65535, stock="motorPowerSet.m1 m2 m3 m4", type="U16", persistent=False)]


class Estimator(Struct):
    """The delayed Kalman filter, its history, and the state predicted to the present."""

    x: Annotated[F32s, 16]  # at `filtered_tick`
    P: Annotated[
        F32s, 16, 16,
        Logged("m^2", stock="kalman.varX varY varZ", step=17),
        Logged("m^2/s^2", stock="kalman.varPX varPY varPZ", first=51, step=17),
        Logged("m^2", "Uncertainty.P_x_x"),
        Logged("m^2/s", "Uncertainty.P_x_vx", first=VELOCITY),
        Logged("m^2/s^2", "Uncertainty.P_vx_vx", first=51),
    ]
    now: Annotated[  # at `tick`: what the controller reads
        F32s, 16,
        Logged("rad/s", "stateEstimate.roll_rate pitch_rate yaw_rate", first=RATE),
        Logged("m/s", stock="kalman.statePX statePY statePZ", first=VELOCITY),
    ]
    tick: i32
    filtered_tick: i32
    quiet_ticks: i32  # since a pose was older than the horizon minus one
    started: i32  # a first pose has been fused
    # history, indexed by tick modulo HISTORY
    gyro: Annotated[F32s, 32, 3]  # [rad/s] body rates
    command: Annotated[F32s, 32, 4]  # [rad] commanded deviation from hover that held from this tick on
    pose: Annotated[F32s, 32, 6]  # position [m] and attitude [rad] in G
    pose_lag: Annotated[F32s, 32]  # [s] the pose was measured this long before its tick
    pose_waiting: Annotated[I32s, 32]
    # a refused pose, kept to distinguish a jump of the goal from an outlier
    suspect: Annotated[F32s, 6]
    suspect_tick: i32
    suspect_waiting: i32
    # counters and values for observers
    fused: Annotated[i32, Logged("", "kalman.fused", type="U32")]
    refused: Annotated[i32, Logged("", "kalman.refused", type="U32")]
    jumps: Annotated[i32, Logged("", "kalman.jumps", type="U32")]
    too_old: Annotated[i32, Logged("", "kalman.too_old", type="U32")]
    invalid: Annotated[i32, Logged("", "kalman.invalid", type="U32")]
    bounded: Annotated[i32, Logged("", "kalman.bounded", type="U32")]
    resets: Annotated[i32, Logged("", "kalman.resets", type="U32")]
    # ticks by which the filter runs behind
    horizon: Annotated[i32, Logged("10 ms", "delayComp.horizon", type="U8")]
    pose_age_us: i32  # of the last pose that was accepted for fusion, at its tick
    no_corrections: i32  # of the invalid poses, those too far from the goal
    frozen: Annotated[i32, Logged("", "kalman.frozen", type="U32")]  # likewise, those that repeat the last one
    # work space, no meaning between ticks
    work_1: Annotated[F32s, 16]
    work_2: Annotated[F32s, 16]
    work_3: Annotated[F32s, 16]
    work_P: Annotated[F32s, 16, 16]


class Control(Struct):
    """The controller's memory and its last output."""

    # u1 roll, u2 pitch, u3 yaw, u4 height
    u: Annotated[F32s, 4]
    u_last: Annotated[F32s, 4]  # of the tick before
    # the mean of both, over one period of telemetry: one tick alone would show u at the same phase of the poses in all rows
    u_mean: Annotated[F32s, 4, Logged("rad", "controller.u1 u2 u3 u4")]
    integral_z: Annotated[f32, Logged("m s", "Error.int_z_err")]
    # commanded flap angles, and the same as deviations from hover
    flap: Annotated[F32s, 4, Logged("rad", "motors_ctrp.m1 m2 m3 m4")]
    command: Annotated[F32s, 4, Logged("rad", "controller.m1 m2 m3 m4")]
    word: Annotated[I32s, 4]
    count: Annotated[I32s, 4, Logged("counts", "floaty.m1 m2 m3 m4", stock="motor.m1 m2 m3 m4", type="U16")]
    excitation: Annotated[F32s, 4, Logged("rad", "excite.u1 u2 u3 u4")]  # its part of u
    excite_tick: i32  # since it was switched on, over all realisations


class Sampling(Struct):
    """The state of the 1 kHz step: its number, the gyro's monitoring, the search for its zero, and repeated poses."""

    tick: i32  # [ms] of the last step
    phase: i32  # its number, modulo the steps of a tick
    estimate_due: i32  # the estimator's tick is due
    before: Annotated[I32s, 3]  # [counts] of the step before
    unchanged: i32  # steps
    recovering: i32  # steps until the gyro counts as alive again
    first: Annotated[I32s, 3]  # [counts] of the window that measures the zero
    sums: Annotated[I32s, 3]  # [counts] of its samples
    squares: Annotated[F32s, 3]  # [counts^2] of its samples' differences from the first
    samples: i32
    # of the last window
    variance: Annotated[F32s, 3, Logged("counts^2", stock="gyro.xVariance yVariance zVariance")]
    windows_refused: i32  # because the robot moved
    calibrated: Annotated[i32, Logged("", "floaty.calibrated", type="U8")]  # the zero is known
    last_position: Annotated[F32s, 3]  # of the last valid pose, as it arrived
    last_quaternion: Annotated[F32s, 4]
    turn: Annotated[F32s, 3]  # [rad] that the gyro has measured since that pose first arrived, sensor frame
    turned_ticks: i32  # since that turn was too large for the same pose; 0: it is not


class Supervisor(Struct):
    """The supervisor's state; times are as of the last call of `supervise`."""

    state: Annotated[i32, Logged("", "supervisor.state", type="U8")]
    cause: Annotated[i32, Logged("", "supervisor.cause", type="U8")]
    armed: Annotated[i32, Logged("", "floaty.armed", stock="sys.armed", type="U8")]
    # for a while or until a reboot
    stopped: Annotated[i32, Logged("", "floaty.stopped", type="U8")]
    locked: i32  # until a reboot
    battery_empty: i32
    not_finite: i32  # the cause, when own logic failed
    lasting: i32  # the cause that neither poses nor arming clear
    ready: i32  # would fly with poses and an IMU, whose failures clear by themselves
    flown: i32  # since the last search for the gyro's zero
    aloft: i32  # the robot may be in the air, or its flaps are moved
    led: i32  # it flies with absolute poses to a commander's set-points
    begun: i32
    now_us: i32  # of the last call
    pose_seen: i32
    silent_us: i32  # since the last accepted pose
    low_us: i32  # since the battery's voltage was good
    down_us: i32  # since the robot was disarmed or stopped
    bounded: i32  # the estimator's counter
    gap_us: i32  # until a bounded step begins a new episode
    episode_us: i32  # since it began
    outside_us: i32  # until the state counts as inside its bounds again
    controller_faults: i32  # of own logic
    estimator_faults: i32


class Report(Struct):
    """The board's report: the state in the frame of the poses, and how many poses were received."""

    position: Annotated[
        F32s, 3, Logged("m", stock="stateEstimate.x y z"), Logged("m", stock="kalman.stateX stateY stateZ")]
    velocity: Annotated[F32s, 3, Logged("m/s", stock="stateEstimate.vx vy vz")]
    attitude: Annotated[F32s, 3]  # [rad] roll, pitch, yaw
    quaternion: Annotated[F32s, 4, Logged("", stock="stateEstimate.qw qx qy qz")]
    flap: Annotated[F32s, 4, Logged("rad", "stateEstimate.flap_1 flap_2 flap_3 flap_4")]  # estimated angles
    age: Annotated[i32, Logged("0.1 ms", "locSrv.age", type="U16")]  # of the last pose, 65535 at most
    poses: Annotated[i32, Logged("", "locSrv.poses", type="U16")]  # received, modulo 65536
    rejected: Annotated[i32, Logged("", "locSrv.rejected", type="U16")]  # of these, refused
# fmt: on
