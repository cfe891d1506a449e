"""Agility against size, from flights: the paper's robot, half and twice as long, each in its own updraft.

The masses grow with the cube of the length, so that the updraft grows with its root (eq. airflow_proportionality). All
three fly excitations of u3 and u1, and `floaty identify` estimates the acceleration per input from telemetry alone.
"""

from pathlib import Path

import numpy as np

from hil.campaigns.run import Runner
from hil.config import load_config
from hil.design.claims import AGREES, DIFFERS, SCALING, Claim
from hil.laboratory.request import Options
from hil.studies.paper_identification import identified

PROFILES = ("design-half", "design-paper", "design-double")
FLIGHTS = {"yaw_u3": "identify-u3", "roll_u1": "identify-u1"}
# [rad] rms, half of what the default robot withstands; the smallest one drifts by 20 cm with it.
AMPLITUDES = {"identify-u3": 0.03, "identify-u1": 0.025}
DURATION_S = 113.0  # five realisations
PAPER, NEAR = -1.0, 0.15  # exponent over the length, and the deviation that "goes with" allows
AGAINST = "At the same hover angle; with servos that are as slow at every size."


def fly_scaling(out: Path, runner: Runner) -> list[Claim]:
    """Fly and identify; empty after Ctrl-C. Raises `LabError` for a lost or unidentified robot."""
    rows = runner.log(
        "scaling",
        {
            f"{profile}-{name}": (
                name,
                Options(
                    profile=profile, overrides=(f"excitation.{name[-2:]}={AMPLITUDES[name]}",), seed=1,
                    duration_s=DURATION_S,
                ),
            )
            for profile in PROFILES
            for name in FLIGHTS.values()
        },
        out,
    )  # fmt: skip
    if not rows:
        return []
    of_each = len(FLIGHTS)
    found = {
        profile: identified(rows[of_each * number : of_each * (number + 1)])
        for number, profile in enumerate(PROFILES)
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
