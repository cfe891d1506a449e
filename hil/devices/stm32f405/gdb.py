"""`--gdb PORT`: a debugger on 127.0.0.1 at the machine in lockstep.

Who runs the machine calls `hold` where it is to stand: nothing else of the laboratory runs until the debugger lets it go,
so that no time passes in tunnel and radio. Between two slices of a run it asks `wants_to_stop`.
"""

import select
import socket

from hil.devices.stm32f405.gdb_protocol import SIGTRAP, Debuggee, RemoteProtocol, Wish
from hil.errors import LabError

HOST = "127.0.0.1"
READ_SIZE = 4096


class GdbServer:
    """One debugger at a time. Raises `LabError` when the port cannot be had."""

    def __init__(self, debuggee: Debuggee, port: int) -> None:
        """Listen; port 0 takes a free one."""
        self._debuggee = debuggee
        self._protocol = RemoteProtocol(debuggee)
        self._client: socket.socket | None = None
        try:
            self._listener = socket.create_server((HOST, port))
        except OSError as error:
            raise LabError(f"--gdb {port}: {error.strerror or error}") from None
        self._listener.setblocking(True)

    @property
    def port(self) -> int:
        """Return the port that clients connect to."""
        return int(self._listener.getsockname()[1])

    def hold(self, signal: int = SIGTRAP) -> Wish:
        """Let the machine stand until the debugger wants it to run, step, be left alone, or end; waits for one at first."""
        if self._client is None:
            self._welcome()
        elif self._protocol.wish in (Wish.RUN, Wish.STEP):
            self._send(self._protocol.stopped(signal))
        while self._client is not None and self._protocol.wish is Wish.STAND:
            self._receive()
        wish = self._protocol.wish
        if wish in (Wish.DETACH, Wish.KILL):
            self._part()
        return wish

    def wants_to_stop(self) -> bool:
        """Return whether the debugger pressed Ctrl-C, or a new one has come, while the machine ran. Never blocks."""
        waiting = self._listener if self._client is None else self._client
        if not select.select([waiting], [], [], 0)[0]:
            return False
        if self._client is None:
            return True
        self._receive()
        return self._protocol.interrupted

    def close(self) -> None:
        """Give the port back."""
        self._part()
        self._listener.close()

    def _welcome(self) -> None:
        self._client, _ = self._listener.accept()
        self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._protocol = RemoteProtocol(self._debuggee)

    def _receive(self) -> None:
        """Answer what comes next; who hangs up has let the machine go."""
        assert self._client is not None
        try:
            data = self._client.recv(READ_SIZE)
        except OSError:
            data = b""
        if data:
            self._send(self._protocol.receive(data))
        else:
            self._protocol.leave(Wish.DETACH)
            self._part()

    def _send(self, data: bytes) -> None:
        assert self._client is not None
        try:
            self._client.sendall(data)
        except OSError:
            return  # the next `recv` says that it has gone

    def _part(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
