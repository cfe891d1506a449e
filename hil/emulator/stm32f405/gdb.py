"""`--gdb PORT`: connects a debugger on 127.0.0.1 to the chip in lockstep.

While the chip is stopped at a breakpoint the whole laboratory waits: no time passes in tunnel and radio, and the flight
continues as if it had not stopped. Ctrl-C is checked each time the laboratory runs the chip.
"""

import select
import socket
from collections.abc import Callable
from contextlib import suppress

from hil.emulator.stm32f405.chip import Chip, StopReason
from hil.emulator.stm32f405.freertos import FreeRtos
from hil.emulator.stm32f405.gdb_protocol import SIGINT, SIGTRAP, Debuggee, RemoteProtocol, ResumeRequest
from hil.errors import LabError

HOST = "127.0.0.1"
READ_SIZE = 4096
BEGINS = (b"+", b"-", b"$", b"\x03")  # what a debugger may send first
FIRST_TIMEOUT_S = 0.5  # for it


class GdbServer:
    """Serves one debugger at a time. Raises `LabError` when the port is taken."""

    def __init__(self, port: int, waiting: Callable[[int], None] = lambda _: None) -> None:
        """Listen; port 0 takes a free one. `waiting` gets the port when the stopped machine waits for a debugger."""
        self._waiting = waiting
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
        self._protocol = RemoteProtocol(debuggee, kernel)

    @property
    def port(self) -> int:
        return int(self._listener.getsockname()[1])

    def hold(self, signal: int = SIGTRAP, watched: int | None = None) -> ResumeRequest:
        """Stop the machine until the debugger runs, steps, leaves or ends it; wait for a debugger first."""
        if self._client is None:
            self._waiting(self.port)
            while not self._admit():
                pass
        elif self._protocol.request in (ResumeRequest.RUN, ResumeRequest.STEP):
            self._send(self._protocol.stopped(signal, watched))
        while self._client is not None and self._protocol.request is ResumeRequest.STOP:
            self._receive()
        request = self._protocol.request
        if request in (ResumeRequest.DETACH, ResumeRequest.KILL):
            self._disconnect()
        return request

    def wants_to_stop(self) -> bool:
        """Return whether the debugger sent Ctrl-C, or a new one connected, while the machine ran."""
        waiting = self._listener if self._client is None else self._client
        inputs = select.poll()
        inputs.register(waiting, select.POLLIN)
        if not inputs.poll(0):
            return False
        if self._client is None:
            return self._admit()
        self._receive()
        return self._protocol.interrupted

    def _admit(self) -> bool:
        """Accept the next client; return whether it is a debugger. A browser's page could send packets within HTTP."""
        client, _ = self._listener.accept()
        client.settimeout(FIRST_TIMEOUT_S)
        with suppress(OSError):
            if client.recv(1, socket.MSG_PEEK) in BEGINS:
                client.settimeout(None)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._client, self._protocol = client, RemoteProtocol(self._debuggee, self._kernel)
                return True
        client.close()
        return False

    def close(self) -> None:
        self._disconnect()
        self._listener.close()

    def _receive(self) -> None:
        """Answer the next packet; a disconnected debugger releases the machine."""
        assert self._client is not None
        data = b""
        with suppress(OSError):
            data = self._client.recv(READ_SIZE)
        if data:
            self._send(self._protocol.receive(data))
        else:
            self._protocol.leave(ResumeRequest.DETACH)
            self._disconnect()

    def _send(self, data: bytes) -> None:
        assert self._client is not None
        with suppress(OSError):  # the next `recv` reports the disconnection
            self._client.sendall(data)

    def _disconnect(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


class DebuggedChip:
    """Runs a chip under its debugger; waits for one first."""

    def __init__(self, chip: Chip, server: GdbServer, kernel: FreeRtos | None = None) -> None:
        server.attach(chip, kernel)
        self._chip, self._server = chip, server
        self._request = ResumeRequest.STOP

    def run(self, until_cycles: int) -> int:
        """Run up to a time, or until the caller must act, like `Chip.run`.

        Raises `KeyboardInterrupt` when the debugger ends it.
        """
        if self._request is ResumeRequest.STOP or self._server.wants_to_stop():
            self._hold(SIGINT)
        seen: int = StopReason.TIME
        state = self._chip.state
        while True:
            stopped = self._request is ResumeRequest.STEP
            # The caller acts between two blocks, as without a debugger: never inside one, where `resume` is the pc.
            until = int(state.now) if seen else until_cycles
            seen |= self._chip.step() & ~StopReason.STEP if stopped else self._chip.run(until)
            pc = self._chip.register("pc")
            if seen & StopReason.BREAK and pc in self._chip.breakpoints:
                seen &= seen if pc in self._chip.crash_points else ~StopReason.BREAK
                stopped = True
            if seen & StopReason.WATCHPOINT:
                seen &= ~StopReason.WATCHPOINT
                self._hold(SIGTRAP, state.watch_address)
            elif stopped:
                self._hold(SIGTRAP)
            if seen & StopReason.BREAK or (state.resume != state.pc and (seen or state.now >= until_cycles)):
                return seen

    def _hold(self, signal: int, watched: int | None = None) -> None:
        self._request = self._server.hold(signal, watched)
        if self._request is ResumeRequest.KILL:
            raise KeyboardInterrupt
