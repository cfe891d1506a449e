"""Train a hover policy from scratch on the fast model, and write it as ONNX for `floaty policy`.

    pip install -e ".[learn]" stable-baselines3 torch onnx onnxscript
    python tools/train_policy.py --out hover.onnx            # 6 minutes of processor time
    floaty policy hover.onnx --out mylaw && floaty fly hover --profile mylaw/profile.toml

PPO of stable-baselines3; a multilayer perceptron with two layers of 48 tanh units. Each episode draws a robot of the
campaign `table`. The policy sees the observation of `firmware_py/core/observation.py`, scaled by `SCALE`, which becomes
part of the network.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import hil.research.learn  # noqa: F401 - registers the environments

SCALE = np.repeat(  # of an observation: m, m/s, rad, rad/s, rad, -1..1
    np.array([0.1, 0.3, 0.2, 1.5, 0.2, 1.0], np.float32), (3, 3, 3, 3, 4, 4)
)
ENVIRONMENTS, ROLLOUT = 128, 64


class Adapter(VecEnv):
    """A vector environment of gymnasium adapted to stable-baselines3, with scaled observations."""

    def __init__(self, env: Any) -> None:
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._env, self._first = env, 0

    def reset(self) -> np.ndarray:
        return self._env.reset(seed=self._first)[0] / SCALE

    def seed(self, seed: int | None = None) -> list[int | None]:
        self._first = seed or 0
        return [self._first + n for n in range(self.num_envs)]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        observations, rewards, lost, late, info = self._env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for n in np.flatnonzero(lost | late):
            infos[n] = {"terminal_observation": info["final_obs"][n] / SCALE, "TimeLimit.truncated": late[n]}
        return observations / SCALE, rewards.astype(np.float32), lost | late, infos

    def close(self) -> None:
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self._env, attr_name, None)] * self.num_envs

    def set_attr(self, *_: Any, **__: Any) -> None: ...
    def env_method(self, *_: Any, **__: Any) -> list[Any]:
        return []

    def env_is_wrapped(self, *_: Any, **__: Any) -> list[bool]:
        return [False] * self.num_envs


class PrintedProgress(BaseCallback):
    """Print one line per 25 rollouts."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        ends = self.model.ep_info_buffer or [{"r": float("nan"), "l": float("nan")}]
        if self.num_timesteps // (ENVIRONMENTS * ROLLOUT) % 25 == 0:
            mean = {key: float(np.mean([end[key] for end in ends])) for key in ("r", "l")}
            print(
                f"{self.num_timesteps / 1e6:6.2f} M steps: reward {mean['r']:6.1f}, {mean['l']:5.0f} steps",
                flush=True,
            )


class Network(torch.nn.Module):
    """The deterministic policy from raw observations, as flown."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.register_buffer("scale", torch.from_numpy(1.0 / SCALE))
        self.layers = torch.nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layers(observation * self.scale)


def main() -> None:
    """Train and write the network."""
    parser = argparse.ArgumentParser(description="Train a hover policy on the fast model.")
    parser.add_argument("--out", type=Path, default=Path("hover.onnx"))
    parser.add_argument("--task", default="Hover")
    parser.add_argument("--steps", type=float, default=16e6)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--robots", default="table", help="campaign that draws the robots; empty: the profile's"
    )
    parser.add_argument(
        "--delay-us", type=int, default=0, help="of the pose, where no predictor compensates for it"
    )
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], help="section.key=value of the profile"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    env = gymnasium.make_vec(
        f"floaty/{args.task}-v0",
        num_envs=ENVIRONMENTS,
        robots=args.robots,
        pose_delay_us=args.delay_us,
        overrides=args.overrides,
    )
    model = PPO(
        "MlpPolicy",
        VecMonitor(Adapter(env)),
        learning_rate=lambda left: 1e-3 * left + 2e-5,
        n_steps=ROLLOUT,
        batch_size=2048,
        n_epochs=6,
        gamma=0.98,
        gae_lambda=0.92,
        ent_coef=0.0,
        seed=args.seed,
        device="cpu",
        policy_kwargs={
            "net_arch": {"pi": [48, 48], "vf": [64, 64]}, "activation_fn": torch.nn.Tanh, "log_std_init": -1.0,
        },
    )  # fmt: skip
    model.learn(int(args.steps), callback=PrintedProgress())
    network = Network(model.policy).eval()
    torch.onnx.export(network, (torch.zeros(1, 20),), str(args.out), input_names=["observation"],
                      output_names=["action"], dynamo=False)  # fmt: skip
    print(f"{args.out}: {sum(p.numel() for p in network.parameters())} weights")


if __name__ == "__main__":
    main()
