"""Studies: every one can be flown, outcomes are told apart, expectations are judged, the predictor's cliff is there."""

import dataclasses
import json
import math
import re
from functools import cache
from pathlib import Path

import pytest

from hil.config import load_config
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import parse
from hil.laboratory.metrics import METRICS
from hil.laboratory.request import Options
from hil.pictures.drawing import png
from hil.research.campaigns.jobs import Row, fly_job
from hil.research.design.linear import point_of
from hil.research.design.sweeps import RESERVE
from hil.research.design.trim import speed_at
from hil.research.studies.catalogue import STUDIES
from hil.research.studies.paper_report import _study, study_picture
from hil.research.studies.study import (
    OUTCOMES,
    Curve,
    Expected,
    Study,
    StudyResult,
    Variant,
    VariantOutcome,
    distance,
    flights_of,
    outcome_of,
    summarise,
)
from support.command import Cli


@pytest.mark.parametrize("study", STUDIES.values(), ids=STUDIES)
def test_something_is_expected_of_every_variant_and_only_of_sizes_that_are_flown(study: Study) -> None:
    assert [*study.sizes] in (up := sorted(set(study.sizes)), up[::-1]), "in an order"
    for variant in study.variants:
        said = set(dataclasses.astuple(variant.expected)) - {None}
        assert said, variant.name
        assert said <= set(study.sizes), variant.name


@pytest.mark.long
@pytest.mark.parametrize("study", STUDIES.values(), ids=STUDIES)
def test_sizes_of_a_study_change_the_flight(study: Study) -> None:
    for variant in study.variants:
        changes = {str(variant.change(size)) for size in study.sizes}
        assert len(changes) == len(study.sizes), "no two sizes are the same"


@pytest.mark.parametrize("variant", STUDIES["design-updrafts"].variants, ids=lambda variant: variant.name)
def test_an_updraft_is_flown_at_its_hover_angle_or_the_nearest_that_leaves_the_reserve(
    variant: Variant,
) -> None:
    point, found = point_of(load_config(variant.profile)), []
    fast = speed_at(point.geometry, point.coefficient, point.high - 0.5 * RESERVE)
    for speed in (5.0, 9.5, round(fast, 3)):
        config = load_config(variant.profile, variant.change(speed)["overrides"])
        assert config.tunnel.speed == speed
        found.append(config.allocation.hover_angle)
    assert (found[0], found[2]) == pytest.approx((point.low, point.high - RESERVE), abs=1e-4)
    assert speed_at(point.geometry, point.coefficient, found[1]) == pytest.approx(9.5, rel=1e-3)


profile_of = cache(load_config)
SIZES = {  # what the flight has at a size, by study: a setting, or the size of a fault in its kind's unit
    "latency": (lambda config, size: config.mocap.latency_us + 2000 if size else 2000, lambda size: max(2000, 1000 * size)),
    "loss": (lambda config, size: config.radio.uplink_loss, lambda size: 0.01 * size),
    "jitter": (lambda config, size: config.radio.uplink_jitter_us, lambda size: 1000 * size),
    "outliers": (lambda config, size: config.mocap.outlier, lambda size: 0.01 * size),
    "design-updrafts": (lambda config, size: config.tunnel.speed, lambda size: size),
}  # fmt: skip
FAULTS = {"dropout": "mocap.dropout", "swap": "mocap.swap", "gyro-noise": "imu.noise", "gyro-range": "imu.saturation",
    "servo-stuck": "servo.stuck.1", "servo-slow": "servo.slow.1", "servo-trim": "servo.trim.1", "battery": "battery.sag",
    "design-pushes": "push.roll"}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("study", STUDIES.values(), ids=STUDIES)
