"""What the log says about a stretch of a flight, in sentences: the robot, the board's belief, its poses, its flaps.

Sentences only state what was recorded; what a log does not hold is left out.
"""

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from hil.laboratory.metrics import column, is_real
from hil.laboratory.recorder import stored_in
from hil.pictures import curves
from hil.pictures.curves import Curves, since_release
from hil.pictures.monitor import REFUSALS

GAP_MS = 50.0  # without a fused pose: worth a sentence
FAR_DEG = 10.0  # of a flap from its command, for longer than a servo needs
FAR_S = 0.1
OUTWARDS = np.array([1.0, -1.0, 1.0, -1.0])  # the sign of an opening flap's angle


def evidence(rows: pa.Table) -> list[str]:
    """Return sentences about rows of a log; none about fewer than two."""
    return [*_robot(rows), *_belief(rows), *_poses(rows), *_flaps(rows)] if rows.num_rows > 1 else []


def _robot(rows: pa.Table) -> Iterator[str]:
    seen = "In truth" if not is_real(rows) else "By the cameras"
    far, turned = _largest(curves.POSITION, rows), _largest(curves.ATTITUDE, rows)
    if far and turned:
        yield f"{seen} the robot was up to {far} away from its goal, and {turned} from its attitude."


def _belief(rows: pa.Table) -> Iterator[str]:
    off, tilted = _largest(curves.POSITION_MISS, rows), _largest(curves.ATTITUDE_MISS, rows)
    if off and tilted:
        yield f"The board's estimate was up to {off} and {tilted} wrong."
    begins, names = curves.changes(rows, curves.SUPERVISOR)
    since = begins * 1e-6 + since_release(rows)[0] - column(rows, "t")[0] * 1e-6
    if len(names) == 1:
        yield f"Its supervisor: {names[0]} all the time."
    else:
        yield f"Its supervisor: {', '.join(f'{n} from {t:.2f} s' for n, t in zip(names, since, strict=True))}."


def _poses(rows: pa.Table) -> Iterator[str]:
    if curves.SINCE_FUSION.needs in rows.column_names:
        gaps = curves.since_fusion(rows)[:, 0]
        if np.isfinite(gaps).any() and (longest := float(np.nanmax(gaps))) > GAP_MS:
            end_s = since_release(rows)[np.nanargmax(gaps)]
            yield f"It fused no pose for {longest:.0f} ms, from {end_s - 1e-3 * longest:.2f} s on."
    for text, names in REFUSALS.items():
        known = [name for name in names if name in rows.column_names]
        count = sum(float(np.ptp(column(rows, name))) for name in known)
        if count > 0:
            yield f"{text.capitalize()}: {count:.0f} times."


def _flaps(rows: pa.Table) -> Iterator[str]:
    hover = stored_in(rows.schema.metadata, "config").get("allocation", {}).get("hover_angle")
    if curves.FLAPS_COMMAND.needs not in rows.column_names or is_real(rows) or hover is None:
        return
    angles, times = curves.FLAPS.read(rows), since_release(rows)
    away = np.abs(angles - curves.FLAPS_COMMAND.read(rows))
    deviations = column(rows, *(f"estimate.flap_{flap}" for flap in (1, 2, 3, 4)))
    believed = np.degrees(OUTWARDS * hover + deviations)
    for flap in range(4):
        if (away[:, flap] > FAR_DEG).mean() * (times[-1] - times[0]) > FAR_S:
            row = int(np.argmax(np.abs(angles - believed)[:, flap]))
            yield (
                f"Flap {flap + 1} was up to {away[:, flap].max():.0f} deg away from its command: at {times[row]:.2f} s it "
                f"stood at {angles[row, flap]:.0f} deg, and the board believed {believed[row, flap]:.0f} deg."
            )


def _largest(curve: Curves, rows: pa.Table) -> str:
    """Return the largest value with its axis and instant; empty where nothing is known."""
    values: NDArray[np.float64] = np.abs(curve.read(rows))
    if not np.isfinite(values).any():
        return ""
    row, axis = np.unravel_index(np.nanargmax(values), values.shape)
    at_s = since_release(rows)[row]
    return f"{values[row, axis]:.1f} {curve.unit} ({curve.names[axis]}, at {at_s:.2f} s)"
