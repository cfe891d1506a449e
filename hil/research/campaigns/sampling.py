"""Flight number i as a pure function of (spec, i): its experiment, profile, seed, settings and faults.

A campaign is a cube: one axis for every varied number, 0..1. A sampling gives points of the cube; each axis has a
distribution that turns its coordinate into a value. Values have nine digits, so that they do not depend on the
processor's logarithm.

    random            independent points; any number of flights
    sobol             fills the cube evenly at any number of flights, best at a power of two
    latin             every axis evenly, for the number of flights in the spec
    saltelli, morris  the designs that Sobol's and Morris' indices need (SALib): N (D + 2) and N (D + 1) points of D axes,
                      of which those of a base row have the same seed
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from hil.config import settings_of
from hil.errors import LabError
from hil.laboratory.experiments import find_experiment
from hil.laboratory.request import Options
from hil.research.campaigns.config import (
    DESIGNS,
    Distribution,
    SampledFault,
    Spec,
    Value,
    spec_text,
    table_dimensions,
)
from hil.research.campaigns.jobs import Job, Plan

DIGITS = 9
LEVELS = 4  # of Morris' grid, as in his paper
_FAULT_PARTS = ("start_s", "duration_s", "size")


@dataclass(frozen=True, slots=True)
class CubeAxis:
    """One axis of the cube: a number that varies, or whether a fault happens."""

    name: str
    varies: Distribution | None  # None: whether the fault happens
    fault: int | None = None  # the fault of the axis


@lru_cache(maxsize=8)
def axes_of(text: str) -> tuple[CubeAxis, ...]:
    """Return the axes of a campaign, by its JSON text."""
    spec = Spec.model_validate_json(text)
    axes = [CubeAxis(name, varies) for name, varies in _parameters(spec)]
    for number, fault in enumerate(spec.faults):
        name = _name(number, fault)
        if fault.probability < 1.0:
            axes.append(CubeAxis(f"{name} happens", None, number))
        for part in _FAULT_PARTS:
            if isinstance(varies := getattr(fault, part), Distribution):
                axes.append(CubeAxis(f"{name} {part}", varies, number))
    return tuple(axes)


def axes(spec: Spec) -> tuple[CubeAxis, ...]:
    return axes_of(spec.model_dump_json())


def _name(number: int, fault: SampledFault) -> str:
    return f"fault {number + 1} {fault.kind}"


def _happens_from(fault: SampledFault) -> float:
    """Return the coordinate above which a fault happens."""
    return 1.0 - fault.probability


def _parameters(spec: Spec) -> list[tuple[str, Distribution]]:
    return [*spec.parameters.items(), *table_dimensions(spec.table)]


def points_of(spec: Spec, first: int = 0, count: int | None = None) -> NDArray[np.float64]:
    """Return points of the cube from `first` on, (count, D), each coordinate in 0..1; by default all."""
    count = spec.points - first if count is None else count
    width = len(axes(spec))
    if width == 0:
        return np.zeros((count, 0))
    if spec.sampling == "random":
        rows = [_own_stream(spec.seed, point, width) for point in range(first, first + count)]
        return np.array(rows).reshape(count, width)
    if spec.sampling == "sobol":
        return _sobol(width, spec.seed, first, count)
    return _design(spec.sampling, width, spec.points, spec.seed)[first : first + count]


def as_flown(spec: Spec, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points of the cube, (N, D), with 1 or 0 for whether a fault happens, and 0.5 for numbers without effect."""
    points, known = points.copy(), axes(spec)
    for column, axis in enumerate(known):
        if axis.varies is None and axis.fault is not None:
            absent = points[:, column] < _happens_from(spec.faults[axis.fault])
            its = [number for number, other in enumerate(known) if other.fault == axis.fault]
            points[:, its] = np.where(absent[:, None], 0.5, points[:, its])
            points[:, column] = ~absent
    return points


