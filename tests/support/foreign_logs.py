"""Logs of other laboratories: the same short path as CSV of several programs, of a micro-SD card and of ROS 2."""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.writer import Writer as Ros2Writer
from scipy.spatial.transform import Rotation

ROWS = 40
T = 0.02 * np.arange(ROWS)  # [s]
PLACE = np.stack((0.1 * np.sin(T), 0.2 * np.cos(T), 1.0 + T), axis=1)  # [m]
ANGLES = np.stack((0.1 * T, -0.2 * T, 0.3 + T), axis=1)  # roll, pitch, yaw [rad]
QUATERNIONS = Rotation.from_euler("ZYX", ANGLES[:, ::-1]).as_quat(scalar_first=True)
DEGREES = np.degrees(ANGLES)


def csv(path: Path, columns: Mapping[str, Any], delimiter: str = ",", decimal: str = ".") -> Path:
    lines = [delimiter.join(columns)]
    for row in zip(*columns.values(), strict=True):
        lines.append(
            delimiter.join(one if isinstance(one, str) else f"{one:.9f}".replace(".", decimal) for one in row)
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def place(x: str, y: str, z: str, scale: float = 1.0) -> dict[str, Any]:
    return dict(zip((x, y, z), scale * PLACE.T, strict=True))


STOCK = {
    "Timestamp": 1e3 * T + 5000, **place("kalman.stateX", "kalman.stateY", "kalman.stateZ", 3.0),
    **place("stateEstimate.x", "stateEstimate.y", "stateEstimate.z"),
    "stateEstimate.roll": DEGREES[:, 0], "stateEstimate.pitch": -DEGREES[:, 1], "stateEstimate.yaw": DEGREES[:, 2],
    "pm.vbat": np.full(ROWS, 3.9),
}  # fmt: skip
FOREIGN: Mapping[str, Mapping[str, Any]] = {
    "cfclient": STOCK,
    "units in brackets": {
        "time [us]": 1e6 * T, **place("x [mm]", "y [mm]", "z [mm]", 1e3),
        "roll (deg)": DEGREES[:, 0], "pitch (deg)": DEGREES[:, 1], "yaw (deg)": DEGREES[:, 2],
    },
    "units in names": {
        "t_ns": 1e9 * T, **place("pos_x_cm", "pos_y_cm", "pos_z_cm", 100.0),
        "roll_rad": ANGLES[:, 0], "pitch_rad": ANGLES[:, 1], "yaw_rad": ANGLES[:, 2],
    },
    "neither, by size": {
        "elapsed time": 1e3 * T, **place("px", "py", "pz", 1e3 * 30), "phi": 10 * DEGREES[:, 0],
        "theta": DEGREES[:, 1], "psi": DEGREES[:, 2],
    },
    "measured beside estimated": {
        "timestamp": 1e6 * T, **place("stateEstimate.x", "stateEstimate.y", "stateEstimate.z", 2.0),
        **place("mocap.pos.x", "mocap.pos.y", "mocap.pos.z"),
        **{f"mocap.q{part}": QUATERNIONS[:, index] for index, part in enumerate("wxyz")},
    },
    "a quaternion": {
        "time": T, **place("position.x", "position.y", "position.z"),
        **{f"orientation.{part}": QUATERNIONS[:, index] for index, part in enumerate("wxyz")},
    },
}  # fmt: skip


def micro_sd(version: int) -> bytes:
    """Return a log of two kinds of events and one that never happened, as tools/usdlog of the firmware reads it."""
    stamp, step = ("<HI", 20) if version == 1 else ("<HQ", 20_000)
    data = b"\xbc" + struct.pack("<HH", version, 3)
    data += struct.pack("<H", 0) + b"fixedFrequency\0" + struct.pack("<H", 3)
    data += b"stateEstimate.x(f)\0stateEstimate.y(f)\0stateEstimate.z(f)\0"
    data += struct.pack("<H", 7) + b"estTDOA\0" + struct.pack("<H", 2) + b"idA(B)\0difference(f)\0"
    data += struct.pack("<H", 9) + b"estTOF\0" + struct.pack("<H", 1) + b"distance(f)\0"
    for row, p in enumerate(PLACE):
        data += struct.pack(stamp, 0, row * step) + struct.pack("<3f", *p)
        if row == 5:
            data += struct.pack(stamp, 7, row * step) + struct.pack("<Bf", 3, 0.5)
    return data + struct.pack("<I", zlib.crc32(data))


ROS_POSE = """\
std_msgs/Header header
geometry_msgs/Pose pose
===
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
===
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
===
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
===
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


def ros_bag(path: Path) -> Path:
    """Write an MCAP file of ROS 2: poses of a goal and of a robot, and a picture's topic in an unknown encoding."""
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        pose = writer.register_msgdef("geometry_msgs/msg/PoseStamped", ROS_POSE.replace("===", 80 * "="))
        text = writer.register_msgdef("std_msgs/msg/String", "string data")
        for number in range(200):
            ns = 5_000_000_000 + number * 10_000_000
            for topic, x in (("/command/pose", 0.5), ("/vrpn/floaty/pose", 0.01 * number)):
                turn = {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
                place = {"position": {"x": x, "y": -0.5, "z": 1.1}, "orientation": turn}
                stamp = {"sec": 5, "nanosec": 0}
                writer.write_message(
                    topic, pose, {"header": {"stamp": stamp, "frame_id": "map"}, "pose": place}, ns, ns
                )
            writer.write_message("/said", text, {"data": "hello"}, ns, ns)
        writer.finish()
    return path


def write_all(folder: Path) -> None:
    """Write each of them, and a map of the first."""
    for name, columns in FOREIGN.items():
        csv(folder / f"{name}.csv", columns)
    (folder / "log00").write_bytes(micro_sd(2))
    ros_bag(folder / "bag.mcap")
    (folder / "mine.toml").write_text(
        'profile = "floaty"\nrelease_s = 0.2\n[columns]\nt = "Timestamp [ms]"\n"cameras.x" = "stateEstimate.x [m]"\n'
        '"cameras.y" = "-stateEstimate.y [m]"\n"cameras.z" = "stateEstimate.z [m]"\n"goal.x" = 0.25\n'
    )