def test_a_flight_has_the_size_of_its_study_and_what_the_variant_s_name_says(study: Study) -> None:
    """Sizes are in the study's unit; faults begin 2 s after the release, and last to the end or for the size."""
    mid = {f"gain_{name}": gain for name, gain in (("y", -2.5), ("vy", -0.8), ("roll", 0.3), ("p", 0.18), ("x", -3.5),
        ("vx", -0.8), ("pitch", 0.15), ("q", 0.03), ("yaw", 0.4), ("r", 0.07))}  # fmt: skip
    flights = list(flights_of(study, 1))
    assert len(flights) == len(study.variants) * len(study.sizes)
    for job in flights:
        request, size, name = job.request(), float(job.values["size"]), str(job.values["variant"])
        config, base = request.config, profile_of(request.profile)
        assert request.duration_s == study.duration_s
        assert request.profile == ("floaty" if name.startswith("mid") else re.split(r"[, ]", name)[0])
        assert config.predictor.enabled == ("no predictor" not in name)
        assert config.predictor.age == ("fixed" if "fixed" in name else "measured")
        assert config.predictor.horizon * 10.0 == (40.0 if "40 ms" in name else 10.0 * base.predictor.horizon)
        assert config.tracker.enabled == (base.tracker.enabled and "no tracker" not in name)
        gains = config.controller.model_dump()
        assert gains == base.controller.model_dump() | (mid if name.startswith("mid") else {})
        if study.name in SIZES:
            found, wanted = SIZES[study.name]
            assert (found(config, size), request.faults) == (pytest.approx(wanted(size)), ())
        elif study.name == "model-error":
            ratio = 1.0 + (size if "+" in name else -size) / 100.0
            assert config.model.z_u4 == pytest.approx(
                load_config().model.z_u4 * (1.0 if "couplings" in name else ratio)
            )
            assert config.model.z_vz == pytest.approx(
                load_config().model.z_vz * (1.0 if "inputs" in name else ratio)
            )
        elif not request.faults:
            assert size == {"gyro-noise": 1, "gyro-range": 2000, "servo-slow": 100}.get(study.name, 0)
        else:
            (fault,) = map(parse, map(str, request.faults))
            kind = f"imu.bias.{name[-1]}" if study.name == "gyro-bias" else FAULTS[study.name]
            assert (fault.kind, fault.start_s) == (kind, 2.0)
            lasts = study.unit == "s"
            assert fault.duration_s == (size if lasts else 0.1 if kind == "push.roll" else math.inf)
            unit = KINDS[kind].unit
            assert lasts or fault.size == pytest.approx(0.01 * size if study.unit == "%" else size)
            assert lasts or unit == study.unit or study.unit in ("", "%"), (unit, study.unit)


def test_a_model_error_scales_the_constants_of_its_part_and_no_other() -> None:
    study = STUDIES["model-error"]
    (variant,) = (v for v in study.variants if v.name == "floaty, inputs +")
    cell = {"study": "model-error", "variant": variant.name, "size": 30.0}
    (request,) = (job.request() for job in flights_of(study, 1) if job.values == cell)
    right, wrong = load_config().model.model_dump(), request.config.model.model_dump()
    ratio = {name: wrong[name] / right[name] for name in right}
    inputs = {name for name in right if name[-2:] in ("u1", "u2", "u3", "u4")}
    assert len(inputs) == 6
    assert {name: ratio[name] for name in inputs} == pytest.approx(dict.fromkeys(inputs, 1.3))
    assert {ratio[name] for name in right if name not in inputs} == {1.0}
    assert request.config.plant == load_config().plant, "the world stays right"


def test_the_settings_of_a_size_count_more_than_those_of_its_variant() -> None:
    def lost(size: float) -> Options:
        return Options(overrides={"radio.uplink_loss": size})

    variant = Variant("a", lost, Expected(), settings=("radio.uplink_loss=0.9",))
    jobs = flights_of(Study("s", "?", "loss", "", (0.1, 0.2), (variant,)), 2)
    found = [(job.request().config.radio.uplink_loss, job.request().seed) for job in jobs]
    assert found == [(0.1, 1), (0.1, 2), (0.2, 1), (0.2, 2)]


def unchanged(size: float) -> Options:
    return Options()


def judged(expected: Expected, *cells: str) -> list[str]:
    """What surprises in the cells of sizes 1, 2, 3; a letter per seed: Holds, Degrades, Failsafe, Lost."""
    words = {name[0]: name for name in OUTCOMES}
    variant = Variant("a", unchanged, expected)
    study = Study("s", "?", "size", "m", (1.0, 2.0, 3.0), (variant,))
    flown = [
        VariantOutcome(size, tuple(words[letter] for letter in seeds), ())
        for size, seeds in zip(study.sizes, cells, strict=False)
    ]
    result = StudyResult(study, (Curve(variant, tuple(flown)),))
    assert result.holds == (len(cells) == 3 and not result.surprises(result.curves[0]))
    (told,) = _study(result)["variants"]
    assert told["surprises"] == result.surprises(result.curves[0])
    return result.surprises(result.curves[0])


