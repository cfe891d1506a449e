"""The goal, poses relative to it, and the state in the frame of the poses.

Poses are absolute, in the world frame W, or corrections, in the frame of the ground station's goal; X is that frame.
G is upright at the goal in X, turned by its yaw: p_GB = Rz(-yaw) (p_XB - p_XG). While no goal is known, a correction
is used as the error, and an absolute pose becomes the goal, so that the robot stays where it is.
"""

from firmware_py.core.maths import HALF, TWO, ZERO, atan2, cos, finite, sin, wrap
from firmware_py.core.structs import (
    ATTITUDE,
    FLAP,
    GOAL_ABSOLUTE,
    GOAL_NONE,
    GOAL_OF_CORRECTIONS,
    POSE_NO_CORRECTION,
    POSE_ON_TIME,
    POSITION,
    SETPOINT_NONE,
    SETPOINT_OF_CORRECTIONS,
    SETPOINT_OTHER,
    SETPOINT_OUTSIDE,
    SETPOINT_POSITION,
    VELOCITY,
    Control,
    Estimator,
    Input,
    Parameters,
    Report,
)
from firmware_py.core.subset import F32s, f32, i32, kernel, sqrt

# Largest distance from the goal in a correction [m]: the flow is 0.9 m wide, the cameras see 0.85 m above
# the hover point and goals are at most 0.65 m below it; a take-off begins 1.1 m below the goal.
SIDEWAYS = f32(0.9)
BELOW = f32(2.0)
ABOVE = f32(1.0)
UNIT_TOLERANCE = f32(0.2)  # on the squared length of a quaternion
POSE_LIMIT = f32(100.0)  # [m]
AGE_UNIT_US = 100  # of the reported age
AGE_LIMIT = 65535
COUNTERS = 65536  # reported counters are modulo this


@kernel
def excess(parameters: Parameters, data: Input, place: F32s) -> f32:
    """Return how far a place is outside the box [m], 0 inside; with corrections the box is around their origin."""
    x = place[0]
    y = place[1]
    z = place[2]
    if data.poses_absolute != 0:
        x = x - parameters.home[0]
        y = y - parameters.home[1]
        z = z - parameters.home[2]
    outside = sqrt(x * x + y * y) - parameters.box_radius
    if -z - parameters.box_below > outside:
        outside = -z - parameters.box_below
    if z - parameters.box_above > outside:
        outside = z - parameters.box_above
    if outside < ZERO:
        return ZERO
    return f32(outside)


@kernel
def admits(parameters: Parameters, data: Input) -> i32:
    """Return whether the set-point is in the box, or at most as far outside as the goal."""
    for axis in range(3):
        if not finite(data.setpoint[axis]):
            return i32(0)
    allowed = ZERO
    if data.goal_kind != GOAL_NONE:
        allowed = excess(parameters, data, data.goal)
    if excess(parameters, data, data.setpoint) <= allowed:
        return i32(1)
    return i32(0)


@kernel
def follow(parameters: Parameters, data: Input) -> i32:
    """Make the commander's set-point the goal; return SETPOINT_POSITION, or why it is not the goal."""
    if data.setpoint_kind == SETPOINT_NONE:
        return i32(SETPOINT_NONE)
    if data.poses_absolute == 0:
        return i32(SETPOINT_OF_CORRECTIONS)
    if data.setpoint_kind != SETPOINT_POSITION:
        return i32(SETPOINT_OTHER)
    for axis in range(3):
        if not finite(data.setpoint[axis]):
            return i32(SETPOINT_OTHER)
    if admits(parameters, data) == 0:
        return i32(SETPOINT_OUTSIDE)
    for axis in range(3):
        data.goal[axis] = data.setpoint[axis]
        data.goal_velocity[axis] = data.setpoint_velocity[axis]
    if finite(data.setpoint[3]):
        data.goal[3] = data.setpoint[3]
    data.goal_kind = i32(GOAL_ABSOLUTE)
    return i32(SETPOINT_POSITION)


@kernel
def valid_pose(data: Input) -> bool:
    """Return whether the pose's numbers are plausible."""
    length = ZERO
    for i in range(4):
        length = length + data.pose_quaternion[i] * data.pose_quaternion[i]
    if not abs(length - f32(1.0)) <= UNIT_TOLERANCE:
        return False
    for axis in range(3):
        if not abs(data.pose_position[axis]) <= POSE_LIMIT:
            return False
    return True


@kernel
def is_correction(data: Input) -> bool:
    """Return whether the robot can be that far from its goal."""
    x = data.pose_position[0]
    y = data.pose_position[1]
    z = data.pose_position[2]
    return bool(sqrt(x * x + y * y) <= SIDEWAYS and z >= -BELOW and z <= ABOVE)


