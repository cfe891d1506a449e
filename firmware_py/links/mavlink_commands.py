"""Commands, each acknowledged to its sender, and the small services that clients expect to be answered.

A command that is repeated because its acknowledgement was lost is executed and acknowledged again. Requests for services
that Floaty lacks (missions, fences, rally points, logs, sole control) are answered with "none", because a client that
gets no answer asks again and again. The end of a transaction, MISSION_ACK or LOG_REQUEST_END, is not answered.
"""

from collections.abc import Callable, Sequence
from math import isfinite, isnan

from firmware_py.board import Board
from firmware_py.links.mavlink_setpoints import SetpointService
from firmware_py.links.mavlink_stack import WARNING, MavlinkStack, Task
from firmware_py.links.mavlink_streams import StreamService
from firmware_py.links.parameters import Parameter, ParameterStorage
from firmware_py.supervisor import CoreSupervisor
from firmware_py.wire import mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import NUMBERS, Message, sender_of
from firmware_py.wire.mavlink_numbers import WRITE_ALL, Command, CommandResult, Mode

FORCE = 21196  # MAVLink's magic number for disarming in flight
REBOOT = 1  # PREFLIGHT_REBOOT_SHUTDOWN
REBOOT_IN_FLIGHT = 20190226  # REBOOT_SHUTDOWN_CONDITIONS_FORCE
STOP = "floaty.stop"  # a parameter
REBOOT_TICKS = 200  # before the reset: time to send what is queued, 1 kB even at 57600 baud


Outcome = tuple[CommandResult, Sequence[Message]]  # and the messages after the acknowledgement
DONE: Outcome = (CommandResult.ACCEPTED, ())
DENIED: Outcome = (CommandResult.DENIED, ())


