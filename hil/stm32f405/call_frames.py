"""Who called whom: stack frames undone by the rules that the compiler wrote down (DWARF's call frame information)."""

from bisect import bisect_right
from collections.abc import Callable, Iterator
from typing import Any

SP, LR, PC = 13, 14, 15
DEEPEST = 32


class CallFrames:
    """The rules of one image."""

    def __init__(self, dwarf: Any) -> None:
        entries = dwarf.CFI_entries() if dwarf.has_CFI() else []
        self._entries = sorted(
            (entry for entry in entries if "initial_location" in entry.header),
            key=lambda entry: int(entry["initial_location"]),
        )
        self._starts = [entry["initial_location"] for entry in self._entries]

    def backtrace(self, registers: dict[int, int], read_word: Callable[[int], int]) -> Iterator[int]:
        """Yield the pc, then an address in the caller, in its caller, and so on, as far as the rules go.

        `registers` has at least sp (13), lr (14) and pc (15); `read_word` reads the stack.
        """
        yield registers[PC]
        if self._rules_at(registers[PC]) is None:  # a jump to where no function is has not changed the stack
            registers = registers | {PC: (registers[LR] & ~1) - 1}
            yield registers[PC]
        for _ in range(DEEPEST):
            registers = self._caller(registers, read_word)
            if not registers:
                return
            yield registers[PC]

    def _caller(self, registers: dict[int, int], read_word: Callable[[int], int]) -> dict[int, int]:
        """Return the registers as the caller had them at its call; empty when that cannot be found."""
        rules = self._rules_at(registers[PC])
        if rules is None or rules["cfa"].reg not in registers:
            return {}
        frame = registers[rules["cfa"].reg] + rules["cfa"].offset
        before = dict(registers)
        for number, rule in rules.items():
            if isinstance(number, int) and number <= LR and rule.type == "OFFSET":
                before[number] = read_word(frame + rule.arg)
        before[SP] = frame
        # A return address follows its call, and with it perhaps the function: one before it lies inside the call.
        before[PC] = (before[LR] & ~1) - 1
        return before if (before[PC], frame) != (registers[PC], registers[SP]) else {}

    def _rules_at(self, address: int) -> dict[Any, Any] | None:
        """Return how the frame of a function is undone at an address."""
        index = bisect_right(self._starts, address) - 1
        entry = self._entries[index] if index >= 0 else None
        if entry is None or address >= entry["initial_location"] + entry["address_range"]:
            return None
        # A function that keeps nothing on its stack has no rows of its own, only those that all functions begin with.
        rows = [
            row for row in entry.get_decoded().table if row["pc"] <= address
        ] or entry.cie.get_decoded().table
        return rows[-1] if rows else None
