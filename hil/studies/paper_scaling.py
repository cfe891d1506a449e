"""Agility against size, from flights: the paper's robot, half and twice as long, each in its own updraft.

The masses go with the cube of the length, so that the updraft goes with its root (eq. airflow_proportionality). All three
fly an excitation of u3 and one of u1, and `floaty identify` finds from the telemetry alone the acceleration per input.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console

from hil.config import load_config
from hil.design.claims import AGREES, DIFFERS, SCALING, Claim
from hil.errors import LabError
from hil.experiments import find_experiment
from hil.identify.identify import identify
from hil.identify.record import KEPT, load_record
from hil.laboratory.request import Request
from hil.studies.sweep import Job, fly_all

PROFILES = ("design-half", "design-paper", "design-double")
FLIGHTS = {"yaw_u3": "identify-u3", "roll_u1": "identify-u1"}
# [rad] rms, half of what the default robot withstands, because the smallest one drifts by 20 cm with it.
AMPLITUDES = {"identify-u3": 0.03, "identify-u1": 0.025}
DURATION_S = 105.0  # five periods
PAPER, NEAR = -1.0, 0.15  # exponent over the length, and the deviation that "goes with" allows
AGAINST = "At the same hover angle; with servos that are as slow at every size."


def fly_scaling(out: Path, notices: Console) -> list[Claim]:
    """Fly and identify; empty after Ctrl-C. Raises `LabError` for a robot that is lost or not identified."""
    jobs = [
        Job(
            Request.of(
                find_experiment(name),
                profile=profile,
                overrides=(f"excitation.{name[-2:]}={AMPLITUDES[name]}",),
                duration_s=DURATION_S,
            ),
            out / f"{profile}-{name}",
            KEPT,
        )
        for profile in PROFILES
        for name in FLIGHTS.values()
    ]
    results, interrupted = fly_all(jobs, notices)
    if interrupted:
        return []
    for result in results:
        if result.outcome != "completed":
            raise LabError(f"{result.folder}: {result.cause}")
    found = {
        profile: identify([load_record(out / f"{profile}-{name}", profile) for name in FLIGHTS.values()])
        for profile in PROFILES
    }
    length = np.array([load_config(profile).geometry.footprint for profile in PROFILES])
    claims = []
    for constant in FLIGHTS:
        values, halves = np.array([found[profile].constant(constant).joint for profile in PROFILES]).T
        (exponent, _), covariance = np.polyfit(
            np.log(length), np.log(values), 1, w=values / halves, cov="unscaled"
        )
        listed = ", ".join(f"{value:.0f} ± {half:.0f}" for value, half in zip(values, halves, strict=True))
        claims.append(
            Claim(
                f"{constant.split('_')[0]} acceleration per input over l, flown and identified", SCALING,
                f"exponent {PAPER:g}", f"{exponent:.2f} ± {np.sqrt(covariance[0, 0]):.2f} ({listed} 1/s²)",
                AGREES if abs(exponent - PAPER) < NEAR else DIFFERS, AGAINST,
            )
        )  # fmt: skip
    return claims
