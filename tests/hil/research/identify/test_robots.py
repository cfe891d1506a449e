"""What `floaty tune` takes from identification: robots that a model's intervals allow, and what the flow does."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from hil.config import load_config
from hil.errors import LabError
from hil.research.design.axes import DELAY, PITCH, dynamics, robot_of
from hil.research.design.loop import FREQUENCIES
from hil.research.identify.flow import flow_of
from hil.research.identify.record import Record
from hil.research.identify.robots import UNKNOWN_SHARE, KnownModel, beside, robots_of

CONFIG = load_config()
MS = 1e-3


def written(folder: Path, **changes: object) -> str:
    """A profile with a file beside it, in which a and b of yaw hang together."""
    profile = folder / "mine.toml"
    profile.write_text('base = "floaty"\n')
    known = KnownModel(
        values=CONFIG.model.model_dump(),
        half_widths={"yaw_u3": 11.0, "yaw_rate": 0.8, "lag": 0.004, "delay": 0.002},
        covariance=np.diag([30.0, 0.16, 4e-6, 1e-6]).tolist(),
        delay=0.0145,
    ).model_dump()
    known["covariance"][0][1] = known["covariance"][1][0] = -2.0
    beside(str(profile)).write_text(json.dumps(known | changes))
    return str(profile)


def test_robots_are_drawn_from_the_covariance_beside_the_profile(tmp_path: Path) -> None:
    robots = robots_of(written(tmp_path), CONFIG, 512)
    drawn = np.array([(one["yaw_u3"], one["yaw_rate"]) for one in robots.drawn])
    assert np.cov(drawn.T) == pytest.approx(np.array([[30.0, -2.0], [-2.0, 0.16]]), rel=0.1)
    assert drawn.mean(axis=0) == pytest.approx([110.0, -7.7], abs=0.2)
    lags = np.array([1 / one["flap_rate"] for one in robots.drawn])
    assert lags.mean() == pytest.approx(0.05, rel=0.01)
    assert lags.std() == pytest.approx(0.002, rel=0.1)
    assert robots.nominal[DELAY] == pytest.approx(0.0045)
    assert {one["roll_u1"] for one in robots.drawn} == {230.0}, "of which nothing is said"


def test_without_a_file_every_constant_is_known_to_a_fifth() -> None:
    robots = robots_of("floaty", CONFIG, 256)
    spread = np.std([one["pitch_u2"] for one in robots.drawn]) / 1066
    assert 1.96 * spread == pytest.approx(UNKNOWN_SHARE, rel=0.1)
    assert robots_of("floaty", CONFIG, 0).drawn == ()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"values": {"roll_u1": 1.0}}, "belongs to another"),
        ({"covariance": [[1.0]]}, "the covariance of 4 constants has 4 rows"),
        ({"delay": "soon"}, "delay: Input should be a valid number"),
        ({"more": 1}, "more: Extra inputs"),
    ],
)  # fmt: skip
def test_a_file_that_differs_is_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(LabError, match=message):
        robots_of(written(tmp_path, **changes), CONFIG, 8)


def hover(seconds: float) -> tuple[Record, float]:
    """A record of pitch and x in white gusts that the law of `floaty` does not answer, and their spectrum [1/Hz]."""
    rng = np.random.default_rng(5)
    axis, robot = PITCH, robot_of(CONFIG)
    flow, columns = dynamics(axis, robot)
    A, B, *_ = cont2discrete((flow, columns, np.eye(5), np.zeros((5, 3))), MS)
    count = round(seconds / MS)
    u = np.repeat(rng.normal(0, 0.02, count // 100), 100)
    per_hz = 4.0
    torque = rng.normal(0, np.sqrt(per_hz / 2 / MS), count)
    late = np.concatenate([np.zeros(8), u[:-8]])  # delay of the inputs, the gyro's half mean apart
    _, _, x = dlsim((A, B, np.eye(5), np.zeros((5, 3)), MS), np.stack([late, 0 * torque, torque], axis=1))
    rows, poses = np.arange(100, count, 20), np.arange(100, count, 20)
    t = MS * rows
    zero = np.zeros(len(rows))
    averaged = np.convolve(x[:, 3], np.ones(10) / 10)[: len(x)]
    pose = np.stack([x[poses, 0], zero, zero, zero, x[poses, 2], zero], axis=1)
    rates = np.stack([zero, averaged[rows], zero], axis=1)
    inputs = np.stack([zero, 0.5 * (u[rows] + u[rows - 10]), zero, zero], axis=1)
    return Record(
        "hover", t, t, inputs, 0 * inputs, rates, MS * poses + 0.008, pose, 0.0, 0.0, CONFIG, True
    ), per_hz  # fmt: skip


@pytest.mark.long
def test_what_the_model_does_not_explain_is_the_flow() -> None:
    record, per_hz = hover(60.0)
    found = flow_of(record, PITCH, robot_of(CONFIG)).spectrum
    band = (FREQUENCIES > 0.3) & (FREQUENCIES < 8.0)
    assert np.mean(found[band, 1, 1].real) == pytest.approx(per_hz, rel=0.25)
    assert np.mean(found[band & (FREQUENCIES < 1.0), 0, 0].real) < 0.05
