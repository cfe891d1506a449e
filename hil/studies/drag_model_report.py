"""Figure and page of the drag model's test, like the paper's figure drag_model_evaluation."""

import base64
from pathlib import Path

import matplotlib
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from hil.pictures import curves
from hil.pictures.drawing import DPI, STYLE, WIDTH
from hil.studies.drag_model import QUANTITIES, SWEEPS, Row

TEMPLATES = Path(__file__).parents[1] / "pictures" / "templates"
LABELS = ("$F_x$ [N]", "$F_y$ [N]", "$F_z$ [N]", "$T_x$ [N m]", "$T_y$ [N m]", "$T_z$ [N m]")
ROBOTS = {"flat": "flat flaps, as in the paper's test", "kinked": "kinked flaps, as flown"}


def draw(rows: list[Row], hover_deg: float) -> Figure:
    """Draw the rows of one robot and one sweep: forces above, torques below."""
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    angles = [row.angle_deg for row in rows]
    model, mean, deviation = (
        np.array([getattr(row, name) for row in rows]) for name in ("model", "mean", "deviation")
    )
    for index, axes in enumerate(figure.subplots(2, 3, sharex=True).flat):
        low, high = mean[:, index] - deviation[:, index], mean[:, index] + deviation[:, index]
        axes.fill_between(angles, low, high, color=curves.BLUE, alpha=0.2, linewidth=0)
        axes.plot(angles, mean[:, index], "+", color=curves.BLUE, label="measured")
        axes.plot(angles, model[:, index], ".", color="red", markersize=4, label="model")
        axes.axvline(hover_deg, color="black", linestyle="--", linewidth=0.7)
        axes.set_ylabel(LABELS[index])
        if index > 2:
            axes.set_xlabel("flap angle [deg]")
    figure.axes[0].legend()
    return figure


def write(rows: list[Row], hover_deg: float, folder: Path) -> Path:
    """Write a PNG per robot and sweep, and the page that holds them; returns the page's path."""
    shown = []
    for robot, robot_text in ROBOTS.items():
        for sweep in SWEEPS:
            chosen = [row for row in rows if (row.robot, row.sweep) == (robot, sweep.name)]
            path = folder / f"drag_model_{robot}_{sweep.name}.png"
            with matplotlib.rc_context(STYLE):
                draw(chosen, hover_deg).savefig(path, dpi=DPI)
            worst = np.abs([row.model - row.mean for row in chosen]).max(axis=0)
            shown.append(
                {
                    "title": f"{sweep.title}; {robot_text}",
                    "image": base64.b64encode(path.read_bytes()).decode(),
                    "worst": [f"{value:.4f}" for value in worst],
                }
            )
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    page = folder / "drag_model.html"
    text = environment.get_template("drag_model.html.j2").render(shown=shown, quantities=QUANTITIES)
    page.write_text(text, encoding="utf-8")
    return page