@kernel
def become_goal(data: Input) -> None:
    """Make the robot's pose the goal."""
    w = data.pose_quaternion[0]
    x = data.pose_quaternion[1]
    y = data.pose_quaternion[2]
    z = data.pose_quaternion[3]
    for axis in range(3):
        data.goal[axis] = data.pose_position[axis]
        data.goal_velocity[axis] = ZERO
    data.goal[3] = atan2(TWO * (w * z + x * y), w * w + x * x - y * y - z * z)
    data.goal_kind = i32(GOAL_ABSOLUTE)


@kernel
def turn_into_goal_frame(data: Input) -> None:
    """Turn the pose into the goal frame."""
    dx = data.pose_position[0] - data.goal[0]
    dy = data.pose_position[1] - data.goal[1]
    sine = sin(data.goal[3])
    cosine = cos(data.goal[3])
    data.pose_position[0] = cosine * dx + sine * dy
    data.pose_position[1] = cosine * dy - sine * dx
    data.pose_position[2] = data.pose_position[2] - data.goal[2]
    sine = sin(HALF * data.goal[3])
    cosine = cos(HALF * data.goal[3])
    w = data.pose_quaternion[0]
    x = data.pose_quaternion[1]
    y = data.pose_quaternion[2]
    z = data.pose_quaternion[3]
    data.pose_quaternion[0] = cosine * w + sine * z  # the conjugate of q_XG times q_XB
    data.pose_quaternion[1] = cosine * x + sine * y
    data.pose_quaternion[2] = cosine * y - sine * x
    data.pose_quaternion[3] = cosine * z - sine * w


@kernel
def see_from_goal(data: Input, estimator: Estimator) -> i32:
    """Turn a valid pose into the error to the goal; return POSE_ON_TIME, or why it is refused."""
    if data.poses_absolute == 0:
        if not is_correction(data):
            estimator.invalid = i32(estimator.invalid + 1)
            estimator.no_corrections = i32(estimator.no_corrections + 1)
            return i32(POSE_NO_CORRECTION)
        if data.goal_kind != GOAL_OF_CORRECTIONS:
            data.goal_kind = i32(GOAL_NONE)
    elif data.goal_kind != GOAL_ABSOLUTE:
        become_goal(data)
    if data.goal_kind != GOAL_NONE:
        turn_into_goal_frame(data)
    return i32(POSE_ON_TIME)


@kernel
def report_motion(data: Input, estimator: Estimator, report: Report) -> None:
    """Write position, velocity and yaw in X."""
    yaw = ZERO
    if data.goal_kind != GOAL_NONE:
        yaw = data.goal[3]
    report.attitude[0] = estimator.now[ATTITUDE]
    report.attitude[1] = estimator.now[ATTITUDE + 1]
    report.attitude[2] = wrap(estimator.now[ATTITUDE + 2] + yaw)
    for axis in range(3):
        report.position[axis] = estimator.now[POSITION + axis]
        report.velocity[axis] = estimator.now[VELOCITY + axis]
    if data.goal_kind == GOAL_NONE:
        return
    sine = sin(yaw)
    cosine = cos(yaw)
    report.position[0] = cosine * estimator.now[POSITION] - sine * estimator.now[POSITION + 1]
    report.position[1] = sine * estimator.now[POSITION] + cosine * estimator.now[POSITION + 1]
    report.velocity[0] = cosine * estimator.now[VELOCITY] - sine * estimator.now[VELOCITY + 1]
    report.velocity[1] = sine * estimator.now[VELOCITY] + cosine * estimator.now[VELOCITY + 1]
    for axis in range(3):
        report.position[axis] = data.goal[axis] + report.position[axis]
        report.velocity[axis] = data.goal_velocity[axis] + report.velocity[axis]


@kernel
def report_quaternion(report: Report) -> None:
    """Write the attitude's quaternion."""
    cr = cos(HALF * report.attitude[0])
    sr = sin(HALF * report.attitude[0])
    cp = cos(HALF * report.attitude[1])
    sp = sin(HALF * report.attitude[1])
    cy = cos(HALF * report.attitude[2])
    sy = sin(HALF * report.attitude[2])
    report.quaternion[0] = cr * cp * cy + sr * sp * sy
    report.quaternion[1] = sr * cp * cy - cr * sp * sy
    report.quaternion[2] = cr * sp * cy + sr * cp * sy
    report.quaternion[3] = cr * cp * sy - sr * sp * cy


@kernel
def report_state(data: Input, estimator: Estimator, control: Control, report: Report) -> None:
    """Write the board's report of its state."""
    report_motion(data, estimator, report)
    report_quaternion(report)
    for flap in range(4):
        report.flap[flap] = estimator.now[FLAP + flap] + (control.flap[flap] - control.command[flap])
    report.age = i32(0)
    if estimator.pose_age_us > 0:
        report.age = i32(estimator.pose_age_us // AGE_UNIT_US)
    if report.age > AGE_LIMIT:
        report.age = i32(AGE_LIMIT)
    rejected = estimator.refused + estimator.too_old + estimator.invalid
    report.rejected = i32(rejected % COUNTERS)
    report.poses = i32((estimator.fused + estimator.jumps + rejected) % COUNTERS)
