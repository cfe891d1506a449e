"""A flight in its own process; its debugger can make it go back in time."""

import os
import re
import signal
import socket
from functools import cache
from pathlib import Path

from hil.emulator.stm32f405.checkpoints import Checkpoints, _written_files
from hil.emulator.stm32f405.chip import CYCLES_PER_US, StopReason
from hil.emulator.stm32f405.debugged_chip import DebuggedChip
from hil.emulator.stm32f405.freertos import FreeRtos
from hil.emulator.stm32f405.gdb import GdbServer
from hil.emulator.stm32f405.gdb_protocol import framed
from support.stm32_machine import FirmwareOnChip


class Flight:
    """A flight in a separate process that can go back in time; the test is its debugger.

    It reports each millisecond in a file, reaches 130 ms and exits with 7. `outlived` ends when all of its processes have.
    """

    machine = cache(FirmwareOnChip)  # at power-on: it only flies in other processes

    def __init__(self, path: Path, planted: int = 0) -> None:
        self.path, self.image, self._received = path, Flight.machine().image, b""
        server = GdbServer(0, checkpoints=Checkpoints())
        self.line = socket.create_connection(("127.0.0.1", server.port), 60.0)
        self.outlived, held = os.pipe()
        self.pid = os.fork()
        if not self.pid:
            code = 1
            signal.signal(signal.SIGINT, signal.default_int_handler)  # also where it is ignored, as by nohup
            try:
                for number, *_ in _written_files():  # the tests' own, which never go back
                    os.close(number)
                self._fly(server, planted)
                code = 7
            except KeyboardInterrupt:
                code = 130
            finally:
                os._exit(code)
        server._listener.close()
        os.close(held)
        self.ask(b"QStartNoAckMode")

    def _fly(self, server: GdbServer, planted: int) -> None:
        machine, end = Flight.machine(), CYCLES_PER_US * 1000
        machine.poke("planted", planted)
        machine.chip.crash_points |= {self.place(name) for name in ("Stuck_Handler", "assertFail")}
        chip = DebuggedChip(machine.chip, server, FreeRtos(machine.image, machine.chip.read))
        with self.path.open("w", buffering=1) as file:
            while machine.chip.now_us < 130_000:
                if chip.run(end) & StopReason.BREAK:
                    machine.chip.crash_points.clear()  # a handler may be a loop
                    file.write("crash\n")
                if machine.chip.state.now >= end:
                    file.write(f"{machine.chip.now_us // 1000}\n")
                    end += CYCLES_PER_US * 1000
            server.close()

    def place(self, name: str) -> int:
        return self.image.symbol(name).address

    def ask(self, packet: bytes) -> bytes:
        """Return the answer to a packet; of one that resumes, the next stop."""
        self.line.sendall(framed(packet))
        while (found := re.search(rb"\$([^#]*)#..", self._received)) is None:
            data = self.line.recv(1 << 16)
            assert data, "the flight has ended"
            self._received += data
        self._received = self._received[found.end() :]
        return found[1]

    def instant(self) -> tuple[bytes, bytes, bytes]:
        """Return the registers of the stopped chip, what the firmware keeps in memory, and what the flight has written."""
        ticks, tasks = map(self.place, ("xTickCount", "tasks"))
        memory = self.ask(b"m%x,4" % ticks) + self.ask(b"m%x,200" % tasks)
        return self.ask(b"g"), memory, self.path.read_bytes()

    def stop(self, packet: bytes) -> tuple[tuple[bytes, bytes, bytes], bytes]:
        """Return the instant at which the chip stops after a packet, and the report."""
        report = self.ask(packet)
        return self.instant(), re.sub(rb";?thread:.*", b"", report)

    def end(self, packet: bytes = b"D") -> int:
        """Return the exit code, once all processes have ended."""
        if packet:
            self.line.sendall(framed(packet))
        _, status = os.waitpid(self.pid, 0)
        assert os.read(self.outlived, 1) == b""
        os.close(self.outlived)
        self.line.close()
        return os.waitstatus_to_exitcode(status)
