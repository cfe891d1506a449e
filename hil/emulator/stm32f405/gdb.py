"""`--gdb PORT`: connects a debugger on 127.0.0.1 to the chip in lockstep.

While the chip is stopped at a breakpoint the whole laboratory waits: no time passes in tunnel and radio, and the flight
continues as if it had not stopped. Ctrl-C is checked each time the laboratory runs the chip (debugged_chip.py).
"""

import select
import socket
from collections.abc import Callable
from contextlib import suppress

from hil.emulator.stm32f405.checkpoints import Checkpoints
from hil.emulator.stm32f405.freertos import FreeRtos
from hil.emulator.stm32f405.gdb_protocol import RUNNING, SIGTRAP, Debuggee, RemoteProtocol, ResumeRequest
from hil.errors import LabError

HOST = "127.0.0.1"
READ_SIZE = 4096
BEGINS = (b"+", b"-", b"$", b"\x03")  # what a debugger may send first
FIRST_TIMEOUT_S = 0.5  # for it


class GdbServer:
    """Serves one debugger at a time. Raises `LabError` when the port is taken."""

    def __init__(
        self,
        port: int,
        waiting: Callable[[int], None] = lambda _: None,
        checkpoints: Checkpoints | None = None,
        from_us: int = 0,
    ) -> None:
        """Listen; port 0 takes a free one. `waiting` gets the port when the stopped machine waits for a debugger.

        With `checkpoints` the flight can go back in time. The machine waits for the debugger at power-on, or at a later
        time of the laboratory, `from_us`.
        """
        self._waiting, self.checkpoints, self.from_us = waiting, checkpoints, from_us
        self._client: socket.socket | None = None
        try:
            self._listener = socket.create_server((HOST, port))
        except OSError as error:
            raise LabError(f"--gdb {port}: {error.strerror or error}") from None
        self._listener.setblocking(True)

    def attach(self, debuggee: Debuggee, kernel: FreeRtos | None = None) -> None:
        """Switch to this machine and its tasks; a client of the previous one must reconnect."""
        self._disconnect()
        self._debuggee, self._kernel = debuggee, kernel
        self.protocol = self._new_protocol()

    def _new_protocol(self) -> RemoteProtocol:
        return RemoteProtocol(self._debuggee, self._kernel, self.checkpoints is not None)

    @property
    def is_connected(self) -> bool:
        return self._client is not None

    @property
    def port(self) -> int:
        return int(self._listener.getsockname()[1])

    def hold(
        self, signal: int = SIGTRAP, watched: int | None = None, at_begin: bool = False
    ) -> ResumeRequest:
        """Stop the machine until the debugger runs, steps, leaves or ends it; wait for a debugger first."""
        if self._client is None:
            self._waiting(self.port)
            while not self._admit():
                pass
            if self.checkpoints is not None:
                self.checkpoints.begin()
        elif self.protocol.request in RUNNING:
            self._send(self.protocol.stopped(signal, watched, at_begin))
        while self._client is not None and self.protocol.request is ResumeRequest.STOP:
            self._receive()
        request = self.protocol.request
        if request in (ResumeRequest.DETACH, ResumeRequest.KILL):
            self._disconnect()
        return request

    def wants_to_stop(self) -> bool:
        """Return whether the debugger sent Ctrl-C, or a new one connected, while the machine ran."""
        if self._client is None:
            return self._arrives(self._listener, 0) and self._admit()
        if self._arrives(self._client, 0):
            self._receive()
        return self._client is not None and self.protocol.interrupted

    def _arrives(self, line: socket.socket, timeout_ms: int | None = None) -> bool:
        """Wait for input; end the process when the first one has ended, whose flight this is."""
        inputs, first = select.poll(), -1 if self.checkpoints is None else self.checkpoints.life
        inputs.register(line, select.POLLIN)
        if self.checkpoints is not None and first >= 0:
            inputs.register(first, select.POLLIN)
        found = [number for number, _ in inputs.poll(timeout_ms)]
        if self.checkpoints is not None and first in found:
            self.checkpoints.finish()
        return bool(found)

    def _admit(self) -> bool:
        """Accept the next client; return whether it is a debugger. A browser's page could send packets within HTTP."""
        self._arrives(self._listener)
        client, _ = self._listener.accept()
        client.settimeout(FIRST_TIMEOUT_S)
        with suppress(OSError):
            if client.recv(1, socket.MSG_PEEK) in BEGINS:
                client.settimeout(None)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._client, self.protocol = client, self._new_protocol()
                return True
        client.close()
        return False

    def close(self) -> None:
        self._disconnect()
        self._listener.close()
        if self.checkpoints is not None:
            self.checkpoints.finish()

    def _receive(self) -> None:
        """Answer the next packet; a disconnected debugger releases the machine."""
        assert self._client is not None
        data = b""
        self._arrives(self._client)
        with suppress(OSError):
            data = self._client.recv(READ_SIZE)
        if data:
            self._send(self.protocol.receive(data))
        else:
            self.protocol.leave(ResumeRequest.DETACH)
            self._disconnect()

    def _send(self, data: bytes) -> None:
        assert self._client is not None
        with suppress(OSError):  # the next `recv` reports the disconnection
            self._client.sendall(data)

    def _disconnect(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            if self.checkpoints is not None:
                self.checkpoints.clear()
