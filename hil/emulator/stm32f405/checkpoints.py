"""Checkpoints of a whole flight: copies of its process that sleep until the flight goes back to one of them.

The process that the user started only waits for the end of the flight, whose exit code becomes its own; a child of it
flies. A checkpoint is a fork of the flying process. Woken, it leaves a copy of itself asleep and flies on with the
inherited connection to the debugger, and the process that woke it ends. Files that are open for writing get the length
back that they had at the checkpoint.

Nothing outlives the first process: it holds the only writing end of a pipe whose closing ends all others.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import re
import select
import signal
import socket
import stat
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

LIMIT = 20  # checkpoints at most, the oldest, and the closer the nearer to the present
SUBREAPER, DEATH_SIGNAL = 36, 1  # PR_SET_CHILD_SUBREAPER and PR_SET_PDEATHSIG of prctl(2)
SIZE_BYTES = 4  # of a message's length
KILLED = 128  # added to the signal's number in a shell's exit code

Message = dict[str, Any]


def why_none() -> str:
    """Return why this process cannot be copied; empty if it can."""
    if sys.platform != "linux":
        return f"the flight's process is copied for it, which {sys.platform} cannot"
    if threading.active_count() > 1:
        return "the flight's process is copied for it, which its other threads would not survive"
    return ""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A sleeping copy of the flight at a position, which its owner understands; `cycles` is the chip's time there."""

    position: tuple[int, ...]
    cycles: int
    pid: int
    line: socket.socket


class Checkpoints:
    """The checkpoints of a flight, the oldest first."""

    def __init__(self) -> None:
        self.kept: list[Checkpoint] = []
        self.life = -1  # becomes readable when the first process has ended
        self._tell = -1
        self._ended: list[int] = []  # children that were told to end
        self._starter = 0

    def begin(self) -> None:
        """Fly on in a child from now on; the process itself waits for the end of the flight."""
        if self._starter:
            return
        self._starter = os.getpid()
        self.life, held = os.pipe()
        told, self._tell = os.pipe()
        _prctl(SUBREAPER, 1)
        gc.freeze()  # a collection would write to all of the memory that the copies share
        _flush()
        if pid := os.fork():
            _wait(pid, told, {held, told})
        os.setpgid(0, 0)  # Ctrl-C goes to the first process, which passes it on
        os.close(held)
        os.close(told)

    def leave_copy(self, position: tuple[int, ...], cycles: int) -> Message | None:
        """Leave a copy asleep, and return None; in a copy that is woken, return the message."""
        self._reap()
        ours, theirs = socket.socketpair()
        files = _written_files()
        _flush()
        if pid := os.fork():
            theirs.close()
            self.kept.append(Checkpoint(position, cycles, pid, ours))
            self._thin_out(cycles)
            return None
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        while True:
            message = _awaited(theirs, self.life)
            pid = os.fork()
            if pid:  # the copy stays asleep
                break
        signal.signal(signal.SIGINT, before)
        for number, size, place in files:
            os.ftruncate(number, size)
            os.lseek(number, place, os.SEEK_SET)
        os.write(self._tell, b"%d\n" % os.getpid())
        theirs.sendall(b"+")
        theirs.close()
        self.kept.append(Checkpoint(position, cycles, pid, ours))
        return message

    def wake(self, checkpoint: Checkpoint, message: Message) -> None:
        """End this process in favour of a checkpoint, return only if it does not exist any more."""
        for younger in self.kept[self.kept.index(checkpoint) + 1 :]:
            self._end(younger)
        data = json.dumps(message).encode()
        _flush()
        with suppress(OSError):
            checkpoint.line.sendall(len(data).to_bytes(SIZE_BYTES, "little") + data)
            if checkpoint.line.recv(1):
                os._exit(0)
        self.kept.remove(checkpoint)

    def clear(self) -> None:
        """End all checkpoints."""
        for checkpoint in list(self.kept):
            self._end(checkpoint)
        self._reap()

    def finish(self) -> None:
        """End all checkpoints, and let this process end with the first one."""
        self.clear()
        if self._starter:
            while os.getppid() != self._starter and not select.select([self.life], [], [], 0.001)[0]:
                pass  # the process that woke this one has yet to end, which is not the end of the first one
            _prctl(DEATH_SIGNAL, signal.SIGKILL)
            if os.getppid() != self._starter:
                os._exit(KILLED + signal.SIGKILL)

    def _thin_out(self, now: int) -> None:
        """Drop the one whose absence leaves the smallest gap in relation to its age."""
        if len(self.kept) <= LIMIT:
            return
        cycles = [one.cycles for one in self.kept]
        gaps = [
            (cycles[index + 1] - cycles[index - 1]) / (now - cycles[index - 1] + 1)
            for index in range(1, len(cycles) - 1)
        ]
        self._end(self.kept[1 + gaps.index(min(gaps))])

    def _end(self, checkpoint: Checkpoint) -> None:
        with suppress(OSError):
            checkpoint.line.sendall(bytes(SIZE_BYTES))
        checkpoint.line.close()
        self.kept.remove(checkpoint)
        self._ended.append(checkpoint.pid)

    def _reap(self) -> None:
        """Forget children that have ended; those of other processes are the first one's."""
        for pid in list(self._ended):
            ended = True
            with suppress(ChildProcessError):
                ended = os.waitpid(pid, os.WNOHANG)[0] != 0
            if ended:
                self._ended.remove(pid)


