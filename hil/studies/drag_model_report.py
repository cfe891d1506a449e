"""Figures, table and page of the drag model's test, like the paper's figure drag_model_evaluation."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hil.pictures import curves
from hil.pictures.drawing import WIDTH, png
from hil.pictures.pages import PageFigure, data_uri, write_page
from hil.studies.drag_model import QUANTITIES, SWEEPS, MountedRow, write_csv

LABELS = ("$F_x$ [N]", "$F_y$ [N]", "$F_z$ [N]", "$T_x$ [N m]", "$T_y$ [N m]", "$T_z$ [N m]")
ROBOTS = {"flat": "flat flaps, as in the paper's test", "kinked": "kinked flaps, as flown"}
OPERATIONAL_DEG = 50  # flap angles of flight, in the steps of the test


def _draw(rows: Sequence[MountedRow], hover_deg: float) -> Figure:
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


def write(rows: Sequence[MountedRow], hover_deg: float, folder: Path) -> tuple[Path, list[PageFigure]]:
    """Write the table, a PNG per robot and sweep and the page that holds them; return page and figures."""
    write_csv(rows, folder / "drag_model.csv")
    figures, worst = [], []
    for robot, robot_text in ROBOTS.items():
        for sweep in SWEEPS:
            chosen = [row for row in rows if (row.robot, row.sweep) == (robot, sweep.name)]
            picture = png(lambda chosen=chosen: _draw(chosen, hover_deg))
            (folder / f"drag_model_{robot}_{sweep.name}.png").write_bytes(picture)
            misses = np.abs([row.model - row.mean for row in chosen])
            worst.append((f"{sweep.title}; {robot_text}", [f"{value:.4f}" for value in misses.max(axis=0)]))
            flown = misses[[0 <= row.angle_deg <= OPERATIONAL_DEG for row in chosen]].max(axis=0)
            caption = (
                f"{sweep.title}. From 0 to {OPERATIONAL_DEG} degrees model and measurement differ by at most "
                f"{flown[:3].max():.2f} N and {flown[3:].max():.3f} N m."
            )
            title = f"Drag model, {robot_text}"
            figures.append(PageFigure(f"{robot}-{sweep.name}", title, caption, data_uri(picture)))
    page = folder / "drag_model.html"
    return write_page(
        page, "drag_model.html.j2", figures=figures, worst=worst, quantities=QUANTITIES
    ), figures
