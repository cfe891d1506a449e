"""What the parameters of the board are called: on the board as in the original, in a profile by section and key.

A board's value is `factor` times the profile's: the gains keep the signs of the original, which counted roll and pitch
inputs the other way (u1 = -c1, u2 = -c0).
"""

GAINS = {  # name in the original: key in [controller], factor
    "x_P": ("gain_x", -1), "y_P": ("gain_y", -1), "z_P": ("gain_z", 1),
    "vx_P": ("gain_vx", -1), "vy_P": ("gain_vy", -1), "vz_P": ("gain_vz", 1),
    "roll_P": ("gain_roll", -1), "pitch_P": ("gain_pitch", -1), "yaw_P": ("gain_yaw", 1),
    "roll_rate_P": ("gain_p", -1), "pitch_rate_P": ("gain_q", -1), "yaw_rate_P": ("gain_r", 1),
    "z_I": ("gain_iz", 1),
}  # fmt: skip

OF_PROFILE: dict[str, tuple[str, float]] = {  # section.key: name on the board, factor
    **{f"controller.{key}": (f"extCtrl.{name}", factor) for name, (key, factor) in GAINS.items()},
    "allocation.hover_angle": ("RandConsts.flapHoverAng", 1),
    "model.flap_rate": ("RandConsts.flapTimeConst", 1),
    **{f"excitation.{key}": (f"excite.{key}", 1) for key in ("u1", "u2", "u3", "u4", "low", "high")},
    "predictor.enabled": ("delayComp.activate", 1),
    "predictor.horizon": ("delayComp.horizon", 1),
    "estimator.bound_position": ("kalman.maxPos", 1),
    "estimator.bound_velocity": ("kalman.maxVel", 1),
    "supervisor.pose_timeout_us": ("supervisor.poseTimeout", 1e-3),
    "supervisor.low_battery_mv": ("supervisor.lowBattery", 1),
}


SIGNALS = ("off", "multisine", "chirp")  # by their numbers in excite.signal


def on_board(name: str) -> tuple[str, float]:
    """The board's name and the factor of what a profile calls so; any other name is the board's own."""
    return OF_PROFILE.get(name, (name, 1))
