"""The firmware as one object: the only place where its parts are connected.

Hardware calls `imu_ready`, `radio_received` and `uart_ready` (interrupts), then `run`. Everything else goes through the
`Board`.
"""

from typing import TYPE_CHECKING, Any, ClassVar

from numpy.typing import NDArray

from firmware_py.board import Board
from firmware_py.config import FirmwareConfig, MavlinkConfig, parameters_of
from firmware_py.core.structs import HORIZON_LIMIT, POSE_FROZEN, POSE_NO_CORRECTION, POSE_TOO_OLD, TICK_US
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks, CoreCosts, RunnerFactory, default_runner
from firmware_py.drivers.imu import acceleration, rates
from firmware_py.export.usage import Usage
from firmware_py.geometry import Vector
from firmware_py.links.console import Console, Notices
from firmware_py.links.crtp_stack import CrtpStack
from firmware_py.links.high_level import CommanderService
from firmware_py.links.localisation import LocalisationService
from firmware_py.links.log import LogService
from firmware_py.links.memories import MemoryService, Tester, memories
from firmware_py.links.parameters import Parameter, ParameterService, ParameterStorage
from firmware_py.links.platform import PlatformService
from firmware_py.logic.loading import load_logic
from firmware_py.parameters import parameters
from firmware_py.pilot import Pilot
from firmware_py.rtos import Kernel, WatchdogError
from firmware_py.rtos.statistics import Statistics
from firmware_py.running import Running, StockState
from firmware_py.signals import Signals
from firmware_py.stock_names import stock_parameters, stock_variables
from firmware_py.supervisor import CoreSupervisor
from firmware_py.tasks import Findings, FlightTasks
from firmware_py.variables import log_variables
from firmware_py.wire import WireError
from firmware_py.wire.crtp import Correction
from firmware_py.wire.memories import CONFIG_SIZE, RadioSettings, decode_config, encode_config

if TYPE_CHECKING:
    from firmware_py.links.mavlink_stack import MavlinkStack

OLDEST_POSE_US = HORIZON_LIMIT * TICK_US  # at the estimator's tick
# Of each activation: a tick's work of the flight path ends before the next tick.
DEADLINES_US = {"SENSORS": 1000, "STABILIZER": 1000, "KALMAN": 1000}
WATCHDOG_US = 353_000  # the longest that the Crazyflie's independent watchdog may take


