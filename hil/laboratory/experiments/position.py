"""Position: the paper's hover (figure Hover_figure: 30 s at 1.15 m, 20 cm box, 6 cm, 20 deg), its sine in height, 20 cm at
0.05 Hz, and square in y, 10 cm to either side; a figure of eight.

The square's period is that of the author's ground station, 10 s; the flow limits the amplitude: beyond 20 cm from its
axis hovering is not stable (paper, Horizontal tracking performance). The eight is larger, for robots without flow.
"""

from functools import partial

from ground_station.trajectory import Goal, Offsets, Sine, Square, Trajectory
from hil.laboratory.experiment import Experiment
from hil.laboratory.experiments.measures import height_sine, y_steps

BEGIN_S = 1.0  # the robot is at rest after its release
HEIGHT_HZ, SQUARE_HZ = 0.05, 0.1
EIGHT_HZ, EIGHT_M = 0.15, 0.4  # up to 0.53 m/s


def rise_and_sink(home: Goal, release_us: int) -> Trajectory:
    """Swing by 20 cm in height."""
    return Offsets(home, release_us + round(BEGIN_S * 1e6), z=Sine(0.2, HEIGHT_HZ))


def jump_sideways(home: Goal, release_us: int) -> Trajectory:
    """Jump between 10 cm to the left and 10 cm to the right."""
    return Offsets(home, release_us + round(BEGIN_S * 1e6), y=Square(0.1, -0.1, SQUARE_HZ))


def eight(home: Goal, release_us: int) -> Trajectory:
    """Fly a figure of eight, 80 cm long and 40 cm wide."""
    begin_us = release_us + round(BEGIN_S * 1e6)
    return Offsets(home, begin_us, x=Sine(EIGHT_M, EIGHT_HZ), y=Sine(EIGHT_M / 2, 2 * EIGHT_HZ))


HOVER = Experiment(
    name="hover",
    summary="hold one point of the flow for 30 s (paper: 20 cm box, mostly < 6 cm, < 20 deg)",
    duration_s=30.0,
    limits={
        "lost": 0.0, "within_6cm_x": 0.98, "within_6cm_y": 0.98, "within_6cm_z": 0.98, "in_box": 0.995,
        "attitude_max": 0.349066,  # 20 deg
    },
)  # fmt: skip
HEIGHT_SINE = Experiment(
    name="height-sine",
    summary="rise and sink by 20 cm at 0.05 Hz (paper: follows; height gives way to attitude)",
    duration_s=BEGIN_S + 2 / HEIGHT_HZ,
    limits={"lost": 0.0, "gain": 0.90, "lag": 0.20, "rms_z": 0.05, "rms_x": 0.03, "rms_y": 0.02},
    trajectory=rise_and_sink,
    measure=partial(height_sine, HEIGHT_HZ),
    pictures=("height-sine",),
)
Y_SQUARE = Experiment(
    name="y-square",
    summary="jump in y by 20 cm every 5 s, 10 cm to either side (paper: follows)",
    duration_s=BEGIN_S + 2 / SQUARE_HZ,
    limits={"lost": 0.0, "rise": 1.25, "overshoot": 0.20, "hold_rms": 0.01, "rms_x": 0.03, "rms_z": 0.05},
    trajectory=jump_sideways,
    measure=y_steps,
    pictures=("y-square",),
)
EIGHT = Experiment(
    name="figure-eight",
    summary="fly a figure of eight of 80 by 40 cm (profile crazyflie; it leads out of Floaty's flow)",
    duration_s=24.0,
    limits={"lost": 0.0, "rms_x": 0.2, "rms_y": 0.2, "max_x": 0.35, "max_y": 0.35},
    trajectory=eight,
)
FORMATION = Experiment(
    name="formation",
    summary="hold one's place among others for 60 s (with --robots; profile crazyflie in one room)",
    duration_s=60.0,
    limits={"lost": 0.0, "in_box": 0.99, "attitude_max": 0.349066},
)
