"""A flight as data for imitation learning."""

from pathlib import Path

import numpy as np
import pytest

from firmware_py.wire.supervisor import State
from hil import fly


@pytest.mark.long
def test_a_dataset_has_what_the_law_saw_and_did_in_every_step_of_the_closed_loop(tmp_path: Path) -> None:
    run = fly("yaw-step", duration_s=2.0, seed=4, folder=tmp_path / "run")
    data, log = run.to_dataset(), run.to_pandas().reset_index()
    closed = log[log["supervisor.state"] == State.FLYING].reset_index()
    np.testing.assert_array_equal(data.t_us, closed["t"])
    assert data.observations.shape == (len(closed), 20)
    assert data.actions.shape == (len(closed), 4)
    limits = run.request.config.controller
    np.testing.assert_allclose(data.actions[:, 0] * limits.limit_u, closed["control.u1"], atol=1e-6)
    np.testing.assert_allclose(data.actions[:, 2] * limits.limit_u3, closed["control.u3"], atol=1e-6)
    np.testing.assert_array_equal(data.observations[1:, 16:], data.actions[:-1])
    row = int(np.argmax(np.abs(closed["estimate.yaw"])))  # far from where sine and cosine hide a mistake
    x, y, yaw = (closed[f"estimate.{name}"][row] for name in ("x", "y", "yaw"))
    assert abs(yaw) > 0.2
    assert data.observations[row, 0] == pytest.approx(-np.cos(yaw) * x - np.sin(yaw) * y, abs=1e-5)
    assert data.observations[row, 1] == pytest.approx(np.sin(yaw) * x - np.cos(yaw) * y, abs=1e-5)
    assert data.observations[row, 8] == pytest.approx(-yaw, abs=1e-5)
    np.testing.assert_allclose(
        data.observations[row, 9:12],
        closed.loc[row, ["estimate.p", "estimate.q", "estimate.r"]].to_numpy(float),
    )
