"""A flight core's use of its processor, where it is measured: memory, instructions, cycles."""

from dataclasses import dataclass

CLOCK_MHZ = 168


@dataclass(slots=True)
class EntryLoad:
    """Instructions and cycles of an entry point so far, over all calls."""

    calls: int = 0
    instructions: int = 0
    cycles: int = 0
    worst_instructions: int = 0
    worst_cycles: int = 0

    def add(self, instructions: int, cycles: int) -> None:
        self.merge(EntryLoad(1, instructions, cycles, instructions, cycles))

    def merge(self, other: "EntryLoad") -> None:
        """Add what another load has counted."""
        self.calls += other.calls
        self.instructions += other.instructions
        self.cycles += other.cycles
        self.worst_instructions = max(self.worst_instructions, other.worst_instructions)
        self.worst_cycles = max(self.worst_cycles, other.worst_cycles)

    def __str__(self) -> str:
        mean = self.instructions / max(self.calls, 1)
        counted = f" {mean:8.0f} instructions ({self.worst_instructions} at most)," if mean else ""
        return f"{self.calls:6} calls,{counted} {self.mean_us:6.1f} us ({self.worst_us:.1f})"

    @property
    def mean_us(self) -> float:
        """Processor time of an average call."""
        return self.cycles / max(self.calls, 1) / CLOCK_MHZ

    @property
    def worst_us(self) -> float:
        """Processor time of the longest call."""
        return self.worst_cycles / CLOCK_MHZ


@dataclass(frozen=True, slots=True)
class Usage:
    """What the core uses of the board: memory, and processor time by entry point."""

    flash_bytes: int | None  # None: not known of a real board
    ram_bytes: int  # the structs
    stack_bytes: int | None  # at most so far
    entries: dict[str, EntryLoad]
