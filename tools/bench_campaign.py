"""Measures the workers of a campaign: `python tools/bench.py --campaign` calls this.

The flights are those of `floaty campaign table`, with a length given by the bench.
"""

import time
from contextlib import closing

import psutil

from hil.research.campaigns.config import find_spec, read_spec
from hil.research.campaigns.jobs import Job, Row, failed, fly_job
from hil.research.campaigns.sampling import plan_of
from hil.research.campaigns.workers import FlyOne, Workers

FLIGHTS = 24
EMPTY_FLIGHTS = 300
SHORT_S, SETTLED, SHORT_FLIGHTS = 0.1, 200, 1200  # flights until memory is measured first and last


def nothing(job: Job) -> Row:
    """Return a row without flying: this leaves drawing the flight and sending job and row."""
    return failed(job, "not flown")


def flights_per_s(flight_s: float, count: int) -> float:
    """Flights per second of wall time on `count` workers, after one warm-up flight of each."""
    with closing(Workers(count)) as workers:
        _timed(workers, flight_s, range(count), fly_job)
        return FLIGHTS / _timed(workers, flight_s, range(count, count + FLIGHTS), fly_job)


def overhead_s() -> float:
    """Wall time per flight of one worker whose flights do nothing."""
    with closing(Workers(1)) as workers:
        _timed(workers, 1.0, range(10), nothing)
        return _timed(workers, 1.0, range(EMPTY_FLIGHTS), nothing) / EMPTY_FLIGHTS


def growth_kb() -> float:
    """Memory that a worker and this process keep per short flight [kB]."""
    with closing(Workers(1)) as workers:
        _timed(workers, SHORT_S, range(SETTLED), fly_job)
        before = _memory()
        _timed(workers, SHORT_S, range(SETTLED, SHORT_FLIGHTS), fly_job)
        return (_memory() - before) / 1e3 / (SHORT_FLIGHTS - SETTLED)


def _timed(workers: Workers, flight_s: float, indices: range, fly_one: FlyOne) -> float:
    spec = read_spec(find_spec("table")).model_copy(update={"duration_s": flight_s, "flights": 2048})
    start = time.perf_counter()
    rows = list(workers.fly(map(plan_of(spec).job, indices), lambda: 0, fly_one))
    assert len(rows) == len(indices)
    return time.perf_counter() - start


def _memory() -> float:
    """Bytes of this process and of all workers."""
    here = psutil.Process()
    return sum(process.memory_info().rss for process in (here, *here.children(recursive=True)))
