"""A flight core that a real board executes, call by call: the fourth core runner.

The core's memory exists here, as with every board, and on the board. Before a call, changes here are written to the
board; after it, the board reports a CRC of its memory. The expected result is computed here as well: if the CRC confirms
it, nothing is read; otherwise all memory is. So the board's result flies.
"""

from contextlib import ExitStack
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from firmware_py.core_runner import CoreBlocks, RunnerFactory, default_runner
from firmware_py.export.usage import EntryLoad, Usage
from firmware_py.extras import install_command
from firmware_py.wire.core_port import WRITE_MAX, About, Call, Called, call, write
from ground_station.errors import LinkError
from ground_station.links.core_client import CoreClient, runs
from hil.errors import LabError

Bytes = NDArray[np.uint8]
# Calls of every millisecond are executed here: a call over a link takes longer.
HERE = ("begin_step", "take_sample")


def is_link(board: str) -> bool:
    """Whether a board is real, named by the URI of its link."""
    return "://" in board


def open_real_core(uri: str, option: str, stack: ExitStack) -> CoreClient:
    """Return a board's core; the stack closes its link. Raises `LabError` that names the option."""
    try:
        from ground_station.links.packets import CflibPackets

        client = CoreClient(CflibPackets(uri), uri)
    except ImportError as error:
        raise LabError(f"{option} {uri}: {error}: {install_command('radio')}") from None
    except LinkError as error:
        raise LabError(f"{option} {error}") from None
    stack.callback(client.close)
    return client


def real_core(uri: str, stack: ExitStack) -> RunnerFactory:
    """Return the core runner of a board, until the stack is closed. Raises `LabError`."""
    client = open_real_core(uri, "--board", stack)
    return lambda blocks: RealCore(blocks, client)


class RealCore:
    """A `CoreRunner` and a `CoreCosts`; `load` has the cycles of each entry point, measured by the board.

    `about` is the board. Raises `LinkError` when the board does not answer or has another memory layout.
    """

    def __init__(self, blocks: CoreBlocks, client: CoreClient) -> None:
        self.load = {entry.name.lower(): EntryLoad() for entry in Call if entry.name.lower() not in HERE}
        self.unexpected = 0  # calls with another result than here
        self._client = client
        self._host = default_runner(blocks)
        self._here = _bytes_of(blocks)
        # computes a call without changing the flight
        self._copy = CoreBlocks(blocks.parameters.kind.allocate(), default_runner, blocks.logic)
        self._expected = _bytes_of(self._copy)
        size = sum(memory.size for memory in self._here)
        self.about: About = client.begin()
        if self.about.size != size:
            raise LinkError(
                f"{client.name}: its core has {self.about.size} B of memory, this one {size}: export and flash it again"
            )
        self._there = np.zeros(size, np.uint8)  # the board's memory
        self._filed_cycles = 0  # for poses since the last step of the estimator
        # the call whose results the board has, and its inputs
        self._ahead: tuple[str, Bytes, Called] | None = None

    def call(self, name: str) -> int:
        """Execute an entry point and apply its results; reuse one executed ahead on the same inputs."""
        if name in HERE:
            return self._host.call(name)
        inputs = np.concatenate(self._here)
        if self._ahead is not None and self._ahead[0] == name and np.array_equal(self._ahead[1], inputs):
            called = self._ahead[2]
        else:
            called = self._execute(name, inputs)
        self._ahead = None
        self.load[name].add(0, called.cycles)
        if name == "file_pose":
            self._filed_cycles += called.cycles
        elif name == "estimate":
            self._filed_cycles = 0
        _fill(self._here, self._there)
        return called.answer

    def estimate_us(self) -> int:
        """Return the processor time of the estimator's next call, including the poses filed since the last one."""
        return self._microseconds(self._filed_cycles + self._look_ahead("estimate").cycles)

    def control_us(self) -> int:
        return self._microseconds(self._look_ahead("control").cycles)

    @property
    def usage(self) -> Usage:
        return Usage(None, self.about.size, None, self.load)

    def _look_ahead(self, name: str) -> Called:
        """Execute an entry point without applying its results."""
        inputs = np.concatenate(self._here)
        called = self._execute(name, inputs)
        self._ahead = name, inputs, called
        return called

    def _execute(self, name: str, inputs: Bytes) -> Called:
        changed = np.flatnonzero(inputs != self._there).tolist()
        data = inputs.tobytes()
        requests = [write(offset, data[offset : offset + size]) for offset, size in runs(changed, WRITE_MAX)]
        answers = self._client.execute((*requests, call(Call[name.upper()])))
        called = answers[-1].called()
        _fill(self._expected, inputs)
        self._copy.run.call(name)
        self._there = np.concatenate(self._expected)
        if crc32(self._there.data) != called.digest:
            self.unexpected += 1
            self._there = np.frombuffer(self._client.memory(self._there.size), np.uint8)
        return called

    def _microseconds(self, cycles: int) -> int:
        return -(-cycles // self.about.clock_mhz)


def _bytes_of(blocks: CoreBlocks) -> tuple[Bytes, ...]:
    return tuple(block.memory.view(np.uint8) for block in blocks.named.values())


def _fill(memories: tuple[Bytes, ...], data: Bytes) -> None:
    place = 0
    for memory in memories:
        memory[:] = data[place : place + memory.size]
        place += memory.size
