"""Writes a profile with the identified constants, based on another one: model, servo lag, trim, with the uncertainty as
comments, and in a file beside it for `floaty tune`.

An excited axis takes all values from the joint fit, even if single constants cannot be separated: with the identities of
plates, on which the fit relies, the profile's model responds like the robot. An axis without an identifiable constant
keeps its values.
"""

from pathlib import Path

import numpy as np

from hil.config import base_name, load_config
from hil.design.axes import AXES, NUISANCES
from hil.errors import LabError, writing
from hil.floaty.shape import MIX
from hil.identify.identify import UNKNOWN, Identification
from hil.identify.response import DELAY, LAG
from hil.identify.robots import write_known
from hil.world.servos import WORDS_PER_RADIAN

TRIM_LEAST = 0.005  # [rad] smallest mean input with a written trim


def write_profile(path: Path, profile: str, found: Identification) -> str:
    """Write the profile and return its changes besides the model, empty if none.

    Raises `LabError` when nothing was identified, or writing fails.
    """
    if not any(constant.verdict != UNKNOWN and constant.name != DELAY for constant in found.constants):
        raise LabError(f"--profile-out {path}: nothing was identified that belongs in a profile")
    fitted = found.estimate
    lines = [
        f"# Identified by `floaty identify` from {', '.join(record.name for record in found.records)}.",
        f'base = "{base_name(profile)}"',
        "",
    ]
    lines.append("[model]                   # value, half width of the 95 % interval, verdict")
    for axis in AXES:
        if all(found.constant(name).verdict == UNKNOWN for name in axis.constants):
            continue
        for name in axis.constants:
            constant = found.constant(name)
            if name in NUISANCES or name not in fitted.values:
                continue
            text = f"{name} = {fitted.values[name]:.6g}"
            lines.append(f"{text:26}# ± {constant.joint[1]:.2g}, {constant.verdict}")
    lag = found.constant(LAG)
    verdict = f"lag {1e3 * lag.joint[0]:.1f} ± {1e3 * lag.joint[1]:.1f} ms, {lag.verdict}"
    lines.append(f"{f'flap_rate = {1 / fitted.values[LAG]:.4g}':26}# {verdict}")
    lines.append(
        f"# input to gyro {1e3 * fitted.values[DELAY]:.1f} ms, of which the firmware's own timing takes 13"
    )
    trim = _trim(found)
    lines += ["", *trim]
    with writing("--profile-out", path):
        path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
    config = load_config(str(path))  # an invalid profile is an error now, not at the next flight
    with writing("--profile-out", path):
        write_known(path, config, found, fitted.values[DELAY])
    return f"servo trim changed: {trim[1].partition('# ')[2]}" if trim else ""


def _trim(found: Identification) -> list[str]:
    """Return the section [servo] that makes the mean inputs zero, empty if they are."""
    mean = np.mean([record.u.mean(axis=0) for record in found.records], axis=0)
    if np.all(np.abs(mean) < TRIM_LEAST):
        return []
    servo = found.records[0].config.servo
    turned = WORDS_PER_RADIAN * np.array(servo.direction) * (MIX @ mean)
    trim = [round(old + more) for old, more in zip(servo.trim, turned.tolist(), strict=True)]
    shown = ", ".join(f"{1e3 * value:.0f}" for value in mean)
    return ["[servo]", f"trim = {trim}   # the flights needed u1..u4 of {shown} mrad on the mean"]
