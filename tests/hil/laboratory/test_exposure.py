"""Poses in the log of a real flight belong to the instant of their row, not to that of their arrival."""

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from hil.laboratory.files.ages import at_exposure

NAMES = ("x", "y", "z", "vx", "vy", "vz", "p", "q", "r")
PERIOD_US, FRAME_US, AGE_US = 10_000, 5_000, 38_000


def place(t_us):
    return np.stack([np.sin(2e-6 * t_us + index) for index in range(len(NAMES))], axis=-1)


def rotation(t_us):
    return Rotation.from_euler("ZYX", np.stack((3e-6 * t_us, 0.1 + 0 * t_us, 0.2 + 0 * t_us), axis=-1))


def log_of(exposed, times, sign=1.0):
    x, y, z, w = sign * rotation(exposed).as_quat().T
    columns = {"t": times.astype(np.int64), "cameras.exposed": exposed}
    columns |= {f"cameras.{name}": values for name, values in zip(NAMES, place(exposed).T, strict=True)}
    columns |= dict(zip(("cameras.qw", "cameras.qx", "cameras.qy", "cameras.qz"), (w, x, y, z), strict=True))
    return pa.table({**columns, "goal.x": exposed})


def rows(count):
    times = np.arange(count) * float(PERIOD_US) + 1_000_000
    return times, (times - AGE_US) // FRAME_US * FRAME_US + 2_000  # between two rows


def test_a_pose_is_placed_at_its_exposure():
    times, exposed = rows(300)
    log = at_exposure(log_of(exposed, times))
    known = slice(0, 296)  # what the cameras saw in the last 38 ms nobody has been told
    for index, name in enumerate(NAMES):
        values = log.column(f"cameras.{name}").to_numpy()
        assert values[known] == pytest.approx(place(times)[known, index], abs=1e-3)
        assert np.isnan(values[-3:]).all()
    assert log.column("goal.x").to_numpy() == pytest.approx(exposed)  # the rest stays


def test_a_rotation_goes_the_short_way_whatever_the_signs():
    times, exposed = rows(300)
    sign = np.where(np.arange(300) % 3, 1.0, -1.0)[None, :]
    log = at_exposure(log_of(exposed, times, sign))
    found = np.stack([log.column(f"cameras.q{part}").to_numpy() for part in "xyzw"], axis=1)[:296]
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0)
    assert (Rotation.from_quat(found).inv() * rotation(times[:296])).magnitude().max() < 1e-3


def test_unseen_instants_have_no_pose():
    times, exposed = rows(300)
    gone = (times > 1_800_000) & (times < 2_500_000)
    exposed[gone] = exposed[~gone & (times < 2_000_000)][-1]
    x = at_exposure(log_of(exposed, times)).column("cameras.x").to_numpy()
    blind = (times > 1_800_000) & (times < 2_440_000)
    assert np.isnan(x[blind]).all()
    assert np.isfinite(x[(times < 1_750_000) | ((times > 2_500_000) & (times < 3_900_000))]).all()


@pytest.mark.parametrize(("gap_us", "known"), [(100_000, True), (110_000, False)])
def test_instants_between_two_exposures_are_known_up_to_a_tenth_of_a_second(gap_us, known):
    times, exposed = rows(300)
    begin = exposed[100]
    exposed[(exposed > begin) & (exposed < begin + gap_us)] = begin
    x = at_exposure(log_of(exposed, times)).column("cameras.x").to_numpy()
    assert (np.isfinite(x[(times > begin) & (times < begin + gap_us)]) == known).all()


@pytest.mark.parametrize("count", [2, 3, 5])
def test_a_place_lies_between_the_exposures_around_it_from_the_first_to_the_last(count):
    times = np.arange(0.0, 100_000.0, 2_500.0)
    seen = np.array([10_000.0, 25_000.0, 30_000.0, 55_000.0, 80_000.0])[:count]
    exposed = np.append(seen, np.full(len(times) - count, seen[-1]))
    x = at_exposure(log_of(exposed, times)).column("cameras.x").to_numpy()
    expected = np.interp(times, seen, place(seen)[:, 0], left=np.nan, right=np.nan)
    assert x == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_before_the_first_pose_there_is_none():
    times, exposed = rows(100)
    exposed[:50] = np.nan
    x = at_exposure(log_of(exposed, times)).column("cameras.x").to_numpy()
    assert np.isnan(x[:45]).all()
    assert np.isfinite(x[50:96]).all()
    exposed[:] = np.nan
    assert np.isnan(at_exposure(log_of(exposed, times)).column("cameras.x").to_numpy()).all()


def test_a_log_without_cameras_is_left_alone():
    log = pa.table({"t": [1, 2], "truth.x": [0.1, 0.2]})
    assert at_exposure(log) is log
