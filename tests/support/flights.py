"""Flights that tests ask for in a line."""

from pathlib import Path
from typing import Unpack

from hil.experiments import Experiment, find_experiment
from hil.laboratory.request import Options, Request
from hil.laboratory.result import Result
from hil.laboratory.run import fly


def flown(folder: Path, experiment: str | Experiment, *overrides: str, **options: Unpack[Options]) -> Result:
    """Fly an experiment with overrides of its profile."""
    chosen = find_experiment(experiment) if isinstance(experiment, str) else experiment
    return fly(Request.of(chosen, overrides=overrides, **options), folder)


def hover(folder: Path, *overrides: str, **options: Unpack[Options]) -> Result:
    """Fly the hover."""
    return flown(folder, "hover", *overrides, **options)


def explain(result: Result) -> str:
    """Say why a flight that should have passed has not."""
    return f"{result.outcome} {result.cause}: {[str(v) for v in result.verdicts if not v.holds]}, {result.folder}"
