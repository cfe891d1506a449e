"""Campaigns of flights that are not flown: what the tests hand to datasets, reports and workers."""

import math
import os
import signal
import time
from pathlib import Path

from hil.laboratory.metrics import METRICS
from hil.research.campaigns.config import Spec
from hil.research.campaigns.jobs import Job, Row

BAD_PUSH = 8.0  # [N] from here on the planted robot fails


def spec_of(**values: object) -> Spec:
    """A campaign of the hover over one parameter and a push that half of the flights get."""
    push = {
        "kind": "push.y", "probability": 0.5, "start_s": 0.1, "size": {"uniform": [1.0, 12.0]},
    }  # fmt: skip
    tree: dict[str, object] = {
        "experiments": ["hover"],
        "duration_s": 0.3,
        "flights": 40,
        "parameters": {"actuators.tau": {"uniform": [0.04, 0.06]}},
        "faults": [push],
    }
    return Spec.model_validate(tree | values)


def planted(job: Job) -> Row:
    """A flight that fails by its push alone, at once."""
    faults = job.options["faults"]
    size = float(str(faults[0]).partition("=")[2]) if faults else 0.0
    known = {"max_y": size / 100.0, "in_box": 1.0 - size / 1000.0, "flown": 0.3, "rms_x": math.nan}
    metrics = dict.fromkeys(METRICS, 0.0) | known
    passed = size < BAD_PUSH
    return Row(job, "completed", "", passed, f"{job.index:064x}", metrics, {"in_box": passed})


def raising(job: Job) -> Row:
    """The third flight raises."""
    if job.index == 3:
        raise ZeroDivisionError("planted")
    return planted(job)


def killing(job: Job) -> Row:
    """The third flight kills its process, each time; the fifth the first time only."""
    once = Path(job.options["overrides"][0])  # a path of the test's
    if job.index == 3 or (job.index == 5 and not once.exists()):
        if job.index == 5:
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return planted(job)


def hanging(job: Job) -> Row:
    """The third flight hangs where nobody can ask it for anything."""
    while job.index == 3:
        time.sleep(0.05)
    return planted(job)
