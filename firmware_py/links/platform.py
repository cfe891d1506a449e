"""The board's identity and rights: link, platform and supervisor services, and the application channel."""

from collections.abc import Callable

from firmware_py.crazyflie.supervisor import Supervisor
from firmware_py.links.crtp_stack import CrtpStack, Task
from firmware_py.rtos import Queue
from firmware_py.wire import WireError, check_size
from firmware_py.wire.crtp import MAX_DATA, PORT_LINK, PORT_PLATFORM, PORT_SUPERVISOR, Packet
from firmware_py.wire.supervisor import (
    ARM,
    COMMAND_ARM,
    COMMAND_NOTIFY,
    COMMAND_RECOVER,
    GET_BITS,
    PLATFORM_APP,
    PLATFORM_COMMAND,
    PLATFORM_VERSION,
    RECOVER,
    REPLY,
    STOP,
    STOP_WATCHDOG,
    SUPERVISOR_COMMAND,
    SUPERVISOR_INFO,
    VERSION_DEVICE,
    VERSION_FIRMWARE,
    VERSION_PROTOCOL,
)

PROTOCOL_VERSION = 12
FIRMWARE_VERSION = "2026.11 Floaty"
DEVICE_TYPE = "C21F"  # Crazyflie 2.1, Floaty
APP_QUEUE = 10

LINK_ECHO, LINK_SOURCE = 0, 1
SOURCE_TEXT = b"Bitcraze Crazyflie".ljust(MAX_DATA, b"\0")  # by which clients know the protocol


class PlatformService:
    """Answers on the ports of link, platform and supervisor; `application` takes the bytes of its channel."""

    def __init__(
        self, stack: CrtpStack, supervisor: Supervisor, application: Callable[[bytes], Task]
    ) -> None:
        self._stack = stack
        self._application = application
        self._supervisor = supervisor
        kernel = stack.kernel
        self._app: Queue[bytes] = kernel.create_queue(APP_QUEUE, "app")
        self._requests = stack.open_port(PORT_PLATFORM)
        stack.serve("CRTP-SRV", 0, PORT_LINK, answer_link)
        stack.handle(PORT_SUPERVISOR, lambda packet: stack.answer(packet, self.answer_supervisor, 0))
        kernel.create_task("PLATFORM-SRV", 0, self._platform_task)
        kernel.create_task("APP", 0, self._app_task)

    @property
    def app_overflows(self) -> int:
        """Packets lost because the application was too slow."""
        return self._app.dropped

    def bits(self) -> int:
        """Return the bit field of the supervisor and the high-level commander, as of the supervisor's last look."""
        return self._supervisor.bits

    def answer_platform(self, packet: Packet) -> tuple[bytes, ...]:
        """Return the reply to a platform command (the command itself) or to a request for a version."""
        data = packet.data
        if not data:
            raise WireError("an empty platform request")
        if packet.channel == PLATFORM_VERSION:
            return (data[:1] + _version(data[0]),)
        if packet.channel == PLATFORM_COMMAND:
            if data[0] in (COMMAND_ARM, COMMAND_RECOVER):
                return (data[:1] + self._command(data),)
            if data[0] == COMMAND_NOTIFY:
                return (data,)
        raise WireError(f"platform channel {packet.channel}: {data.hex()} is unknown")

    def answer_supervisor(self, packet: Packet) -> tuple[bytes, ...]:
        """Return the state, or the result of a command; the emergency stops are not answered."""
        supervisor, data = self._supervisor, packet.data
        command = data[0] if data else 0
        # A request for all bits, or for the one with this number.
        if packet.channel == SUPERVISOR_INFO and 0 < command <= GET_BITS:
            answer = self.bits().to_bytes(2, "little")
            if command < GET_BITS:
                answer = bytes((self.bits() >> command - 1 & 1,))
            return (bytes((REPLY | command,)) + answer,)
        if packet.channel == SUPERVISOR_COMMAND:
            if command in (ARM, RECOVER):
                return (bytes((REPLY | command,)) + self._command(data),)
            if data == bytes((STOP,)):
                supervisor.stop_wanted = True
                return ()
            if data == bytes((STOP_WATCHDOG,)):
                supervisor.feed_watchdog(self._stack.kernel.tick_count)
                return ()
        raise WireError(f"supervisor channel {packet.channel}: {data.hex()} is unknown")

    def _command(self, data: bytes) -> bytes:
        """Arm, disarm or recover; return whether it succeeded and the new state."""
        check_size("a request to arm or recover", data, 1 if data[0] == COMMAND_RECOVER else 2)
        if data[0] == COMMAND_RECOVER:
            return bytes((self._supervisor.request_recovery(), not self._supervisor.crashed))
        return bytes((self._supervisor.request_arming(bool(data[1])), self._supervisor.armed))

    def _platform_task(self) -> Task:
        while True:
            packet = yield from self._requests.receive()
            if packet is None:
                continue
            if packet.channel == PLATFORM_APP:
                yield from self._app.send(packet.data, 0)
            else:
                yield from self._stack.answer(packet, self.answer_platform)

    def _app_task(self) -> Task:
        while True:
            data = yield from self._app.receive()
            try:
                if data is not None:
                    yield from self._application(data)
            except WireError:
                self._stack.malformed += 1


def answer_link(packet: Packet) -> tuple[bytes, ...]:
    """Echo on channel 0, identify the board on channel 1, ignore the rest."""
    if packet.channel == LINK_ECHO:
        return (packet.data,)
    return (SOURCE_TEXT,) if packet.channel == LINK_SOURCE else ()


def _version(command: int) -> bytes:
    if command == VERSION_PROTOCOL:
        return PROTOCOL_VERSION.to_bytes(4, "little")
    texts = {VERSION_FIRMWARE: FIRMWARE_VERSION, VERSION_DEVICE: DEVICE_TYPE}
    if command not in texts:
        raise WireError(f"version {command} is unknown")
    return texts[command].encode("ascii") + b"\0"
