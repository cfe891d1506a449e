"""Finds the release of an imported flight: where its path fits that of another one best."""

import numpy as np
import pyarrow as pa

from hil.errors import LabError
from hil.laboratory.files.joined import Joined
from hil.laboratory.files.log_map import Map, read_column
from hil.laboratory.files.tables import Values
from hil.laboratory.metrics import body, column, free_flight

FIT_US, FITS_MAX = 20_000, 2000  # the steps in which paths are shifted, and how many


def released_like(what: str, joined: Joined, chosen: Map, like: pa.Table) -> Map:
    """Return a map whose release is where the path of another flight since its own fits best, whatever their offset."""
    group = "truth" if "truth.x" in chosen.columns else "cameras"
    sources = [(f"{group}.{axis}", chosen.columns.get(f"{group}.{axis}", 0.0)) for axis in "xyz"]
    path = np.stack([read_column(what, joined, name, source)[0] for name, source in sources], axis=1)
    seen, flown = np.isfinite(path).all(axis=1), free_flight(like)
    if flown.num_rows < 2 or seen.sum() < 2:
        raise LabError(f"{what}: --like: both flights need some rows after the release")
    times, path = joined.t_us[seen], path[seen]
    since, wanted = column(flown, "t") - column(flown, "t")[0], body(flown, "x", "y", "z")
    length = times[-1] - times[0]
    step = max(FIT_US, (length + since[-1]) / FITS_MAX)
    shifts = np.arange(times[0] - since[-1] + 0.5 * min(since[-1], length), times[-1], step)
    for finer in (step, step / 10):
        apart = [_apart(times - shift, path, since, wanted, step) for shift in shifts.tolist()]
        best = int(np.argmin(apart))
        at_us, shifts = float(shifts[best]), shifts[best] + np.arange(-10, 11) * finer / 10
    how = f"where both paths fit best: {100 * apart[best]:.2g} cm apart"
    joined.notes.append(f"released at {1e-6 * at_us:.2f} s of its clock, {how}")
    return chosen.model_copy(update={"release_s": round(1e-6 * at_us, 4)})


def _apart(times: Values, path: Values, since: Values, wanted: Values, step: float) -> float:
    """Return how far apart two paths [m] are where they overlap, rms, without their mean; infinite if less than half."""
    least, most = max(times[0], since[0]), min(times[-1], since[-1])
    if most - least < 0.5 * min(times[-1] - times[0], since[-1] - since[0]):
        return np.inf
    grid = np.arange(least, most, step)
    other = [
        np.interp(grid, since, wanted[:, axis]) - np.interp(grid, times, path[:, axis]) for axis in range(3)
    ]
    return float(np.sqrt(np.mean(np.var(other, axis=1))))