class Firmware:
    """A booted board. `kernel`, `pilot`, `variables` and `parameters` may be read; `signals` are views on the core.

    With `mavlink` the UART speaks MAVLink, which needs pymavlink. `runner` executes the flight core. The clock is the
    caller's and the constants are the profile's, so both class variables are None.
    """

    clock_us: ClassVar[None] = None
    flashed: ClassVar[None] = None

    def __init__(
        self,
        config: FirmwareConfig,
        board: Board,
        mavlink: bool = False,
        runner: RunnerFactory = default_runner,
    ) -> None:
        self.kernel = self.scheduler = Kernel(preemption=True)
        self._board = board
        core = CoreBlocks(parameters_of(config), runner, load_logic(config.logic))
        core.data.fields.absolute = i32(config.predictor.absolute)
        core.run.call("reset")
        core.run.call("control")
        board.write_compare(core.control.fields.count.tolist())  # hover from the first PWM period on
        self._core = core
        self.link = CrtpStack(self.kernel, config.cpu, board)
        self._console = Console(self.link, board)
        self._notices = Notices(self.kernel, self._console.write)
        self._supervisor = CoreSupervisor(core, self._console.write, self._client_is_there)
        self.pilot = Pilot(
            core, self._supervisor, lambda: acceleration(board.imu.tolist()), self._notices.refuse
        )
        findings = Findings(self._zero_found, self._pose_refused, self._pose_gated)
        self.flight_tasks = FlightTasks(
            self.kernel, config.cpu, board, core, self._supervisor, self.pilot, findings
        )
        self.measurements = self.flight_tasks.measurements
        self.mavlink = self._mavlink_stack(config) if mavlink else None
        self._start_services(config)
        self.signals = Signals.of(core.estimator.memory, core.control.memory, self._supervisor)
        self.reports = Statistics(self.kernel, DEADLINES_US).reports
        self.kernel.start()

    def _start_services(self, config: FirmwareConfig) -> None:
        """Create the services of the links."""
        board, core, link, supervisor = self._board, self._core, self.link, self._supervisor
        settings = _radio_settings(board)
        tester, storage = Tester(), ParameterStorage(board.eeprom)
        pilot, notices = self.pilot, self._notices
        stabilizer, high_level = pilot.stabilizer, pilot.stabilizer.high_level
        CommanderService(link, stabilizer)
        localisation = LocalisationService(
            link, self.measurements, stabilizer.supervisor, pilot, settings.address & 0xFF
        )
        running = Running(
            board=board,
            core=core,
            supervisor=supervisor,
            measurements=self.measurements,
            stack=link,
            platform=PlatformService(link, stabilizer.supervisor, localisation.take_pose),
            tester=tester,
            storage=storage,
            pilot=pilot,
            commander=high_level.defaults,
            stock=StockState(),
            print_line=self._console.write,
            mavlink=self.mavlink,
        )
        self.variables = (*log_variables(running), *stock_variables(running))
        own = parameters(running)
        self.parameters = (*own, *stock_parameters(running))
        LogService(link, self.variables)
        ParameterService(link, self.parameters, storage, notices)
        MemoryService(link, memories(board.eeprom, tester, high_level.memory))
        if self.mavlink is not None:
            self._start_mavlink_services(self.mavlink, config.mavlink, running, own)

    def _mavlink_stack(self, config: FirmwareConfig) -> "MavlinkStack":
        from firmware_py.links.mavlink_stack import MavlinkStack

        return MavlinkStack(self.kernel, config.cpu, config.mavlink, self._board)

    def _start_mavlink_services(
        self, stack: "MavlinkStack", config: MavlinkConfig, running: Running, own: tuple[Parameter, ...]
    ) -> None:
        """Create the services for MAVLink clients."""
        from firmware_py.links.mavlink_commands import CommandService, answer_for_what_is_not_there
        from firmware_py.links.mavlink_parameters import MavlinkParameters
        from firmware_py.links.mavlink_poses import PoseService
        from firmware_py.links.mavlink_setpoints import SetpointService
        from firmware_py.links.mavlink_streams import StreamService
        from firmware_py.links.mavlink_telemetry import FlightMessages, PoseInWorld

        core, supervisor = self._core, self._supervisor
        setpoints = SetpointService(stack, running.pilot, config.home)
        poses = PoseService(stack, self.measurements, setpoints)
        world = PoseInWorld(core.estimator.fields, core.control.fields, setpoints)
        messages = FlightMessages(stack, supervisor, world, poses, self.variables, self._measured)
        streams = StreamService(stack, messages.streams(config.rates))
        MavlinkParameters(stack, own)
        CommandService(stack, self._board, supervisor, streams, setpoints, own, running.storage)
        answer_for_what_is_not_there(stack)
        self._console.listeners.append(stack.console_line)

    @property
    def log_numbers(self) -> dict[str, int]:
        return {variable.name: number for number, variable in enumerate(self.variables)}

    @property
    def parameter_numbers(self) -> dict[str, int]:
        return {parameter.name: number for number, parameter in enumerate(self.parameters)}

    @property
    def inputs(self) -> NDArray[Any]:
        """The core's input, (1,)."""
        return self._core.data.memory

    @property
    def usage(self) -> Usage | None:
        """The flight core's use of the processor, where it is measured."""
        return self._core.run.usage if isinstance(self._core.run, CoreCosts) else None

    @property
    def overrun(self) -> str:
        core = self._core
        return "" if core.logic is None else core.logic.overrun(core.named)

    @property
    def next_wake_us(self) -> int | None:
        return self.kernel.next_wake_us

    def imu_ready(self) -> None:
        """Signal a new sample of the IMU (interrupt). While interrupts are off, samples are missed."""
        if not self.kernel.interrupts_off:
            self.flight_tasks.imu_ready.give_from_isr()

    def radio_received(self, data: bytes, broadcast: bool = False) -> None:
        """Take a packet from the radio chip (interrupt). While interrupts are off, packets are lost."""
        if not self.kernel.interrupts_off:
            self.link.received(data, broadcast)

    def radio_polled(self) -> None:
        """Note an empty packet at the radio chip (interrupt)."""
        if not self.kernel.interrupts_off:
            self.link.polled()

    def uart_ready(self) -> None:
        """Signal bytes at the UART (interrupt). While interrupts are off, they stay in the UART."""
        if self.mavlink is not None and not self.kernel.interrupts_off:
            self.mavlink.uart_ready()

    def check_watchdog(self) -> None:
        """Raise `WatchdogError` when the stabilizer has not run for too long; the hardware calls this now and then."""
        late_us = self.kernel.now_us - self.flight_tasks.fed_us
        if late_us > WATCHDOG_US:
            text = f"watchdog reset, STABILIZER has not run for {late_us / 1000:.0f} ms and this task has the processor"
            raise WatchdogError(self.kernel.current.name, self.kernel.now_us, text)

    def run(self, now_us: int) -> None:
        """Run the tasks until all are blocked or busy."""
        self.kernel.run(now_us)

    def _measured(self) -> tuple[Vector, Vector]:
        """Return the IMU's present measurement: rates [rad/s, B] and acceleration [g, B]."""
        counts = self._board.imu.tolist()
        return rates(counts, self._core.data.fields.gyro_bias.tolist()), acceleration(counts)

    def _client_is_there(self) -> bool:
        return self.link.connected or (self.mavlink is not None and self.mavlink.connected)

    def _pose_refused(self, answer: int, pose: Correction) -> None:
        """Report a refused pose; one that is late only for the present horizon is not worth a line."""
        if answer == POSE_NO_CORRECTION:
            place = " ".join(str(round(100.0 * x)) for x in pose.p_GB)
            self._notices.refuse(
                "pose",
                f"pose refused: {place} cm is no correction; for absolute poses set extPose.absolute 1",
            )
        elif answer == POSE_FROZEN:
            self._notices.refuse("frozen", "poses frozen: they stay the same although the robot turns")
        elif answer == POSE_TOO_OLD and (age_us := self._core.data.fields.pose_age_us) > OLDEST_POSE_US:
            self._notices.refuse(
                "age", f"poses {(age_us + 500) // 1000} ms old: at most {OLDEST_POSE_US // 1000} ms"
            )

    def _pose_gated(self) -> None:
        """Report a pose that the innovation gate has refused."""
        self._notices.refuse("gate", "pose refused: it is too far from the estimate")

    def _zero_found(self) -> None:
        bias = self._core.data.fields.gyro_bias.tolist()
        self._console.write("imu: gyro zero found, {:.1f} {:.1f} {:.1f} counts".format(*bias))


def _radio_settings(board: Board) -> RadioSettings:
    """Return the settings in the EEPROM; a new or corrupt EEPROM gets the defaults first."""
    try:
        return decode_config(bytes(board.eeprom[:CONFIG_SIZE]))
    except WireError:
        board.eeprom[:CONFIG_SIZE] = encode_config(RadioSettings())
        return RadioSettings()
