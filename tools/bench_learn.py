"""Control steps per second of the environments, beside RotorPy's and gym-pybullet-drones': `python tools/bench_learn.py`.

Processor time of one core and actions of 0. RotorPy's environment needs the extra `bench`, torch, torchdiffeq, roma and
stable-baselines3; gym-pybullet-drones is a repository, not a package: pybullet, transforms3d, and its clone on PYTHONPATH.
"""

import sys
import time
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table

from hil.research.learn.envs import make_env, make_vec

MANY, FAST_STEPS, PEER_STEPS = 1024, 100, 30
WHOLE_STEPS = 200  # before the robot, which nothing controls, is lost: after 2.7 s
REPEATS = 3


def steps_per_s(
    step: Callable[[], object], count: int, robots: int, begin: Callable[[], object] = lambda: None
) -> float:
    """Control steps of all robots per second of processor time: the best of a few measurements, each after `begin`."""
    found = []
    for _ in range(REPEATS):
        begin()
        start = time.process_time()
        for _ in range(count):
            step()
        found.append(count * robots / (time.process_time() - start))
    return max(found)


def fast() -> float:
    env, still = make_vec("Hover", MANY), np.zeros((MANY, 4), np.float32)
    env.reset(seed=1)
    env.step(still)
    return steps_per_s(lambda: env.step(still), FAST_STEPS, MANY)


def whole() -> float:
    env, still = make_env("Hover", "firmware"), np.zeros(4, np.float32)
    return steps_per_s(lambda: env.step(still), WHOLE_STEPS, 1, lambda: env.reset(seed=1))


def rotorpy() -> float:
    import torch
    from rotorpy.learning.quadrotor_environments import QuadrotorEnv
    from rotorpy.vehicles.crazyflie_params import quad_params

    torch.set_num_threads(1)
    zeros = torch.zeros(MANY, 3, dtype=torch.float64)
    states = {
        "x": zeros,
        "v": zeros,
        "w": zeros,
        "wind": zeros,
        "rotor_speeds": torch.full((MANY, 4), 1788.53).double(),
    }
    states |= {"q": torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(MANY, 1).double()}
    env = QuadrotorEnv(MANY, states, "cmd_motor_speeds", quad_params=quad_params, max_time=60)
    env.reset()
    still = np.zeros((MANY, 4))
    return steps_per_s(lambda: env.step(still), PEER_STEPS, MANY)


def pybullet() -> float:
    from gym_pybullet_drones.envs.HoverAviary import HoverAviary
    from gym_pybullet_drones.utils.enums import ActionType

    env, still = HoverAviary(act=ActionType.RPM, pyb_freq=200, ctrl_freq=100), np.zeros((1, 4), np.float32)
    return steps_per_s(lambda: env.step(still), WHOLE_STEPS, 1, lambda: env.reset(seed=1))


PEERS = {f"RotorPy, {MANY} quadrotors": rotorpy, "gym-pybullet-drones, one quadrotor": pybullet}


def main() -> None:
    table = Table(title="control steps of 10 ms per second and core")
    table.add_column("environment")
    table.add_column("steps/s", justify="right")
    table.add_row(f"fast, {MANY} robots", f"{fast():,.0f}")
    table.add_row("firmware, one robot in the whole laboratory", f"{whole():,.0f}")
    for name, measure in PEERS.items():
        try:
            table.add_row(name, f"{measure():,.0f}")
        except (ImportError, NameError) as error:  # RotorPy imports without torchdiffeq, but lacks a name
            print(f"{name}: left out: {error}", file=sys.stderr)
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