class CommandService:
    """Answers COMMAND_LONG and COMMAND_INT, PING and file transfer requests."""

    def __init__(
        self,
        stack: MavlinkStack,
        board: Board,
        supervisor: CoreSupervisor,
        streams: StreamService,
        setpoints: SetpointService,
        parameters: Sequence[Parameter],
        storage: ParameterStorage,
    ) -> None:
        self._stack = stack
        self._board = board
        self._supervisor = supervisor
        self._streams = streams
        self._parameters = parameters
        self._storage = storage
        self._rebooting = False
        self._commands: dict[int, Callable[[Message], Outcome]] = {
            Command.DO_SET_MODE: setpoints.choose,
            Command.DO_FLIGHTTERMINATION: self._terminate,
            Command.PREFLIGHT_STORAGE: self._store,
            Command.PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            Command.COMPONENT_ARM_DISARM: self._arm,
            Command.GET_HOME_POSITION: lambda command: self._once(NUMBERS["HOME_POSITION"]),
            Command.INJECT_FAILURE: self._fail,
            Command.GET_MESSAGE_INTERVAL: lambda command: self._report_interval(_whole(command.param1)),
            Command.SET_MESSAGE_INTERVAL: self._set_interval,
            Command.REQUEST_MESSAGE: self._request,
            Command.REQUEST_PROTOCOL_VERSION: lambda command: self._once(NUMBERS["PROTOCOL_VERSION"]),
            Command.REQUEST_AUTOPILOT_CAPABILITIES: lambda command: self._once(NUMBERS["AUTOPILOT_VERSION"]),
        }
        stack.handle("COMMAND_LONG", self._execute)
        stack.handle("COMMAND_INT", self._execute)
        stack.handle("PING", self._answer_ping)
        stack.handle("FILE_TRANSFER_PROTOCOL", lambda request: stack.reply(services.ftp_nak(request)))

    def _execute(self, command: Message) -> None:
        execute = self._commands.get(command.command)
        result, answers = (CommandResult.UNSUPPORTED, ()) if execute is None else execute(command)
        self._stack.refused += result is not CommandResult.ACCEPTED
        self._stack.reply(services.command_ack(command.command, result, *sender_of(command)))
        for answer in answers:
            self._stack.reply(answer)

    def _answer_ping(self, ping: Message) -> None:
        if ping.target_system == 0:  # otherwise it is an answer
            self._stack.reply(services.ping_answer(ping))

    def _arm(self, command: Message) -> Outcome:
        if command.param1 not in (0, 1):
            return DENIED
        if command.param1 == 0 and command.param2 == FORCE:
            self._supervisor.emergency_stop()
        if self._supervisor.arm(command.param1 == 1):
            return DONE
        if self._supervisor.locked:
            obstacle = "emergency stop; reboot first"
        elif self._supervisor.battery_empty:
            obstacle = "battery low"
        else:
            obstacle = f"stopped; set {services.mavlink_name(STOP)} 0"
        return self._not_now(f"not armed: {obstacle}")

    def _not_now(self, why: str) -> Outcome:
        return CommandResult.TEMPORARILY_REJECTED, services.status_text(WARNING, why)

    def _reboot(self, command: Message) -> Outcome:
        if command.param1 != REBOOT:
            return DENIED
        if self._supervisor.controlling and _sixth(command) != REBOOT_IN_FLIGHT:
            return self._not_now("not rebooted: the flaps are under control")
        if not self._rebooting:
            self._rebooting = True
            self._stack.kernel.create_task("MAV-BOOT", 1, self._reboot_task)
        return DONE

    def _reboot_task(self) -> Task:
        while True:
            yield from self._stack.kernel.delay(REBOOT_TICKS)
            self._board.reset()

    def _fail(self, command: Message) -> Outcome:
        """Make the simulated hardware fail; real hardware cannot."""
        instance = 0 if isnan(command.param3) else _whole(command.param3)  # NaN: unused, all of them
        unit, failing = _whole(command.param1), _whole(command.param2)
        return self._board.inject_failure(unit, failing, instance), ()

    def _terminate(self, command: Message) -> Outcome:
        if command.param1 != 1:
            return DENIED
        self._supervisor.emergency_stop()
        return DONE

    def _store(self, command: Message) -> Outcome:
        if command.param1 != WRITE_ALL:
            return DENIED
        values = {parameter.name: parameter.value() for parameter in self._parameters if parameter.persistent}
        return DONE if self._storage.store_all(values) else (CommandResult.FAILED, ())

    def _set_interval(self, command: Message) -> Outcome:
        done = self._streams.set_interval(_whole(command.param1), _whole(command.param2))
        return DONE if done else DENIED

    def _report_interval(self, number: int) -> Outcome:
        if not 0 <= number <= 0xFFFF:
            return DENIED
        return CommandResult.ACCEPTED, (services.message_interval(number, self._streams.interval_us(number)),)

    def _request(self, command: Message) -> Outcome:
        number, index = _whole(command.param1), _whole(command.param2)
        if number == NUMBERS["MESSAGE_INTERVAL"]:
            return self._report_interval(index)
        if number != NUMBERS["AVAILABLE_MODES"]:
            return self._once(number)
        modes = tuple(services.available_mode(mode) for mode in Mode)
        if index == 0:
            return CommandResult.ACCEPTED, modes
        return (CommandResult.ACCEPTED, modes[index - 1 : index]) if 1 <= index <= len(modes) else DENIED

    def _once(self, number: int) -> Outcome:
        """Send a message once."""
        messages = self._streams.make(number)
        return (CommandResult.ACCEPTED, messages) if messages else DENIED


def _sixth(command: Message) -> float:
    """Return a command's sixth parameter, which COMMAND_INT calls y."""
    value: float = command.param6 if command.get_type() == "COMMAND_LONG" else command.y
    return value


def _whole(value: float) -> int:
    """Return a parameter as a whole number, or -2, which none of them may be, for anything else."""
    return int(value) if isfinite(value) and value == int(value) else -2


def answer_for_what_is_not_there(stack: MavlinkStack) -> None:
    """Add the answers to the link."""

    def refuse_control(request: Message) -> None:
        stack.reply(services.no_control(request))
        stack.notice(request, "no client gets control for itself alone")

    def refuse_mission(message: Message) -> None:
        stack.reply(services.refused_mission(message))

    for name in mavlink.MISSION_MESSAGES:
        stack.handle(name, refuse_mission)
    stack.handle("MISSION_REQUEST_LIST", lambda request: stack.reply(services.no_mission(request)))
    stack.handle("LOG_REQUEST_LIST", lambda request: stack.reply(services.no_logs()))
    stack.handle("LOG_REQUEST_DATA", lambda request: stack.reply(services.no_log_data(request)))
    stack.handle("CHANGE_OPERATOR_CONTROL", refuse_control)
