"""The core's supervisor on the bench: events of a flight go in, mode, state and cause come out."""

from firmware_py.config import parameters_of
from firmware_py.core_runner import CoreBlocks, RunnerFactory, default_runner
from firmware_py.supervisor import CoreSupervisor, wrapped
from firmware_py.wire.supervisor import Cause, State
from hil.config import load_config

TICK_US = 10_000
FULL_MV = 3900


class SupervisorBench:
    """A board that has just booted at an instant; `view` is what the rest of the firmware sees."""

    def __init__(self, now_us: int = 0, runner: RunnerFactory = default_runner, look: bool = True) -> None:
        self.core = CoreBlocks(parameters_of(load_config()), runner)
        self.core.run.call("reset")
        for _ in range(20):  # until a pose can belong to the past
            self.core.run.call("estimate")
        self.connected = True
        self.view = CoreSupervisor(self.core, lambda text: None, lambda: self.connected)
        self.data, self.parameters = self.core.data.fields, self.core.parameters.fields
        self.now_us = now_us
        self.data.battery_mv = FULL_MV
        self.gyro = 0
        if look:
            self.look()

    @property
    def found(self) -> tuple[State, Cause]:
        return self.view.state, self.view.cause

    def look(self, after_us: int = 0) -> int:
        """Return the mode that is decided some time later."""
        self.now_us += after_us
        self.view.update(self.now_us)
        return int(self.data.mode)

    def watch_control(self, after_us: int) -> int:
        """Return whether somebody who looks after the controller finds, some time from now, that it is newly lost."""
        self.data.now_us = wrapped(self.now_us + after_us)
        return self.core.run.call("watch_control")

    def calibrate(self) -> None:
        """Hold the robot still for as long as its gyro needs."""
        while not self.core.sampling.fields.calibrated:
            self.core.run.call("take_sample")

    def pose(self, waited_us: int = 0) -> int:
        """Let the estimator accept a pose that came a while ago."""
        self.data.now_us, self.data.pose_waited_us = wrapped(self.now_us), waited_us
        self.data.pose_quaternion[0], self.data.pose_age_us = 1.0, 0
        return self.core.run.call("file_pose")

    def steps(self, count: int, moving: bool = False) -> None:
        """Run steps of 1 ms in which the gyro's counts change, or do not."""
        for _ in range(count):
            self.gyro ^= moving
            self.data.gyro[2] = self.gyro
            self.data.tick += 1
            self.core.run.call("begin_step")

    def fly(self, time_us: int, bounded: bool = False) -> int:
        """Let time pass with poses, in which the estimator may be held at its bounds in every tick; return the mode."""
        for _ in range(time_us // TICK_US):
            self.now_us += TICK_US
            self.core.estimator.fields.bounded += bounded
            self.pose()
            self.look()
        return int(self.data.mode)
