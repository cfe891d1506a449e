"""A run folder whose log holds random values: every column differs from every other, at all times."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from firmware_py.wire.supervisor import State
from hil.laboratory.files.recorder import RELEASE_US, release_of

SLOWER = 5  # times: the flight lasts longer
SPREAD = {"m": 0.06, "rad": 0.3, "V": 0.2, "us": 4000, "counts": 400}  # of a walk, by unit; else 0.5
RARE = 0.03  # of the rows in which a count goes on


def disturb(folder: Path, seed: int) -> None:
    """Add a random walk to each column of a log, or counts to one of whole numbers; supervisor and time are new."""
    path, rng = folder / "log.parquet", np.random.default_rng(seed)
    log = pq.read_table(path)
    columns, release_us = [], SLOWER * release_of(log.schema.metadata)
    for field in log.schema:
        values, unit = log[field.name].to_numpy(), (field.metadata or {}).get(b"unit", b"").decode()
        walk = SPREAD.get(unit, 0.5) * rng.normal(size=len(values)).cumsum() / len(values) ** 0.5
        counted = (rng.random(len(values)) < RARE).cumsum()
        if field.name == "t":
            values = SLOWER * values
        elif field.name == "supervisor.state":
            values = np.array([*State])[counted % len(State)]
        elif pa.types.is_floating(field.type) or unit == "counts":
            values = values + walk
        elif field.name != "flight.free":
            values = values + (4000 if unit == "us" else 1) * counted
        columns.append(pa.array(values).cast(field.type, safe=False))
    metadata = {**log.schema.metadata, RELEASE_US: str(release_us).encode()}
    pq.write_table(pa.table(columns, schema=log.schema.with_metadata(metadata)), path)
