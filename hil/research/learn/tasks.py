"""The tasks of the environments, and the draws for an episode: start, path of the goal, pushes, robot.

A seed draws the same episodes in both fidelities. Lengths in m, angles in rad, times in s from the release.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.errors import LabError, hint

AXES = ("x", "y", "z", "yaw")  # of the goal's path, W
PUSH_KINDS = ("push.x", "push.y", "push.z", "push.roll", "push.pitch", "push.yaw")  # [N] in W, [N m] in B
PUSHES = 3  # of an episode
PUSH_S = 0.1


@dataclass(frozen=True, slots=True)
class EpisodeTask:
    """The bounds of an episode's draws, each uniform within ± its bound."""

    name: str
    summary: str
    start: tuple[float, float, float]  # [m] from home, W
    path: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # amplitudes of `AXES`
    frequency_hz: tuple[float, float] = (0.05, 0.2)  # lowest and highest, drawn for each axis
    pushes: tuple[float, ...] = (0.0,) * 6  # largest size of each of `PUSH_KINDS`; all 0: none


TASKS: Mapping[str, EpisodeTask] = {
    task.name: task
    for task in (
        EpisodeTask("Hover", "hold the home goal", (0.05, 0.08, 0.08)),
        EpisodeTask("Track", "follow a goal on sines in x, y, z and yaw", (0.03, 0.03, 0.03), (0.08, 0.12, 0.12, 0.5)),
        EpisodeTask(
            "Push", "hold the home goal against three pushes of 0.1 s", (0.03, 0.03, 0.03),
            pushes=(0.6, 1.5, 1.5, 0.15, 0.15, 0.15),
        ),
    )
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Episode:
    """The draws of one episode."""

    start: NDArray[np.float64]  # (3,) [m] from home, W
    amplitude: NDArray[np.float64]  # (4,) of `AXES`
    frequency_hz: NDArray[np.float64]  # (4,)
    push_at: NDArray[np.float64]  # (PUSHES,) [s]; inf: none
    push_kind: NDArray[np.int64]  # (PUSHES,) index in `PUSH_KINDS`
    push_size: NDArray[np.float64]  # (PUSHES,)
    robot: float  # 0..1: which of the robots


def find_task(name: str) -> EpisodeTask:
    """Return a task by name. Raises `LabError` for an unknown one."""
    if name not in TASKS:
        raise LabError(f"task {name!r}: unknown; {hint(name, list(TASKS))}")
    return TASKS[name]


def reward_of(distance: float, tilt: float, yaw_error: float, change: float) -> float:
    """Return the reward of a step, -0.08..1.

    `distance` from the goal [m], `tilt` [rad], `yaw_error` [rad], and the sum of the squared changes of the action.
    """
    near = 1.0 / (1.0 + (distance / 0.03) * (distance / 0.03))
    level = 1.0 / (1.0 + (tilt / 0.15) * (tilt / 0.15))
    turned = 1.0 / (1.0 + (yaw_error / 0.2) * (yaw_error / 0.2))
    return 0.6 * near + 0.2 * level + 0.2 * turned - 0.005 * change


def draw_episode(task: EpisodeTask, rng: np.random.Generator, duration_s: float) -> Episode:
    """Draw an episode; every task draws the same number of random numbers."""
    share = rng.random(3 + 8 + 3 * PUSHES + 1)
    low, high = task.frequency_hz
    at = share[11 : 11 + PUSHES]
    kind = (share[11 + PUSHES : 11 + 2 * PUSHES] * len(PUSH_KINDS)).astype(np.int64)
    pushed = any(task.pushes)
    third = duration_s / PUSHES
    return Episode(
        start=np.array(task.start) * (2.0 * share[:3] - 1.0),
        amplitude=np.array(task.path) * (2.0 * share[3:7] - 1.0),
        frequency_hz=low + (high - low) * share[7:11],
        push_at=np.where(pushed, np.round(third * (np.arange(PUSHES) + 0.2 + 0.5 * at), 2), math.inf),
        push_kind=kind,
        push_size=np.array(task.pushes)[kind] * (2.0 * share[11 + 2 * PUSHES : 11 + 3 * PUSHES] - 1.0),
        robot=float(share[-1]),
    )
