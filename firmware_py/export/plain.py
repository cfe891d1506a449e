"""The flight core as plain Python, in a separate process: numba is switched on or off for a whole process.

`PlainRunner` is the parent's end, `serve` the child's. A call goes over the pipe as one byte, its index among the calls, and
the memory of the blocks that it takes; the result, an int32, and the memory come back. The child's arguments name
the own logic that flies.
"""

import json
import os
import signal
import struct
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from firmware_py.compiling import PLAIN
from firmware_py.config import LogicConfig
from firmware_py.core.structs import Parameters
from firmware_py.core_runner import CoreBlocks, PythonRunner
from firmware_py.export.errors import ExportError
from firmware_py.logic.loading import Logic, load_logic

RESULT = struct.Struct("<i")


class PlainRunner:
    """Runs the core's Python sources without numba; a call raises `ExportError` when the child process has ended."""

    def __init__(self, blocks: CoreBlocks) -> None:
        root = str(Path(__file__).parents[2])
        path = os.pathsep.join((root, *filter(None, (os.environ.get("PYTHONPATH"),))))
        self._calls = _calls(blocks)
        files = {} if blocks.logic is None else dict(blocks.logic.loaded.files)
        self._child = subprocess.Popen(
            [sys.executable, "-m", "firmware_py.export.plain", json.dumps(files)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": path},
        )

    def close(self) -> None:
        """End the child process."""
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        with suppress(BrokenPipeError):  # it ended before
            self._child.stdin.close()
        self._child.wait()
        self._child.stdout.close()

    def call(self, name: str) -> int:
        """Execute an entry point in the child process."""
        memories = self._calls[name]
        up, down = self._child.stdin, self._child.stdout
        assert up is not None
        assert down is not None
        try:
            up.write(bytes((tuple(self._calls).index(name),)) + b"".join(one.tobytes() for one in memories))
            up.flush()
        except BrokenPipeError:
            raise ExportError("plain Python: the child process has ended") from None
        size = RESULT.size + _size(memories)
        answer = down.read(size)
        if len(answer) < size:
            raise ExportError("plain Python: the child process has ended in the middle of a call")
        _spread(answer[RESULT.size :], memories)
        result: int = RESULT.unpack_from(answer)[0]
        return result


def _calls(blocks: CoreBlocks) -> dict[str, list[np.ndarray]]:
    """Return the memory that each call takes."""
    return {name: [blocks.named[block].memory for block in taken] for name, taken in blocks.calls.items()}


def _size(memories: list[np.ndarray]) -> int:
    return sum(memory.nbytes for memory in memories)


def _spread(data: bytes, memories: list[np.ndarray]) -> None:
    """Write one memory after another."""
    offset = 0
    for memory in memories:
        memory.view(np.uint8)[:] = np.frombuffer(data, np.uint8, memory.nbytes, offset)
        offset += memory.nbytes


def serve(calls: BinaryIO, answers: BinaryIO, logic: Logic | None) -> None:
    """Execute calls until the other end closes."""
    blocks = CoreBlocks(Parameters.allocate(), PythonRunner, logic)
    names = list(_calls(blocks).items())
    while number := calls.read(1):
        name, memories = names[number[0]]
        _spread(calls.read(_size(memories)), memories)
        with np.errstate(all="ignore"):  # the comparison deals with infinities and NaN
            result = blocks.run.call(name)
        answers.write(RESULT.pack(result) + b"".join(memory.tobytes() for memory in memories))
        answers.flush()


if __name__ == "__main__":
    assert PLAIN
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    serve(sys.stdin.buffer, sys.stdout.buffer, load_logic(LogicConfig(**json.loads(sys.argv[1]))))
