"""An operator's requests over MAVLink, sans I/O: the parameter protocol, and commands with their acknowledgements.

The board's `extCtrl.y_P` is `EXT_Y_P` here; a request may use either name.
"""

from collections.abc import Callable, Generator
from typing import Any

from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import Message
from firmware_py.wire.mavlink_numbers import WRITE_ALL, Command, CommandResult
from firmware_py.wire.scalars import Scalar
from ground_station.controls import ControlAction, ControlRequest, ControlsError, Dialogue, Exchange, Script
from ground_station.links.crtp_controls import unknown

ARM, TERMINATE = 1, 1
WARNING = 4  # MAV_SEVERITY
REASON_US = 200_000  # after a refusal, for the board's reason
STOPPED = services.mavlink_name("floaty.stop")  # a latch, which arming alone does not reset


class MavlinkControls(Dialogue[Message]):
    """`send(now_us, message)` frames and sends; `board` is the system to talk to."""

    def __init__(self, send: Callable[[int, Message], object], board: Callable[[], int]) -> None:
        super().__init__()
        self._send = send
        self._board = board
        self._names: tuple[str, ...] = ()  # of the board's parameters, once they are listed

    def ask(self, now_us: int, request: ControlRequest) -> None:
        scripts: dict[ControlAction, Callable[[], Script[Message]]] = {
            ControlAction.LIST: self._list,
            ControlAction.READ: lambda: self._read(request.name),
            ControlAction.WRITE: lambda: self._write(request.name, request.value),
            ControlAction.SAVE: lambda: self._command(Command.PREFLIGHT_STORAGE, WRITE_ALL),
            ControlAction.ARM: self._arm,
            ControlAction.STOP: lambda: self._command(Command.DO_FLIGHTTERMINATION, TERMINATE),
        }
        self.begin(now_us, scripts[request.action]())

    def _list(self) -> Script[Message]:
        """Request all, then one by one the missing ones."""
        found: dict[int, Message] = {}

        def take(message: Message) -> Message | None:
            if message.get_type() != "PARAM_VALUE" or message.param_index >= message.param_count:
                return None
            found[message.param_index] = message
            return message

        def missing() -> int:
            return next(number for number in range(len(found) + 1) if number not in found)

        last = yield Exchange(lambda now_us: self._send(now_us, services.parameter_list(self._board())), take)
        while len(found) < last.param_count:
            last = yield Exchange(
                lambda now_us: self._send(now_us, services.parameter_read(self._board(), missing())),
                take,
                waits=True,
            )
        values = tuple((found[number].param_id, found[number].param_value) for number in sorted(found))
        self._names = tuple(name for name, _ in values)
        return values

    def _read(self, name: str) -> Script[Message]:
        name = yield from self._find(name)
        message = services.parameter_read(self._board(), name)
        reply = yield self._until(message, lambda got: _is_value_of(got, name))
        return ((name, reply.param_value),)

    def _write(self, name: str, value: float) -> Script[Message]:
        name = yield from self._find(name)
        message = services.parameter_set(self._board(), name, value)
        reply = yield self._until(message, lambda got: _is_value_of(got, name))
        if reply.param_value != Scalar.F32.cast(value):
            raise ControlsError(f"{name} = {value:g}: refused, it stays {reply.param_value:g}")
        return ((name, reply.param_value),)

    def _arm(self) -> Script[Message]:
        yield from self._list_once()
        if STOPPED in self._names:
            yield from self._write(STOPPED, 0.0)
        return (yield from self._command(Command.COMPONENT_ARM_DISARM, ARM))

    def _command(self, number: int, *params: float) -> Script[Message]:
        message = services.command(self._board(), number, *params)
        reply = yield self._until(
            message, lambda got: got.get_type() == "COMMAND_ACK" and got.command == number
        )
        if reply.result != CommandResult.ACCEPTED:
            refusal = services.refusal(reply)
            reason = yield Exchange(
                lambda now_us: None, _warning, waits=True, patience_us=REASON_US, missing=refusal
            )
            raise ControlsError(f"{refusal}: {reason}")
        return ()

    def _list_once(self) -> Generator[Exchange[Message], Any, None]:
        if not self._names:
            yield from self._list()

    def _find(self, name: str) -> Generator[Exchange[Message], Any, str]:
        yield from self._list_once()
        for spelt in (name, services.mavlink_name(name)):
            if spelt in self._names:
                return spelt
        raise ControlsError(unknown(name, self._names))

    def _until(self, message: Message, fits: Callable[[Message], bool]) -> Exchange[Message]:
        return Exchange(lambda now_us: self._send(now_us, message), lambda got: got if fits(got) else None)


def _warning(message: Message) -> str | None:
    is_warning = message.get_type() == "STATUSTEXT" and message.severity <= WARNING
    return message.text if is_warning else None


def _is_value_of(message: Message, name: str) -> bool:
    return bool(message.get_type() == "PARAM_VALUE" and message.param_id == name)
