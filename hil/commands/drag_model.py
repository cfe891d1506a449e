"""`floaty drag-model`: the mounted robot on the balance."""

import math
from pathlib import Path

import click

from hil.commands.options import (
    announce_compilation,
    console,
    notices,
    profile_option,
    seed_option,
    set_option,
)
from hil.errors import LabError


@click.command("drag-model")
@seed_option
@profile_option
@set_option
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("runs/drag-model"),
    show_default=True,
    metavar="DIR",
)
def drag_model(seed: int, profile: str, overrides: tuple[str, ...], out: Path) -> None:
    """Measure forces and torques on the mounted robot over flap angles, against the paper's simplified model."""
    from rich.progress import track

    from hil.config import load_config
    from hil.studies import drag_model, drag_model_report

    config = load_config(profile, overrides)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LabError(f"--out {out}: cannot be written ({error.strerror or error})") from None
    announce_compilation()
    measured = drag_model.measure(config, seed)
    rows = list(track(measured, "mounted robot", drag_model.ROWS, console=notices, transient=True))
    drag_model.write_csv(rows, out / "drag_model.csv")
    page = drag_model_report.write(rows, math.degrees(config.plant.hover_angle), out)
    console.print(f"report  {page}")
