"""The training script learns to hover, and what it writes flies on the board."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hil.research.learn.envs import make_env

ROOT = Path(__file__).parents[3]


@pytest.mark.long
def test_a_short_training_yields_a_policy_that_hovers_in_the_laboratory(tmp_path: Path) -> None:
    for package in ("torch", "stable_baselines3", "onnxruntime"):
        pytest.importorskip(package)
    import onnxruntime

    network = tmp_path / "hover.onnx"
    trained = subprocess.run(
        [sys.executable, "-W", "ignore", ROOT / "tools" / "train_policy.py", "--steps", "8e5", "--out", network],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert trained.returncode == 0, trained.stderr
    assert trained.stdout.splitlines()[-1] == f"{network}: 3556 weights"
    session = onnxruntime.InferenceSession(network)
    env = make_env("Hover", "firmware", duration_s=10.0)
    observation, _ = env.reset(seed=77)
    rewards, lost, over = [], False, False
    while not (lost or over):
        action = session.run(None, {"observation": observation[None]})[0][0]
        observation, reward, lost, over, _ = env.step(np.asarray(action))
        rewards.append(reward)
    env.close()
    assert not lost
    assert np.mean(rewards[200:]) > 0.6
