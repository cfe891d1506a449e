"""The names of the board's parameters: on the board those of the original, in a profile section and key.

A board's value is `factor` times the profile's: the gains keep the signs of the original, which counted roll and pitch
inputs with the opposite sign (u1 = -c1, u2 = -c0).
"""

GAINS = {  # name in the original: key in [controller], factor
    "x_P": ("gain_x", -1), "y_P": ("gain_y", -1), "z_P": ("gain_z", 1),
    "vx_P": ("gain_vx", -1), "vy_P": ("gain_vy", -1), "vz_P": ("gain_vz", 1),
    "roll_P": ("gain_roll", -1), "pitch_P": ("gain_pitch", -1), "yaw_P": ("gain_yaw", 1),
    "roll_rate_P": ("gain_p", -1), "pitch_rate_P": ("gain_q", -1), "yaw_rate_P": ("gain_r", 1),
    "z_I": ("gain_iz", 1),
}  # fmt: skip

MODEL = (
    "roll_u1", "roll_roll", "roll_rate", "roll_vy", "y_u1", "y_roll", "y_vy", "pitch_u2", "pitch_pitch", "pitch_rate",
    "pitch_vx", "x_u2", "x_pitch", "x_vx", "yaw_u3", "yaw_rate", "z_u4", "z_vz",
)  # fmt: skip

CORE = {  # section.key: name on the board, where the original has none; no longer than a table of contents allows
    **{f"model.{key}": f"model.{key}" for key in MODEL},
    "estimator.process_position": "FloatyKalm.procPos",
    "estimator.process_velocity": "FloatyKalm.procVel",
    "estimator.process_attitude": "FloatyKalm.procAtt",
    "estimator.process_rate": "FloatyKalm.procRate",
    "estimator.process_flap": "FloatyKalm.procFlap",
    "estimator.measured_position": "FloatyKalm.measPos",
    "estimator.measured_attitude": "FloatyKalm.measAtt",
    "estimator.measured_rate": "FloatyKalm.measRate",
    "estimator.gate_sigma": "FloatyKalm.gateSigma",
    "estimator.gate_position": "FloatyKalm.gatePos",
    "estimator.gate_attitude": "FloatyKalm.gateAtt",
    "estimator.bound_position": "FloatyKalm.maxPos",
    "estimator.bound_velocity": "FloatyKalm.maxVel",
    "estimator.bound_tilt": "FloatyKalm.maxTilt",
    "estimator.bound_rate": "FloatyKalm.maxRate",
    "controller.limit_xy": "extCtrl.limXY",
    "controller.limit_u": "extCtrl.limU",
    "controller.limit_u3": "extCtrl.limU3",
    "controller.limit_iz": "extCtrl.limIz",
    "allocation.opening_min": "RandConsts.openMin",
    "allocation.opening_max": "RandConsts.openMax",
}

OF_PROFILE: dict[str, tuple[str, float]] = {  # section.key: name on the board, factor
    **{f"controller.{key}": (f"extCtrl.{name}", factor) for name, (key, factor) in GAINS.items()},
    "allocation.hover_angle": ("RandConsts.flapHoverAng", 1),
    "model.flap_rate": ("RandConsts.flapTimeConst", 1),
    **{f"excitation.{key}": (f"excite.{key}", 1) for key in ("u1", "u2", "u3", "u4", "low", "high")},
    "predictor.enabled": ("delayComp.activate", 1),
    "predictor.horizon": ("delayComp.horizon", 1),
    "predictor.default_age_us": ("delayComp.defaultAge", 1),
    **{key: (name, 1) for key, name in CORE.items()},
    "supervisor.pose_timeout_us": ("supervisor.poseTimeout", 1e-3),
    "supervisor.low_battery_mv": ("supervisor.lowBattery", 1),
}


TRIMS = tuple(f"motorShifts.m{flap}" for flap in range(1, 5))  # of servo.trim

SIGNALS = ("off", "multisine", "chirp")  # by their numbers in excite.signal


def on_board(name: str) -> tuple[str, float]:
    """The board's name and the factor for a profile's name; any other name is taken as the board's own."""
    return OF_PROFILE.get(name, (name, 1))
