"""The firmware as one object: the only place where its parts are connected.

Hardware calls `imu_ready` and `radio_received` (interrupts), then `run`. Everything else goes through the `Board`.
"""

from firmware_py.board import Board
from firmware_py.config import FirmwareConfig, parameters_of
from firmware_py.core import entry
from firmware_py.core.structs import Control, Estimator, Input
from firmware_py.drivers.imu import GyroZero
from firmware_py.links.crtp_stack import CrtpStack
from firmware_py.measurements import Measurement
from firmware_py.rtos import Kernel, Queue, WatchdogError
from firmware_py.rtos.statistics import LATENCY_BOUNDS_US, Statistics, TaskReport
from firmware_py.signals import Signals
from firmware_py.supervisor import Supervisor
from firmware_py.tasks import CoreBlocks, Thief, estimator_task, sensors_task, stabilizer_task, thief_task
from firmware_py.variables import telemetry_reader

__all__ = ["LATENCY_BOUNDS_US", "Firmware", "Kernel", "TaskReport", "Thief", "WatchdogError"]

MEASUREMENT_QUEUE = 20  # original firmware
DEADLINES_US = {  # of each activation: whatever the flight path does in a tick is over before the next one
    "SENSORS": 1000,
    "STABILIZER": 1000,
    "KALMAN": 1000,
}
WATCHDOG_US = 353_000  # the longest that the Crazyflie's independent watchdog may take
THIEF_PRIORITY = 6  # above every task, like interrupts that do not end


class Firmware:
    """A booted board. `kernel` may be looked at; `signals` are views on the core."""

    def __init__(self, config: FirmwareConfig, board: Board) -> None:
        self.kernel = Kernel(preemption=True)
        self._board = board
        core = CoreBlocks(parameters_of(config), Input.allocate(), Estimator.allocate(), Control.allocate())
        entry.reset(core.parameters.arg, core.estimator.arg)
        entry.control(core.parameters.arg, core.data.arg, core.estimator.arg, core.control.arg)
        board.write_compare(core.control.fields.count.tolist())  # hover from the first PWM period on
        self._core = core
        self._zero = GyroZero()
        self._supervisor = Supervisor(config.supervisor.pose_timeout_us, board.debug_write)
        self._imu_ready = self.kernel.create_binary_semaphore("imuReady")
        data_ready = self.kernel.create_binary_semaphore("dataReady")
        estimator_run = self.kernel.create_binary_semaphore("runTaskSemaphore")
        self.measurements: Queue[Measurement] = self.kernel.create_queue(MEASUREMENT_QUEUE, "measurements")
        kernel, cost = self.kernel, config.cpu
        kernel.create_task(
            "SENSORS", 4, sensors_task,
            kernel, cost, board, self._imu_ready, self.measurements, data_ready, self._zero, self._zero_found,
        )  # fmt: skip
        kernel.create_task(
            "STABILIZER", 5, stabilizer_task,
            kernel, cost, board, data_ready, estimator_run, self._supervisor, core,
        )  # fmt: skip
        kernel.create_task(
            "KALMAN", 2, estimator_task,
            kernel, cost, estimator_run, self.measurements, self._supervisor, core,
        )  # fmt: skip
        read = telemetry_reader(core.estimator.fields, core.control.fields, lambda: self._supervisor.state)
        self.link = CrtpStack(kernel, cost, board, self.measurements, read)
        self.signals = Signals.of(core.estimator, core.control, self._supervisor)
        self.deadlines_us = DEADLINES_US
        self.statistics = Statistics(self.kernel, DEADLINES_US)
        self.kernel.start()

    @property
    def next_wake_us(self) -> int | None:
        """The next instant at which the firmware acts without an interrupt."""
        return self.kernel.next_wake_us

    def imu_ready(self) -> None:
        """Interrupt: the IMU has a new sample. While interrupts are off, samples pass unnoticed."""
        if not self.kernel.interrupts_off:
            self._imu_ready.give_from_isr()

    def radio_received(self, data: bytes) -> None:
        """Interrupt: the radio chip has a packet. While interrupts are off, packets are lost."""
        if not self.kernel.interrupts_off:
            self.link.received(data)

    def check_watchdog(self) -> None:
        """Raise `WatchdogError` when the stabilizer has not come round for too long; hardware, called now and then."""
        late_us = self.kernel.now_us - self._core.watchdog_fed_us
        if late_us > WATCHDOG_US:
            text = f"watchdog reset, STABILIZER has not run for {late_us / 1000:.0f} ms and this task has the processor"
            raise WatchdogError(self.kernel.current.name, self.kernel.now_us, text)

    def run(self, now_us: int) -> None:
        """Run the tasks until all are blocked or busy."""
        self.kernel.run(now_us)

    def add_thief(self) -> Thief:
        """Add a task that takes a share of every tick before all others; it takes nothing until told to."""
        thief = Thief()
        self.kernel.create_task("THIEF", THIEF_PRIORITY, thief_task, self.kernel, thief)
        return thief

    def _zero_found(self) -> None:
        bias = self._zero.bias
        assert bias is not None
        self._core.data.fields.gyro_bias[:] = bias
        self._supervisor.calibrated = True
        self._board.debug_write("imu: gyro zero found, {:.1f} {:.1f} {:.1f} counts".format(*bias))
