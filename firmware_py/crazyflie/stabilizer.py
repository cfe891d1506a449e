"""The order in which the stabilizer's loop asks the commanders and the supervisor (stabilizer.c), at 100 Hz.

The firmware's loop runs at 1 kHz and asks the high-level commander in every tenth step and the supervisor in every
fortieth; in the steps between nothing here changes but the age of a set-point.
"""

from collections.abc import Callable

from firmware_py.crazyflie.commander import CLIENT, HIGH_LEVEL, Commander, Setpoint
from firmware_py.crazyflie.high_level_commander import HighLevelCommander, Surroundings
from firmware_py.crazyflie.supervisor import Seen, Supervisor
from firmware_py.geometry import Vector

STEPS = 4  # from one look of the supervisor to the next
TICK_US = 1000
# The microsecond counter divides 84 MHz by 85 (usec_time.c).
SECONDS_PER_US = 84 / 85 * 1e-6
STOPPED = Setpoint()  # while the robot may not fly; as if it had been set at power-on


class Stabilizer:
    """`commander`, `high_level` and `supervisor` take the requests of clients."""

    def __init__(self, board: Surroundings, report: Callable[[str, str], None]) -> None:
        self.high_level = HighLevelCommander(board, report)
        self.commander = Commander(self.high_level.planner.stop)
        self.supervisor = Supervisor()
        self._steps = 0

    def command(self, data: bytes, now_us: int) -> int:
        """Execute a command of the high-level commander; return its status."""
        return self.high_level.execute(data, now_us * SECONDS_PER_US)

    def follow(self, setpoint: Setpoint, now_us: int) -> None:
        """Take a set-point of a client."""
        self.commander.set(setpoint, CLIENT, now_us // TICK_US)

    def step(self, now_us: int, turning: bool, acceleration: Callable[[], Vector]) -> Setpoint:
        """Return the set-point for the controller; `turning`: a motor is over its idle thrust."""
        tick, t = now_us // TICK_US, now_us * SECONDS_PER_US
        can_fly = self.supervisor.can_fly
        self.high_level.block(not can_fly)
        if can_fly:
            self.commander.set(self.high_level.setpoint(t), HIGH_LEVEL, tick)
        setpoint = self.commander.setpoint if can_fly else STOPPED
        self._steps += 1
        if self._steps % STEPS == 0:
            self.supervisor.update(Seen(tick, setpoint, turning, acceleration()), self.high_level.bits(t))
        return self.supervisor.override(setpoint)
