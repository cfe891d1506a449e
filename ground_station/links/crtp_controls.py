"""An operator's requests over CRTP, sans I/O: the parameter, platform and supervisor ports of a Crazyflie."""

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from firmware_py.table import OF_PROFILE
from firmware_py.wire import crtp, parameters, supervisor
from firmware_py.wire.localisation import EMERGENCY_STOP
from firmware_py.wire.scalars import Scalar
from ground_station.controls import (
    ControlAction,
    ControlRequest,
    ControlsError,
    Dialogue,
    Exchange,
    Script,
    Settings,
)

PORTS = (crtp.PORT_PARAMETERS, crtp.PORT_PLATFORM, crtp.PORT_SUPERVISOR)  # whose packets `receive` takes


# Where boards take requests to arm and to recover, which have the same numbers at both, and what their replies add.
OF_PLATFORM = crtp.PORT_PLATFORM, supervisor.PLATFORM_COMMAND, 0
OF_SUPERVISOR = crtp.PORT_SUPERVISOR, supervisor.SUPERVISOR_COMMAND, supervisor.REPLY


@dataclass(frozen=True, slots=True)
class TocEntry:
    """A parameter in the board's table of contents."""

    number: int
    scalar: Scalar
    writable: bool
    persistent: bool

    def check(self, name: str, value: float) -> None:
        """Raise `ControlsError` if it cannot hold a value."""
        if not self.writable:
            raise ControlsError(f"{name}: can only be read")
        if not (self.scalar.is_float or self.scalar.cast(value) == value):
            raise ControlsError(f"{name} = {value:g}: not a value of type {self.scalar.name}")


