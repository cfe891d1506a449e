"""The model of the robot as matrices in float64, from the paper's Table: the core's model by other means."""

import numpy as np

from support.core_bench import Vector

G, V = 9.81, 10.0
ROLL = {"u": 230.0, "angle": -16.0, "rate": -40.0, "v": 16.0 / V}  # paper, Table; v: plate identities
PITCH = {"u": -1066.0, "angle": -1560.0, "rate": -29.0, "v": -1560.0 / V}  # u: Methods
Y = {"u": -4.8, "angle": -6.5, "v": -(G - 6.5) / V}
X = {"u": -0.8, "angle": 2.5, "v": -(G - 2.5) / V}
YAW = {"u": 110.0, "rate": -7.7}
Z = {"u": 2.3, "v": -2.0}
FLAP_RATE = 20.0
MIX = np.array([[1, 1, -1, -1], [1, -1, -1, 1], [-1, -1, -1, -1], [-1, 1, -1, 1]])


def model() -> tuple[Vector, Vector]:
    """Return A and B at yaw 0: paper's Table."""
    A = np.zeros((16, 16))
    A[0:3, 3:6] = A[6:9, 9:12] = np.eye(3)
    A[3, [3, 7]] = X["v"], X["angle"]
    A[4, [4, 6]] = Y["v"], Y["angle"]
    A[5, 5] = Z["v"]
    A[9, [4, 6, 9]] = ROLL["v"], ROLL["angle"], ROLL["rate"]
    A[10, [3, 7, 10]] = PITCH["v"], PITCH["angle"], PITCH["rate"]
    A[11, 11] = YAW["rate"]
    from_u = np.zeros((16, 4))
    from_u[[9, 4], 0] = ROLL["u"], Y["u"]
    from_u[[10, 3], 1] = PITCH["u"], X["u"]
    from_u[11, 2], from_u[5, 3] = YAW["u"], Z["u"]
    A[:, 12:16] = from_u @ np.linalg.inv(MIX)
    A[12:16, 12:16] = -FLAP_RATE * np.eye(4)
    return A, FLAP_RATE * np.eye(16)[:, 12:16]
