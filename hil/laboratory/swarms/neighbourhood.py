"""The robots of one room act on one another (`hil.world.neighbours`): places in, winds and forces out."""

from collections.abc import Sequence

import numpy as np

from firmware_py.compiling import bound
from firmware_py.core.subset import i32
from hil.laboratory.robot import Robot
from hil.world.config import SwarmConfig
from hil.world.neighbours import Neighbours, interact
from hil.world.room import to_world

ROW = 10  # numbers of a robot: whether it flies, place, speed and lift, all in W of the room
ABSENT = np.zeros(ROW)


class Neighbourhood:
    """What `count` robots do to one another. They have wakes in still air only; elsewhere each has its own tunnel."""

    def __init__(self, config: SwarmConfig, count: int, still_air: bool) -> None:
        near = Neighbours.allocate()
        self._interact, self.near = bound(interact, near), near.fields
        self.near.count = i32(count)
        for name in ("radius", "stiffness", "damping", "wake_radius", "wake_spread"):
            setattr(self.near, name, getattr(config, name))
        self.near.wake = config.wake if still_air else 0.0
        self._affected = [False] * count  # by a wake or a contact

    def interact(self, rows: np.ndarray) -> None:
        """Compute what the robots do to one another from a row (`row_of`, `ABSENT`) for each."""
        near, count = self.near, len(rows)
        near.flies[:count] = rows[:, 0]
        near.p_WB[:count], near.v_WB[:count], near.lift_W[:count] = rows[:, 1:4], rows[:, 4:7], rows[:, 7:]
        self._interact()

    def act_on(self, index: int, robot: Robot) -> None:
        """Let a robot feel the others."""
        wake, touch = self.near.wake_W[index].tolist(), self.near.touch_W[index].tolist()
        affected = any(wake) or any(touch)
        if affected or self._affected[index]:
            robot.body.tunnel.set_wake(*wake)
            robot.touch(touch)
        self._affected[index] = affected


def row_of(robot: Robot, now_us: int, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the row of a robot that flies, at an instant; its own frame W is at `origin` [m] in the room."""
    body = robot.body
    body.advance(now_us)
    lift_W = to_world(body.q_WB.tolist(), (0.0, 0.0, body.lift))
    return np.array((1.0, *(body.p_WB + origin), *body.state[3:6], *lift_W))