def _wait(pid: int, told: int, kept: set[int]) -> NoReturn:
    """Wait for the end of the flight, which moves from process to process, and end with its exit code."""
    flying = pid

    def newest() -> int:
        nonlocal flying
        with suppress(BlockingIOError):
            if words := os.read(told, 1 << 16).split():
                flying = int(words[-1])
        return flying

    os.set_blocking(told, False)
    signals = {signal.SIGINT, signal.SIGCHLD}
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)  # none is missed just before the wait for it
    for number in map(int, os.listdir("/proc/self/fd")):
        if number > 2 and number not in kept:
            with suppress(OSError):
                os.close(number)
    while True:
        ended, status = os.waitpid(-1, os.WNOHANG)
        if ended == newest():
            os._exit(KILLED + os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status))
        if not ended and signal.sigwait(signals) == signal.SIGINT:
            with suppress(ProcessLookupError):
                os.kill(newest(), signal.SIGINT)


def _awaited(line: socket.socket, life: int) -> Message:
    """Wait for a message; exit when the first process has ended, or when an empty message arrives."""
    inputs = select.poll()
    inputs.register(line, select.POLLIN)
    inputs.register(life, select.POLLIN)
    while True:
        if any(number == life for number, _ in inputs.poll()):
            os._exit(0)
        size = int.from_bytes(_read(line, SIZE_BYTES), "little")
        if not size:
            os._exit(0)
        message: Message = json.loads(_read(line, size))
        return message


def _read(line: socket.socket, size: int) -> bytes:
    data = line.recv(size, socket.MSG_WAITALL)
    if len(data) < size:
        os._exit(0)
    return data


def _written_files() -> list[tuple[int, int, int]]:
    """Return descriptor, length and place of each file that is open for writing, without standard output and error."""
    found = []
    for number in map(int, os.listdir("/proc/self/fd")):
        with suppress(OSError):
            status = os.fstat(number)
            if number > 2 and stat.S_ISREG(status.st_mode) and _may_be_written(number):
                found.append((number, status.st_size, os.lseek(number, 0, os.SEEK_CUR)))
    return found


def _may_be_written(number: int) -> bool:
    flags = re.search(r"flags:\s*(\d+)", Path(f"/proc/self/fdinfo/{number}").read_text(encoding="ascii"))
    return flags is not None and int(flags[1], 8) & os.O_ACCMODE != os.O_RDONLY


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
