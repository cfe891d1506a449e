"""Several implementations of the flight core in one flight: the same inputs, the whole memory compared after every call.

The reference flies; the other targets run on separate memory, which starts equal to the reference's and then receives
only what the tasks write: parameters and inputs. A target that has differed once is not run again, because
everything after that would differ too.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from firmware_py.core.structs import Parameters
from firmware_py.core.subset import Block
from firmware_py.core_runner import CoreBlocks, RunnerFactory, default_runner
from firmware_py.export.compare import Difference, differing_bits
from firmware_py.export.errors import ExportError


@dataclass(frozen=True, slots=True)
class Divergence:
    """The first difference between the reference and a target."""

    tick: int  # of the estimator; 0: before its first
    call: str  # the entry point after which it appeared
    where: str  # struct, `answer`, or the error that stopped the target
    differences: tuple[Difference, ...]  # all of that struct; none when the target was stopped

    def __str__(self) -> str:
        if not self.differences:
            return f"tick {self.tick}, in {self.call}: {self.where}"
        more = f", and {len(self.differences) - 1} more words" if len(self.differences) > 1 else ""
        return f"tick {self.tick}, after {self.call}: {self.where}.{self.differences[0]}{more}"


class ComparedTarget:
    """One implementation beside the reference."""

    def __init__(self, name: str, reference: CoreBlocks, factory: RunnerFactory) -> None:
        self.name = name
        self.blocks = CoreBlocks(_copy_of(reference.parameters), factory, reference.logic)
        self.divergence: Divergence | None = None
        self.calls = 0  # that were compared
        self.ticks = 0  # of the estimator, likewise


class SideBySide:
    """A `CoreRunner` that runs Python on the flight's memory and every target beside it."""

    def __init__(self, blocks: CoreBlocks, targets: Mapping[str, RunnerFactory]) -> None:
        self.targets = [ComparedTarget(name, blocks, factory) for name, factory in targets.items()]
        self._reference = default_runner(blocks)
        self.blocks = blocks
        self._inputs = blocks.inputs
        self._tick = 0
        self.reached: set[tuple[int, int]] = set()  # the supervisor's states, each with its cause

    def call(self, name: str) -> int:
        """Execute an entry point on the reference, and on every target that has not differed yet."""
        self._tick += name == "estimate"
        taken = self.blocks.calls[name]
        running = [target for target in self.targets if target.divergence is None]
        for target in running:
            for block in self._inputs.intersection(taken):
                target.blocks.named[block].memory[:] = self.blocks.named[block].memory
        result = self._reference.call(name)
        supervisor = self.blocks.supervisor.fields
        self.reached.add((int(supervisor.state), int(supervisor.cause)))
        memories = {block: self.blocks.named[block].bytes() for block in taken}
        for target in running:
            target.calls += 1
            try:
                answer = target.blocks.run.call(name)
            except ExportError as error:
                target.divergence = Divergence(self._tick, name, str(error), ())
            else:
                target.divergence = self._compare(name, memories, result, target.blocks, answer)
            target.ticks += name == "estimate" and target.divergence is None
        return result

    def _compare(
        self, call: str, memories: dict[str, bytes], result: int, blocks: CoreBlocks, answer: int
    ) -> Divergence | None:
        if answer != result:
            patterns = (result & 0xFFFFFFFF, answer & 0xFFFFFFFF)
            return Divergence(self._tick, call, "answer", (Difference("value", (result, answer), patterns),))
        for name, memory in memories.items():
            block = blocks.named[name]
            if found := differing_bits(memory, block.bytes(), block.kind.dtype):
                return Divergence(self._tick, call, block.kind.__name__, found)
        return None


def _copy_of(parameters: Block[Parameters]) -> Block[Parameters]:
    copy = Parameters.allocate()
    copy.memory[:] = parameters.memory
    return copy
