"""Pushes: forces and torques of a tenth of a second from every side, one after the other (paper, figure robustness c).

The default profile withstands their sizes (x withstands 1 N, but then the robot may need more than the 4 s to climb back,
because attitude takes precedence over height). The last ones are the hardest for the author's gains.
"""

from functools import partial

from hil.experiments.measures import recoveries
from hil.laboratory.experiment import Experiment
from hil.laboratory.faults import Fault

BEGIN_S, EVERY_S, PUSH_S = 2.0, 4.0, 0.1
PUSHES = (
    ("push.z", 2.0), ("push.z", -2.0),  # [N]
    ("push.roll", 0.2), ("push.pitch", 0.2), ("push.yaw", 0.2),  # [N m]
    ("push.x", 0.75), ("push.x", -0.75), ("push.y", 2.0), ("push.y", -2.0),  # [N]
)  # fmt: skip
FAULTS = tuple(
    Fault(kind, BEGIN_S + index * EVERY_S, PUSH_S, size) for index, (kind, size) in enumerate(PUSHES)
)
DURATION_S = BEGIN_S + len(PUSHES) * EVERY_S

PUSHED = Experiment(
    name="pushes",
    summary="nine pushes of 0.1 s: 2 N in z and y, 0.75 N in x, 0.2 N m about each axis (paper: recovers)",
    duration_s=DURATION_S,
    limits={"lost": 0.0, "recovered": float(len(PUSHES)), "excursion": 0.70, "back_in_box": 3.5},
    faults=FAULTS,
    measure=partial(recoveries, FAULTS, DURATION_S),
    pictures=("disturbances",),
)