def _own_stream(seed: int, point: int, width: int) -> NDArray[np.float64]:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(point,))).random(width)


def _sobol(width: int, seed: int, first: int, count: int) -> NDArray[np.float64]:
    sequence = qmc.Sobol(width, scramble=True, rng=np.random.default_rng(seed))
    if first:  # scipy cannot skip 0 points
        sequence.fast_forward(first)
    # One by one: several at once must be a power of two.
    return np.concatenate([sequence.random(1) for _ in range(count)])


@lru_cache(maxsize=8)
def _design(sampling: str, width: int, points: int, seed: int) -> NDArray[np.float64]:
    if sampling == "latin":
        return np.asarray(qmc.LatinHypercube(width, rng=np.random.default_rng(seed)).random(points))
    from SALib.sample import morris, sobol

    cube = problem(width)
    if sampling == "saltelli":
        base = points // (width + 2)
        return np.asarray(sobol.sample(cube, base, calc_second_order=False, seed=seed))
    return np.asarray(morris.sample(cube, points // (width + 1), LEVELS, seed=seed))


def problem(width: int) -> dict[str, Any]:
    """Return the cube as SALib's problem."""
    return {"num_vars": width, "names": [f"x{n}" for n in range(width)], "bounds": [[0.0, 1.0]] * width}


def per_base(spec: Spec) -> int:
    """Return the number of consecutive points of one base row of a design; 1 for other samplings."""
    return len(axes(spec)) + {"saltelli": 2, "morris": 1}[spec.sampling] if spec.sampling in DESIGNS else 1


def cluster_of(spec: Spec) -> int:
    """Return the number of consecutive similar flights: those of a point, or of a seed if nothing varies."""
    return per_base(spec) * (spec.cells if axes(spec) else spec.cells // spec.seeds)


def shuffled(spec: Spec, values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return values (N,) in `count` random orders, (count, N): as if no axis had any influence."""
    return np.random.default_rng(spec.seed).permuted(np.tile(values, (count, 1)), axis=1)


def check_design(spec: Spec) -> None:
    """Raise `LabError` when a design does not fit the number of flights."""
    if spec.sampling not in DESIGNS:
        return
    width = len(axes(spec))
    if width < 2:
        raise LabError(
            f"sampling = {spec.sampling!r}: needs at least two numbers that vary; there are {width}"
        )
    step = per_base(spec) * spec.cells
    base, rest = divmod(spec.flights, step)
    power = spec.sampling != "saltelli" or base & (base - 1) == 0
    if rest or base < 2 or not power:
        below = max(1, base).bit_length() - 1
        near = [2**below, 2 ** (below + 1)] if spec.sampling == "saltelli" else [base, base + 1]
        allowed = " or ".join(str(step * max(2, one)) for one in dict.fromkeys(max(2, one) for one in near))
        raise LabError(
            f"flights = {spec.flights}: sampling {spec.sampling} with {width} numbers that vary needs {allowed}"
        )


def plan_of(spec: Spec) -> Plan:
    """Return the flights of a campaign of experiments as they are now. Raises `LabError` for an unknown experiment."""
    sources = {name: find_experiment(name).source for name in spec.experiments}

    def job(index: int) -> Job:
        drawn = draw(spec, index)
        return replace(drawn, source=sources[drawn.experiment])

    values = {name: _type_of(varies) for name, varies in _parameters(spec)}
    about = {"spec": spec_text(spec)}
    return Plan(
        about, spec.flights, job, spec.experiments, spec.profiles, values, spec.half_width, cluster_of(spec)
    )


def covered(plan: Plan, out: Path) -> Plan:
    """Return the plan whose flights add their coverage to OUT."""

    def job(index: int) -> Job:
        planned = plan.job(index)
        return replace(planned, options=planned.options | Options(coverage=out.absolute()))

    return replace(plan, job=job)


def _type_of(varies: Distribution) -> type:
    kinds = {type(value) for value in varies.choice or (0.0,)}
    return bool if kinds == {bool} else str if kinds & {bool, str} else float


def draw(spec: Spec, index: int) -> Job:
    """Return flight `index` of a campaign."""
    point, cell = divmod(index, spec.cells)
    return draw_at(spec, points_of(spec, point, 1)[0], index, point, cell)


def draw_at(spec: Spec, shares: NDArray[np.float64], index: int, point: int, cell: int) -> Job:
    """Return the flight at a point of the cube."""
    repetition, which = divmod(cell, len(spec.experiments) * len(spec.profiles))
    experiment, profile = divmod(which, len(spec.profiles))
    base = point // per_base(spec)  # the points of a base row differ by the varied values, not by the wind
    share = dict(zip((axis.name for axis in axes(spec)), shares.tolist(), strict=True))
    parameters = {name: value_at(varies, share[name]) for name, varies in _parameters(spec)}
    faults = (_fault_at(number, fault, share) for number, fault in enumerate(spec.faults))
    options = Options(
        profile=spec.profiles[profile], seed=spec.seed + base * spec.seeds + repetition,
        overrides=(*spec.settings, *settings_of(parameters)),
        faults=tuple(filter(None, faults)), duration_s=spec.duration_s, link=spec.link,
        board=spec.board,
    )  # fmt: skip
    return Job(index, spec.experiments[experiment], options, parameters, limits=spec.limits)


def _fault_at(number: int, fault: SampledFault, share: Mapping[str, float]) -> str:
    name = _name(number, fault)
    if share.get(f"{name} happens", 1.0) < _happens_from(fault):
        return ""
    values = [_number_at(getattr(fault, part), f"{name} {part}", share) for part in _FAULT_PARTS]
    start, duration, size = (None if value is None else repr(value) for value in values)
    return f"{fault.kind}@{start}{f':{duration}' if duration else ''}{f'={size}' if size else ''}"


def _number_at(number: float | Distribution | None, name: str, share: Mapping[str, float]) -> Value | None:
    return value_at(number, share[name]) if isinstance(number, Distribution) else number


def value_at(varies: Distribution, share: float) -> Value:
    """Return the value below which a share of the distribution lies."""
    if varies.choice is not None:
        return varies.choice[min(int(share * len(varies.choice)), len(varies.choice) - 1)]
    if varies.uniform is not None:
        low, high = varies.uniform
        value = low + share * (high - low)
    elif varies.log_uniform is not None:
        low, high = varies.log_uniform
        value = low * (high / low) ** share
    else:
        assert varies.normal is not None
        mean, deviation, *cut = varies.normal
        below, above = (float(ndtr((bound - mean) / deviation)) for bound in cut) if cut else (0.0, 1.0)
        tail = 1e-12  # a design has points at the ends of its axes
        value = mean + deviation * float(ndtri(min(max(below + share * (above - below), tail), 1.0 - tail)))
    return float(f"{value:.{DIGITS}g}")


# Shares near the ends of an axis, where a number that must be whole is not: 0.999 of 100000..200000 is.
LOW, HIGH = 0.00087655, 0.99912345


def check_spec(spec: Spec) -> None:
    """Raise `LabError` for mistakes that show before flying: unknown names, values out of range.

    Checks every experiment and profile, both ends of every axis, and all values of a choice.
    """
    check_design(spec)
    width = len(axes(spec))
    for cell in range(len(spec.experiments) * len(spec.profiles)):
        draw_at(spec, np.full(width, HIGH), 0, 0, cell).request()
    for column, axis in enumerate(axes(spec)):
        count = len(axis.varies.choice) if axis.varies and axis.varies.choice else 1
        for share in (LOW, *((part + 0.5) / count for part in range(count)), HIGH):
            shares = np.full(width, HIGH)  # so that every fault occurs
            shares[column] = share
            draw_at(spec, shares, 0, 0, 0).request()
