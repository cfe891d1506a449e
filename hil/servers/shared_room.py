"""What the processes of served robots share: memory in which each robot has a row and a total of its pauses.

So time stands still for all robots of `floaty serve --boards N` together, and in still air they feel one another. Where fans
blow, each has a tunnel of its own.
"""

from mmap import mmap

import numpy as np

from hil.config import LabConfig
from hil.laboratory.robot import Robot
from hil.laboratory.swarms.neighbourhood import ABSENT, ROW, Neighbourhood, row_of

PERIOD_US = 4_000  # a contact of 150 N/m with 30 g turns within 40 ms


class SharedRoom:
    """The room of `count` robots, made before their processes are forked. Each process writes to its own row only."""

    def __init__(self, config: LabConfig, count: int = 1) -> None:
        self.pauses = memoryview(mmap(-1, 8 * count)).cast("q")  # [us] of each clock
        self.rows = np.frombuffer(mmap(-1, 8 * count * ROW)).reshape(count, ROW)
        self._settings = config.swarm
        self._is_one = count > 1 and config.tunnel.fan_factor == 0.0

    def join(self, number: int, robot: Robot) -> None:
        """Let robot `number` of this process act on the others of one room, and feel them, while it is free."""
        if not self._is_one:
            return
        index, neighbourhood = number - 1, Neighbourhood(self._settings, len(self.rows), still_air=True)

        def exchange(now_us: int) -> None:
            self.rows[index] = row_of(robot, now_us) if robot.free else ABSENT
            neighbourhood.interact(self.rows)
            neighbourhood.act_on(index, robot)

        robot.events.every(PERIOD_US, PERIOD_US, exchange)

    def leave(self, number: int) -> None:
        """Take a robot out whose process has ended."""
        self.rows[number - 1] = ABSENT