class CrtpControls(Dialogue[crtp.Packet]):
    """`transmit` takes packets' bytes; `table` is the board's table of contents, known once connected."""

    def __init__(
        self, transmit: Callable[[bytes], object], table: Callable[[], Mapping[str, TocEntry]]
    ) -> None:
        super().__init__()
        self._transmit = transmit
        self._table = table

    def ask(self, now_us: int, request: ControlRequest) -> None:
        scripts: dict[ControlAction, Callable[[], Script[crtp.Packet]]] = {
            ControlAction.LIST: lambda: self._list(request.name),
            ControlAction.READ: lambda: self._read(request.name),
            ControlAction.WRITE: lambda: self._write(request.name, request.value),
            ControlAction.SAVE: self._save,
            ControlAction.ARM: self._arm,
            ControlAction.STOP: self._stop,
        }
        self.begin(now_us, scripts[request.action]())

    def _list(self, group: str) -> Script[crtp.Packet]:
        found: Settings = ()
        for name in self._table():
            if name.lower().startswith(group.lower()):
                found += yield from self._read(name)
        return found

    def _read(self, name: str) -> Script[crtp.Packet]:
        entry = self._find(name)
        reply = yield self._exchange_for(parameters.CHANNEL_READ, entry)
        if reply.data[2] != parameters.OK:
            raise ControlsError(f"{name}: the board does not report it: error {reply.data[2]}")
        return ((name, entry.scalar.unpack(reply.data[3 : 3 + entry.scalar.size])),)

    def _write(self, name: str, value: float) -> Script[crtp.Packet]:
        entry = self._find(name)
        entry.check(name, value)
        wanted = entry.scalar.cast(value)
        reply = yield self._exchange_for(parameters.CHANNEL_WRITE, entry, entry.scalar.pack(value))
        in_force = entry.scalar.unpack(reply.data[2 : 2 + entry.scalar.size])
        if in_force != wanted:
            raise ControlsError(f"{name} = {value:g}: refused, it stays {in_force:g}")
        return ((name, in_force),)

    def _save(self) -> Script[crtp.Packet]:
        for name, entry in self._table().items():
            if not entry.persistent:
                continue
            head = bytes((parameters.Misc.STORE,)) + parameters.encode_ident(entry.number)
            packet = crtp.Packet(crtp.PORT_PARAMETERS, parameters.CHANNEL_MISC, head)
            reply = yield self._until(packet, lambda got, head=head: got.data[:3] == head)  # type: ignore[misc]
            if reply.data[3:4] != bytes((parameters.OK,)):
                raise ControlsError(f"{name}: the board cannot store it")
        return ()

    def _arm(self) -> Script[crtp.Packet]:
        """Use Floaty's own parameters where they exist: the Crazyflie firmware's arming does not affect the flaps."""
        for name, value in (("floaty.stop", 0.0), ("floaty.armed", 1.0)):
            if name in self._table():
                yield from self._write(name, value)
        port, channel, reply_bit = yield from self._port_of_commands()
        locked = "arm; after an emergency stop it has to reboot first"
        for what, command in (
            ("recover", bytes((supervisor.RECOVER,))),
            (locked, bytes((supervisor.ARM, 1))),
        ):
            head = bytes((command[0] | reply_bit,))
            packet = crtp.Packet(port, channel, command)
            reply = yield self._until(packet, lambda got, head=head: got.data[:1] == head)  # type: ignore[misc]
            if not any(reply.data[1:2]):
                raise ControlsError(f"the board refuses to {what}")
        return ()

    def _port_of_commands(self) -> Generator[Exchange[crtp.Packet], Any, tuple[int, int, int]]:
        """Return the port that takes commands: newer firmware warns of the older one, older has only that."""
        ask = crtp.Packet(
            crtp.PORT_PLATFORM, supervisor.PLATFORM_VERSION, bytes((supervisor.VERSION_PROTOCOL,))
        )
        reply = yield self._until(ask, lambda got: len(got.data) > 1 and got.data[:1] == ask.data)
        return OF_SUPERVISOR if reply.data[1] >= supervisor.PORT_SINCE else OF_PLATFORM

    def _stop(self) -> Script[crtp.Packet]:
        """Send the stop of the localisation port, which every Crazyflie has; newer ones report that they are locked."""
        stop = crtp.Packet(crtp.PORT_LOCALISATION, crtp.CHANNEL_GENERIC, bytes((EMERGENCY_STOP,)))
        ask = crtp.Packet(crtp.PORT_SUPERVISOR, supervisor.SUPERVISOR_INFO, bytes((supervisor.GET_BITS,)))
        head = bytes((supervisor.REPLY | supervisor.GET_BITS,))  # of the answer

        def send(now_us: int) -> None:
            self._transmit(crtp.encode(stop))
            self._transmit(crtp.encode(ask))

        def take(got: crtp.Packet) -> crtp.Packet | None:
            is_state = got.port == crtp.PORT_SUPERVISOR and got.data[:1] == head
            return got if is_state and int.from_bytes(got.data[1:3], "little") & supervisor.LOCKED else None

        yield Exchange(send, take)
        return ()

    def _find(self, name: str) -> TocEntry:
        table = self._table()
        if name not in table:
            raise ControlsError(unknown(name, tuple(table)))
        return table[name]

    def _exchange_for(self, channel: int, entry: TocEntry, value: bytes = b"") -> Exchange[crtp.Packet]:
        """Return the exchange whose reply has the request's channel and number, followed by a value."""
        packet = crtp.Packet(crtp.PORT_PARAMETERS, channel, parameters.encode_ident(entry.number) + value)
        value_at = (
            3 if channel == parameters.CHANNEL_READ else 2
        )  # of a read, behind a status; an error has no value

        def fits(got: crtp.Packet) -> bool:
            failed = any(got.data[2:value_at])
            size = value_at if failed else value_at + entry.scalar.size
            return len(got.data) >= size and parameters.decode_ident(got.data) == entry.number

        return self._until(packet, fits)

    def _until(self, packet: crtp.Packet, fits: Callable[[crtp.Packet], bool]) -> Exchange[crtp.Packet]:
        def take(got: crtp.Packet) -> crtp.Packet | None:
            return got if (got.port, got.channel) == (packet.port, packet.channel) and fits(got) else None

        return Exchange(lambda now_us: self._transmit(crtp.encode(packet)), take)


def unknown(name: str, known: tuple[str, ...]) -> str:
    """Return the error line, with the nearest known name."""
    near = get_close_matches(name, (*known, *OF_PROFILE), 1, 0.5)
    return f"parameter {name}: the board has none{f'; did you mean {near[0]}?' if near else ''}"