@pytest.mark.parametrize(
    ("expected", "cells", "surprises"),
    [
        (Expected(holds_to=2), ("hh", "hh", "ll"), []),
        (Expected(holds_to=2), ("hh", "hd", "hh"), ["2 m: 1 holds, 1 degrades"]),
        (Expected(holds_to=1), ("hh", "ll", "ll"), []),
        (Expected(flies_to=2), ("dd", "fh", "ll"), []),
        (Expected(flies_to=2), ("dd", "hl", "ll"), ["2 m: 1 holds, 1 lost"]),
        (Expected(lost_from=2), ("hh", "ll", "ll"), []),
        (Expected(lost_from=2), ("hh", "ll", "lf"), ["3 m: 1 failsafe, 1 lost"]),
        (Expected(lost_from=2), ("hh", "ee", "ll"), ["2 m: 2 error"]),
        (Expected(failsafe_from=2), ("hh", "ff", "fl"), []),
        (Expected(failsafe_from=2), ("hh", "fd", "ll"), ["2 m: 1 degrades, 1 failsafe"]),
        (Expected(holds_to=1, lost_from=3), ("hh", "dl"), []),
    ],
)
def test_surprises_are_reported(expected: Expected, cells: tuple[str, ...], surprises: list[str]) -> None:
    assert judged(expected, *cells) == surprises


def test_an_expectation_is_a_sentence_of_the_bounds_that_it_has() -> None:
    told = "holds the limits up to 1 m, is not lost up to 2 m, is stopped by the supervisor from 3 m, is lost from 4 m"
    assert Expected(1, 2, 3, 4).text("m") == told
    for number, part in enumerate(told.split(", ")):
        assert Expected(*(float(n + 1) if n == number else None for n in range(4))).text("m") == part
    assert Expected(lost_from=2).text("") == "is lost from 2"


def test_the_typical_outcome_is_the_median_and_the_worse_of_two() -> None:
    assert VariantOutcome(1.0, ("lost", "holds", "holds"), ()).typical == "holds"
    assert VariantOutcome(1.0, ("lost", "holds"), ()).typical == "lost"
    assert VariantOutcome(1.0, ("failsafe", "degrades", "lost"), ()).typical == "failsafe"


@pytest.mark.long
def test_the_predictors_cliff() -> None:
    """The author's gains at 40 ms: lost without the predictor, not with it (a prototype: 20 of 20, 0)."""
    cells = {
        (job.values["variant"], job.options["seed"]): outcome_of(fly_job(job))
        for job in flights_of(STUDIES["latency"], 3)
        if job.values["variant"] in ("as-flown, no predictor", "as-flown, measured age")
        and job.values["size"] == 40
    }
    assert len(cells) == 6
    for (name, seed), outcome in cells.items():
        assert outcome == ("lost" if "no predictor" in str(name) else "holds"), (name, seed)


@pytest.mark.long
def test_a_study_that_was_cut_short_has_a_picture_and_does_not_hold() -> None:
    study = STUDIES["loss"]
    job = next(flights_of(study, 1))
    result = summarise(study, [(job, fly_job(job))])
    assert [len(curve.cells) for curve in result.curves] == [1]
    assert not result.holds
    assert png(lambda: study_picture(result)).startswith(b"\x89PNG")


def test_how_far_a_robot_was_from_its_goal_is_known_of_flights_that_were_completed() -> None:
    study = STUDIES["loss"]
    job = next(flights_of(study, 1))
    rows = [
        Row(
            job,
            outcome,
            "",
            True,
            "",
            dict.fromkeys(METRICS, 0.0) | {f"rms_{axis}": 0.01 * n for axis in "xyz"},
            {},
        )
        for n, outcome in enumerate(("completed", "reset", "lost", "error", "completed"))
    ]
    ((cell,),) = (curve.cells for curve in summarise(study, [(job, row) for row in rows]).curves)
    assert cell.outcomes == ("holds", "failsafe", "lost", "error", "holds")
    assert cell.errors == tuple(distance(rows[n].metrics) for n in (0, 4))


@pytest.mark.long
def test_a_study_can_be_flown_alone(cli: Cli, tmp_path: Path) -> None:
    assert cli("study", "loss", "--seeds", "1", "--out", tmp_path / "out") == 0
    names = "campaigns report.html result.json studies.html study-loss.png"
    assert " ".join(sorted(path.name for path in (tmp_path / "out").iterdir())) == names
    (told,) = json.loads((tmp_path / "out" / "result.json").read_text())["studies"]
    assert told["as_expected"] is True
    assert [len(variant["cells"]) for variant in told["variants"]] == [7, 7]
    assert told["variants"][0]["cells"][0]["outcomes"] == ["holds"]
