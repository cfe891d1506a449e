"""The viewer's curves for monitoring a flight: rates of the link, the latency budget of poses, marks.

Rates are per second, over the previous second. Marks are the times of refusals.
"""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from hil.laboratory.metrics import column
from hil.pictures.curves import BLUE, GREEN, ORANGE, PINK, RED, SKY, Curves, logged

SECOND_US = 1_000_000
ROWS_OF_A_SECOND = 100


def _stages(rows: pa.Table) -> NDArray[np.float64]:
    """Return the ages of the newest pose behind each stage [ms], (N, 5); NaN where that is not reported."""
    camera, processing, mocap, station, link = column(
        rows, "age.camera", "age.processing", "age.mocap", "age.station", "age.link"
    ).T
    behind = (camera, camera + processing, mocap, mocap + station, mocap + station + link)
    return np.asarray(1e-3 * np.stack(behind, axis=1))


AGE_STAGES = Curves(
    ("camera", "+ processing", "+ network", "+ station", "+ link: on board"), (BLUE, SKY, GREEN, ORANGE, PINK), "ms",
    _stages, needs="age.link",
)  # fmt: skip
BATTERY = logged(("a cell",), (GREEN,), "V", "battery.voltage")
LOAD = logged(("all tasks",), (BLUE,), "%", "board.load")
AIR = logged(("link quality [%]", "RSSI [-dBm]"), (BLUE, ORANGE), "", "link.quality", "link.rssi")
# Counters whose rates the viewer shows.
RATES: Mapping[str, Curves] = {
    "link/rate/radio": logged(
        ("packets up", "packets down"), (BLUE, GREEN), "1/s", "link.up_delivered", "link.down_delivered"
    ),
    "link/rate/station": logged(
        ("poses sent", "frames seen", "telemetry blocks"), (BLUE, GREEN, PINK), "1/s",
        "link.sent", "station.frames", "station.samples",
    ),
}  # fmt: skip
# The colour of a mark, and the counters of a refusal, of which the log may lack some.
MARKS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "pose refused on board": (
        RED, ("estimator.refused", "estimator.too_old", "estimator.invalid", "estimator.rejected"),
    ),
    "pose refused by the tracker": (ORANGE, ("tracker.refused",)),
    "pose too late for the link": (SKY, ("link.late",)),
    "fault": (PINK, ()),
    "operator": (BLUE, ()),
}  # fmt: skip


def rates(rows: pa.Table, counters: Curves, at: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the rates of counters [1/s] at rows `at`, over the second before or its recorded part; (len(at), names)."""
    times, counts = column(rows, "t"), counters.read(rows)
    since = np.searchsorted(times, times[at] - SECOND_US)
    passed = 1e-6 * (times[at] - times[since])[:, None]
    return np.asarray((counts[at] - counts[since]) / np.where(passed > 0, passed, np.nan))


def refused(rows: pa.Table, names: tuple[str, ...]) -> NDArray[np.int64]:
    """Return the rows, except the first, at which any of some counters is larger than in the row before."""
    known = [name for name in names if name in rows.column_names]
    if not known:
        return np.empty(0, np.int64)
    counts = column(rows, *known).reshape(-1, len(known)).sum(axis=1)
    return np.asarray(1 + np.flatnonzero(np.diff(counts) > 0))
