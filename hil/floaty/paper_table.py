"""The paper's Table "Empirical estimation of dynamics constants": f_{affected, cause}, value and uncertainty.

SI, axes of W for x y z, the paper's u1..u4 [rad].
"""

PAPER_TABLE: dict[str, tuple[float, float]] = {
    "roll_u1": (230.0, 66.0),
    "roll_roll": (-16.0, 10.0),
    "roll_rate": (-40.0, 12.0),
    "y_u1": (-4.8, 0.1),
    "y_roll": (-6.5, 0.1),
    "pitch_u2": (1100.0, 170.0),
    "pitch_pitch": (-1560.0, 25.0),
    "pitch_rate": (-29.0, 5.0),
    "x_u2": (-0.8, 0.1),
    "x_pitch": (2.5, 0.1),
    "yaw_u3": (110.0, 1.8),
    "yaw_rate": (-7.7, 0.1),
    "z_u4": (2.3, 0.3),
    "z_vz": (-2.0, 0.1),
}
