"""An identified model: `floaty identify` writes it as a profile and its uncertainty beside it, `floaty tune` draws robots.

The profile is based on another one: model, servo lag, trim, with the uncertainty as comments. An excited axis takes all
values from the joint fit, even if single constants cannot be separated: with the identities of plates, on which the fit
relies, the profile's model responds like the robot. An axis without an identifiable constant keeps its values.

`mine.json` belongs to `mine.toml`: the identified model, and the covariance of its constants, lag and delay as in the
reported intervals. Without one every constant is known to `UNKNOWN_SHARE`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError
from scipy.stats import qmc

from firmware_py.section import Section
from hil.config import LabConfig, base_name, read_config
from hil.errors import LabError, writing
from hil.laboratory.files.whole_files import write_whole
from hil.research.design.axes import AXES, DELAY, NUISANCES, robot_of
from hil.research.identify.identify import UNKNOWN, Identification
from hil.research.identify.record import Array
from hil.research.identify.response import DELAY as INPUT_TO_GYRO
from hil.research.identify.response import LAG, TICK_DELAYS_S
from hil.research.identify.two_controllers import SIGMAS
from hil.world.floaty.shape import MIX
from hil.world.servos import WORDS_PER_RADIAN

UNKNOWN_SHARE = 0.2  # half a 95 % interval over the value, for a constant of unknown uncertainty
FLAP_RATE = "flap_rate"
TRIM_LEAST = 0.005  # [rad] smallest mean input with a written trim


class KnownModel(Section):
    """The file beside a profile."""

    values: dict[str, float]  # of the profile's [model]
    half_widths: dict[str, float]  # of the 95 % intervals, in the order of the covariance
    covariance: list[list[float]]
    delay: float  # [s] input to gyro


def beside(profile: str) -> Path:
    """Return the path of the file beside a profile."""
    return Path(profile).with_suffix(".json")


def write_profile(path: Path, profile: str, found: Identification) -> str:
    """Write the profile and return its changes besides the model, empty if none.

    Raises `LabError` when nothing was identified, or writing fails.
    """
    if not any(
        constant.verdict != UNKNOWN and constant.name != INPUT_TO_GYRO for constant in found.constants
    ):
        raise LabError(f"--profile-out {path}: nothing was identified that belongs in a profile")
    fitted = found.estimate
    lines = [
        f"# Identified by `floaty identify` from {', '.join(record.name for record in found.records)}.",
        f'base = "{base_name(profile)}"',
        "",
        "[model]                   # value, half width of the 95 % interval, verdict",
    ]
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
        f"# input to gyro {1e3 * fitted.values[INPUT_TO_GYRO]:.1f} ms, of which the firmware's own timing takes 13"
    )
    trim = _trim(found)
    lines += ["", *trim]
    with writing("--profile-out", path):
        write_whole(path, "\n".join(lines).rstrip() + "\n")
        config = read_config(str(path))  # an invalid profile is an error now, not at the next flight
        _write_known(path, config, found, fitted.values[INPUT_TO_GYRO])
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


def _write_known(path: Path, config: LabConfig, found: Identification, delay_s: float) -> None:
    """Write an identification's uncertainty beside its written profile `path`, which loads as `config`."""
    estimate = found.estimate
    assert estimate.covariance is not None
    names = list(estimate.values)
    kept = [index for index, name in enumerate(names) if name not in NUISANCES]
    half = np.array([estimate.errors[name] for name in names])[kept]
    own = estimate.covariance[np.ix_(kept, kept)]
    grown = half / SIGMAS / np.sqrt(np.diag(own))  # curvature makes intervals wider than scatter alone
    known = KnownModel(
        values=config.model.model_dump(),
        half_widths={names[index]: float(width) for index, width in zip(kept, half, strict=True)},
        covariance=(own * np.outer(grown, grown)).tolist(),
        delay=delay_s,
    )
    write_whole(beside(str(path)), known.model_dump_json(indent=1) + "\n")


@dataclass(frozen=True, slots=True)
class Robots:
    """A profile's robot, and others within its uncertainty."""

    nominal: dict[str, float]
    drawn: tuple[dict[str, float], ...]
    about: str


def robots_of(profile: str, config: LabConfig, count: int) -> Robots:
    """Return a profile's robot and `count` drawn from its intervals. Raises `LabError` for a malformed file."""
    file = beside(profile)
    known = _read(file) if profile.endswith(".toml") and file.is_file() else None
    if known is not None and known.values != config.model.model_dump():
        raise LabError(
            f"{file}: it belongs to another [model] than that of {profile}; identify again, or delete it"
        )
    nominal = robot_of(config)
    if known is None:
        names, about = (
            [name for name in nominal if name != DELAY],
            f"every constant within {UNKNOWN_SHARE:.0%}",
        )
        covariance = np.diag([(UNKNOWN_SHARE * nominal[name] / SIGMAS) ** 2 for name in names])
    else:
        names, about = list(known.half_widths), f"the intervals in {file}"
        covariance = np.array(known.covariance)
        nominal[DELAY] = max(known.delay - TICK_DELAYS_S, 0.0)
    return Robots(nominal, _draw(nominal, names, covariance, count), about)


def _read(file: Path) -> KnownModel:
    try:
        known = TypeAdapter(KnownModel).validate_json(file.read_bytes())
        size = len(known.half_widths)
        if [len(row) for row in known.covariance] != [size] * size:
            raise LabError(f"{file}: the covariance of {size} constants has {size} rows and columns")
    except ValidationError as error:
        first = error.errors()[0]
        raise LabError(f"{file}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    return known


def _draw(
    nominal: dict[str, float], names: list[str], covariance: Array, count: int
) -> tuple[dict[str, float], ...]:
    """Return robots, drawn evenly from the normal distribution of a covariance about the nominal one."""
    if not count:
        return ()
    places = [name for name in names if name in nominal or name in (LAG, INPUT_TO_GYRO)]
    chosen = [names.index(name) for name in places]
    own = covariance[np.ix_(chosen, chosen)]
    root = np.linalg.svd(own)  # works for semidefinite matrices, too
    columns = root.U * np.sqrt(root.S)
    size = 1 << (count - 1).bit_length()
    steps = qmc.MultivariateNormalQMC(
        np.zeros(len(places)), rng=np.random.Generator(np.random.PCG64(1))
    ).random(size)
    robots = []
    for row in steps[:count] @ columns.T:
        robot = dict(nominal)
        for name, change in zip(places, row.tolist(), strict=True):
            if name == LAG:
                robot[FLAP_RATE] = 1 / max(1 / nominal[FLAP_RATE] + change, 0.005)
            elif name == INPUT_TO_GYRO:
                robot[DELAY] = max(nominal[DELAY] + change, 0.0)
            else:
                robot[name] = nominal[name] + change
        robots.append(robot)
    return tuple(robots)
