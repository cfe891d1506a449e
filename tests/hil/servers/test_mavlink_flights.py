"""A served robot flown in lockstep by messages of pymavlink's own making: poses of three kinds, and offboard."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymavlink.dialects.v20.development as dialect
import pytest
from scipy.spatial.transform import Rotation

from ground_station.mocap import MocapFrame
from support.mavlink_lab import MavlinkLab

NED = Rotation.from_euler("x", np.pi)  # W to NED, B to FRD
UNKNOWN = [np.nan] + [0.0] * 20  # covariance
HOME = (0.0, 0.0, 1.15)
STUCK = 2  # FAILURE_TYPE
HOLD, OFFBOARD = 0x03040000, 0x00060000
Pose = Callable[[int, Any, Any], tuple[Any, ...]]


def quaternion(R: Rotation) -> list[float]:
    x, y, z, w = R.as_quat()
    return [w, x, y, z]


def angles(R: Rotation) -> tuple[float, ...]:
    yaw, pitch, roll = R.as_euler("ZYX")
    return roll, pitch, yaw


POSES: dict[str, Pose] = {
    "att_pos_mocap": lambda t_us, p, R: (t_us, quaternion(R), *p),
    "vision_position_estimate": lambda t_us, p, R: (t_us, *p, *angles(R)),
    "odometry": lambda t_us, p, R: (
        *(t_us, dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_FRD, *p, quaternion(R)),
        *(0, 0, 0, 0, 0, 0, UNKNOWN, UNKNOWN, 0, dialect.MAV_ESTIMATOR_TYPE_MOCAP),
    ),
}


def fly_on(kind: str, lab: MavlinkLab) -> None:
    """Send what the cameras see, every fourth of 200 frames per second."""
    seen = 0

    def see(frame: MocapFrame, now_us: int, _: object) -> None:
        nonlocal seen
        seen += 1
        if seen % 4 == 0:
            w, x, y, z = frame.q_WB
            R = NED * Rotation.from_quat((x, y, z, w)) * NED.inv()
            lab.tell(kind, *POSES[kind](frame.t_us, NED.apply(frame.p_WB), R))

    lab.robot.seen_by(see)


def rms_cm(places: list[Any], goal: tuple[float, ...]) -> Any:
    """Of the distance along each axis."""
    return 100 * np.sqrt(np.mean((np.array(places) - goal[:3]) ** 2, axis=0))


@pytest.fixture(params=["odometry", *(pytest.param(kind, marks=pytest.mark.long) for kind in (*POSES,)[:2])])
def lab(request: pytest.FixtureRequest) -> MavlinkLab:
    """A robot that flies on poses of a kind."""
    lab = MavlinkLab()
    fly_on(request.param, lab)
    lab.run(4.0)
    assert lab.robot.free
    return lab


@pytest.mark.long
def test_poses_of_every_kind_fly_the_robot_to_its_goals(lab: MavlinkLab) -> None:
    for goal in (HOME, (0.1, -0.05, 1.3)):
        lab.repeat(goal, 2.0)
        assert max(rms_cm(lab.repeat(goal, 2.0), goal)) < 6.0
    ages_ms = [m.value for m in lab.of("NAMED_VALUE_FLOAT") if m.name == "age_ms"]
    assert ages_ms[-1] == pytest.approx(40.5, abs=2.0)  # camera 20, processing 18, line 1.5 to 4


@pytest.mark.long
def test_frozen_poses_of_every_kind_are_named_and_end_in_the_failsafe_until_they_move(
    lab: MavlinkLab,
) -> None:
    assert lab.command(dialect.MAV_CMD_INJECT_FAILURE, dialect.FAILURE_UNIT_SENSOR_VIO, STUCK) == 0
    lab.run(0.85)
    frozen, failsafe = lab.texts()
    assert frozen == "poses frozen: they stay the same although the robot turns"
    assert failsafe == "supervisor: failsafe, silence"
    counted = {variable.name: variable.read for variable in lab.robot.firmware.variables}
    assert counted["kalman.frozen"]() == pytest.approx(40, abs=5)  # 0.1 s after the first one
    assert lab.command(dialect.MAV_CMD_INJECT_FAILURE, dialect.FAILURE_UNIT_SENSOR_VIO, 0) == 0
    lab.run(1.0)
    assert lab.texts() == ["supervisor: flying"]
    assert lab.place == pytest.approx(HOME, abs=0.3)


@pytest.mark.long
@pytest.mark.parametrize("poses", ["mavlink", "crtp corrections", "crtp poses"])
def test_offboard_flies_to_its_goals_and_holds_the_last_one_when_they_stop(poses: str) -> None:
    absolute = poses == "crtp poses"
    lab = MavlinkLab(
        f"predictor.absolute={str(absolute).lower()}", flying=poses != "mavlink", absolute=absolute
    )
    if poses == "mavlink":
        fly_on("att_pos_mocap", lab)
    lab.run(1.0)
    lab.goal(*HOME)  # with absolute poses nothing flies before that
    lab.run(3.0)
    assert lab.robot.free
    lab.messages.clear()
    assert lab.command(dialect.MAV_CMD_DO_SET_MODE, 1, 6) == 0
    for goal in ((0.0, 0.0, 1.3, 0.0), (0.1, 0.0, 1.3, -np.pi / 2), (0.0, -0.1, 1.15, -np.pi)):
        lab.repeat(goal, 3.0)
        places = lab.repeat(goal, 2.0)
        assert max(rms_cm(places, goal)) < 6.0
        w, _, _, z = lab.robot.body.q_WB
        assert abs(np.degrees(2 * np.arctan2(z, w) - goal[3] + np.pi) % 360 - 180) < 5
    assert lab.of("HEARTBEAT")[-1].custom_mode == OFFBOARD
    target, place = lab.of("POSITION_TARGET_LOCAL_NED")[-1], lab.of("LOCAL_POSITION_NED")[-1]
    assert NED.apply((target.x, target.y, target.z)) == pytest.approx(goal[:3], abs=1e-6)
    assert NED.apply((place.x, place.y, place.z)) == pytest.approx(lab.place, abs=0.05)
    lab.messages.clear()
    lab.run(2.0)
    assert lab.texts() == ["offboard left: no set-points for 0.5 s, holding"]
    assert lab.of("HEARTBEAT")[-1].custom_mode == HOLD
    assert lab.place == pytest.approx(goal[:3], abs=0.06)
