"""Where the age of a flight's poses came from, out of what its ground station wrote: `telemetry.csv`.

Of a radio in lockstep the station knows no more than what is usual; there its share comes from the flight log.
"""

import csv
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from ground_station.latency import Row, Stage, budget_of
from ground_station.telemetry_log import AGE_COLUMNS
from hil.metrics import column


def ages_of(telemetry: Path, log: pa.Table, link: str) -> tuple[Stage, ...]:
    """The budget of a flight over `link`; empty when no telemetry came."""
    rows = _told(telemetry)
    radio_us = _on_air(log)
    if rows and len(radio_us):
        rows = [
            (*row[:-1], us) for row, us in zip(rows, np.resize(radio_us, len(rows)).tolist(), strict=True)
        ]
    medium = link.partition(":")[0]
    return budget_of(rows, "serial" if medium == "mavlink" else medium)


def _told(telemetry: Path) -> list[Row]:
    """What the station says of the poses that it sent; the last line may be cut."""
    if not telemetry.is_file():
        return []
    with telemetry.open(encoding="utf-8", newline="") as file:
        lines = csv.reader(file)
        titles = next(lines)
        first = titles.index(AGE_COLUMNS[0])
        parts = [line[first : first + len(AGE_COLUMNS)] for line in lines if len(line) == len(titles)]
    rows = [tuple(1e6 * float(part) for part in row) for row in parts]
    return [row for row in rows if not np.isnan(row[-1])]


def _on_air(log: pa.Table) -> NDArray[np.float64]:
    """The time of each uplink packet from sender to board [us], as far as a radio was simulated."""
    if "link.retried" not in log.column_names or log.num_rows < 2:
        return np.empty(0)
    delivered, sum_us = np.diff(column(log, "link.up_delivered", "link.up_latency_sum"), axis=0).T
    times: NDArray[np.float64] = sum_us[delivered > 0] / delivered[delivered > 0]
    return times
