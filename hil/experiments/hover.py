"""Hover: hold one point of the flow, the paper's figure Hover_figure (30 s at 1.15 m, 20 cm box, 6 cm, 20 deg)."""

from hil.laboratory.experiment import Experiment

HOVER = Experiment(
    name="hover",
    summary="hold one point of the flow for 30 s (paper: 20 cm box, mostly < 6 cm, < 20 deg)",
    duration_s=30.0,
    limits={
        "lost": 0.0,
        "within_6cm_x": 0.98,
        "within_6cm_y": 0.98,
        "within_6cm_z": 0.98,
        "in_box": 0.995,
        "attitude_max": 0.349066,  # 20 deg
    },
)
