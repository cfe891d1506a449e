"""A flight log as one wide CSV file: a row per 10 ms, a column per quantity, each with its unit in the header.

The first column is the time from the release. Frames are in `log.parquet`, in each column's metadata.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv

from hil.errors import unlinked
from hil.laboratory.files.recorder import load_log, release_of
from hil.laboratory.metrics import column

FILE = "flight.csv"


def write_csv(folder: Path) -> Path:
    """Write `flight.csv` from the log of a run folder and return its path. Raises `LabError` when there is none."""
    log = load_log(folder)
    titles = [f"{field.name} [{(field.metadata or {}).get(b'unit', b'').decode()}]" for field in log.schema]
    seconds = pa.array(np.round(1e-6 * (column(log, "t") - release_of(log.schema.metadata)), 6))
    table = log.rename_columns(titles).set_column(0, "time from the release [s]", seconds)
    path = unlinked(folder / FILE)
    csv.write_csv(table, path)
    return path
