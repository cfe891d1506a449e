"""Reports of a firmware's crash: a fault, an assertion or its watchdog, with task, function, line and callers.

A hang and a stack overflow are reported when they are detected, because their consequences blame other code.

Fault handlers and the function of failed assertions are inspected before their first instruction runs: `addresses` has
these breakpoints. The bits are those of the ARMv7-M Architecture Reference Manual, B3.2.15 and B3.2.16.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import PurePath
from struct import unpack, unpack_from

from hil.emulator.stm32f405.chip import Chip
from hil.emulator.stm32f405.debug_info import LR, PC, SP
from hil.emulator.stm32f405.freertos import FreeRtos, stacked_registers
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError

CFSR, HFSR, MMFAR, BFAR = 0xE000_ED28, 0xE000_ED2C, 0xE000_ED34, 0xE000_ED38
USES_PSP = 1 << 2  # in EXC_RETURN
NOT_STACKED = 1 << 12  # in CFSR: the interrupted code has no frame
FAULTS = {3: "HardFault", 4: "MemManage fault", 5: "BusFault", 6: "UsageFault"}
FIRST_INTERRUPT = 16
LONGEST_TEXT = 128
NULL_SIZE = 0x400  # reach of a null pointer: a member of a structure, an item of an array
NAMES = (*(f"r{n}" for n in range(13)), "sp", "lr", "pc")
CFSR_WORDS = {
    0: "an instruction fetched where none may be executed", 1: "access to protected memory",
    3: "protected memory while returning from an exception", 4: "protected memory while entering an exception",
    5: "protected memory while storing floats", 8: "an instruction fetched where there is no memory",
    9: "access to where there is no memory", 10: "a write to where there is no memory, some instructions ago",
    11: "no memory at the stack pointer while returning from an exception",
    12: "no memory at the stack pointer while entering an exception",
    13: "no memory at the stack pointer while storing floats",
    16: "undefined instruction", 17: "jump to an even address: not Thumb code", 18: "invalid return from an exception",
    19: "the floating-point unit is switched off", 24: "unaligned access", 25: "division by zero",
}  # fmt: skip
MMFAR_VALID, BFAR_VALID = 1 << 7, 1 << 15
VECTOR_UNREADABLE, ESCALATED, BREAKPOINT = 1 << 1, 1 << 30, 1 << 31  # in HFSR


@dataclass(frozen=True, slots=True)
class Crash:
    """Why the firmware stopped."""

    what: str  # what happened
    who: str  # the task or interrupt in which it happened
    trace: tuple[str, ...]  # the place, its caller, and so on: each `function (file.c:12)`

    def __str__(self) -> str:
        runs = [(place, len(list(same))) for place, same in groupby(self.trace)]
        places = [place if times == 1 else f"{place}, {times} times" for place, times in runs]
        return f"{self.what}, in {self.who}" + (f": {' < '.join(places)}" if places else "")


class CrashReports:
    """The crashes of one image on one chip."""

    def __init__(self, image: Image, chip: Chip, kernel: FreeRtos | None, assertion: str) -> None:
        """Watch the fault handlers and `assertion`, a function of three arguments: expression, file and line."""
        self._image, self._chip, self._kernel = image, chip, kernel
        self._handlers = {self._vector(number) & ~1 for number in FAULTS}
        self._assertion = image.symbol(assertion).address if image.has(assertion) else 0

    @property
    def addresses(self) -> frozenset[int]:
        """Return where the machine must stop for `here`, once: a handler may be a loop of one instruction."""
        return frozenset({*self._handlers, self._assertion} - {0})

    def here(self) -> Crash:
        """Return the crash at one of `addresses`."""
        return self._assertion_failed() if self._chip.register("pc") == self._assertion else self._fault()

    def watchdog(self) -> Crash:
        """Return the code that ran when the watchdog expired."""
        return self._here("watchdog reset: nobody fed it in time; this ran then")

    def lockup(self) -> Crash:
        """Return where the processor gave up: at a fault inside a fault's handler or on entry to it."""
        return self._here(f"lock-up, no fault handler could run: {fault_reasons(self._chip)}")

    def overflow(self, task: int) -> Crash:
        """Return the task whose stack overflowed, and its current place: it may have returned."""
        registers, what = self._registers_of(task), "stack overflow"
        if self._kernel is not None and registers.get(SP, 0) >= self._kernel.stack_begin(task):
            what += ", some calls before this place"
        return Crash(what, self._task(task), self._trace(registers))

    def hang(self, task: int, busy_us: int) -> Crash:
        """Return the place of a task that blocks all others of its priority or below."""
        what = f"hang: busy for {busy_us // 1000} ms without waiting for anything"
        return Crash(what, self._task(task), self._trace(self._registers_of(task)))

    def stopped(self, task: int, silent_us: int, period_us: int, reason: str) -> Crash:
        """Return the place where a task waits that used to run every `period_us`."""
        what = f"stopped: silent for {silent_us // 1000} ms after running every {period_us * 1e-3:.3g} ms, {reason}"
        return Crash(what, self._task(task), self._trace(self._registers_of(task)))

    def software_reset(self) -> Crash:
        """Return the code that requested a reset of the chip."""
        return self._here("reset by software")

    def low_access(self, address: int, writes: bool) -> Crash:
        """Return the code that uses a null pointer, or an offset from it."""
        pointer = "null pointer" if address < NULL_SIZE else "wild pointer"
        if writes:
            return self._here(f"{pointer}: write to 0x{address:08x}, which has no effect and causes no fault")
        what = f"{pointer}: read at 0x{address:08x}, where the chip has its flash again; no fault follows"
        return self._here(f"{what}, and the next reads are not reported")

    def division(self) -> Crash:
        """Return the code that divides by zero."""
        return self._here(
            "division by zero: its result is 0; no fault follows, and the next are not reported"
        )

    def _here(self, what: str) -> Crash:
        number = self._chip.register("xpsr") & 0x1FF
        return Crash(what, self._who(number), self._trace(self._registers()))

    def _assertion_failed(self) -> Crash:
        expression, file = (self._text(self._chip.register(name)) for name in ("r0", "r1"))
        line = self._chip.register("r2")
        crash = self._here(f"assertion {expression} failed at {file}:{line}")
        return replace(crash, trace=self._with_place(f"{PurePath(file).name}:{line}", crash.trace[1:]))

    def _with_place(self, line: str, trace: tuple[str, ...]) -> tuple[str, ...]:
        """Return a trace that begins at a line: a function's last call leaves no frame, or another line."""
        place = self._image.place(code) if (code := self._image.debug.address_of(line)) else ""
        if not place or place in trace[:1]:
            return trace
        same = bool(trace) and trace[0].split()[0] == place.split()[0]
        return (place, *trace[1 if same else 0 :])

    def _fault(self) -> Crash:
        exc_return = self._chip.register("lr")
        frame = self._chip.register("psp" if exc_return & USES_PSP else "msp")
        number = self._chip.register("xpsr") & 0x1FF
        what = f"{self._who(number)} is not handled"
        if number in FAULTS:
            what = f"{FAULTS[number]}: {fault_reasons(self._chip)}"
        try:
            stacked = stacked_registers(self._chip.read, frame, exc_return)
        except LabError:
            return Crash(f"{what}; there is no memory at its stack pointer, 0x{frame:08x}", self._who(0), ())
        if self._word(CFSR) & NOT_STACKED:
            return Crash(what, self._who(0), ())
        return Crash(what, self._who(stacked["xpsr"] & 0x1FF), self._trace(self._numbered(stacked)))

    def _who(self, number: int) -> str:
        """Return the task, or the handler of the exception with that number."""
        if number:
            handler, own = self._vector(number) & ~1, number - FIRST_INTERRUPT
            name = self._image.function_at(handler) if self._image.named else f"0x{handler:08x}"
            return f"{f'interrupt {own}' if own >= 0 else f'exception {number}'} ({name or 'no handler'})"
        if self._kernel is None or not self._kernel.running:
            return "main, before the scheduler ran"
        return self._task(self._kernel.current_block)

    def _task(self, task: int) -> str:
        assert self._kernel is not None
        return f"task {self._kernel.name(task)}"

    def _registers_of(self, task: int) -> dict[int, int]:
        """Return the registers of a task: saved by the scheduler, interrupted, or running; none without memory there."""
        assert self._kernel is not None
        if task == self._kernel.current_block and not self._chip.register("xpsr") & 0x1FF:
            return self._registers()
        with suppress(LabError):
            if task != self._kernel.current_block:
                return self._numbered(self._kernel.saved_registers(task))
            psp, exc_return = self._chip.register("psp"), int(self._chip.state.task_return)
            return self._numbered(stacked_registers(self._chip.read, psp, exc_return))
        return {}

    def _trace(self, registers: dict[int, int]) -> tuple[str, ...]:
        """Return the places of a backtrace, as far as the stack can be read; none without registers."""
        if not registers:
            return ()
        pcs: list[int] = []
        with suppress(LabError):
            for pc in self._image.debug.frames.backtrace(registers, self._word):
                if pcs and not self._follows_call(pc + 1):
                    break  # the function of a task has no caller
                pcs.append(pc)
        # Compilers omit the frame at a function's early end. The link register still has the caller then.
        caller = (registers[LR] & ~1) - 1
        elsewhere = self._image.function_at(caller) != self._image.function_at(registers[PC])
        if len(pcs) == 1 and elsewhere and self._follows_call(caller + 1):
            pcs.append(caller)
        return tuple(self._image.place(pc) for pc in pcs)

    def _follows_call(self, address: int) -> bool:
        """Return whether the instruction before an address of the image is BL or BLX."""
        at = address - 4 - self._image.base
        if not 0 <= at <= len(self._image.code) - 4:
            return False
        first, second = unpack_from("<2H", self._image.code, at)
        return bool((first & 0xF800 == 0xF000 and second & 0xD000 == 0xD000) or second & 0xFF87 == 0x4780)

    def _registers(self) -> dict[int, int]:
        """Return the current r0 to pc by number."""
        return {number: self._chip.register(name) for number, name in enumerate(NAMES)}

    def _numbered(self, registers: dict[str, int]) -> dict[int, int]:
        """Return r0 to pc by number, with current values for unsaved ones."""
        return {n: registers.get(name, self._chip.register(name)) for n, name in enumerate(NAMES)}

    def _vector(self, exception: int) -> int:
        return int.from_bytes(self._image.code[4 * exception :][:4], "little")

    def _text(self, address: int) -> str:
        """Return a string from the image's constants, or its address."""
        with suppress(LabError, UnicodeDecodeError):
            return self._chip.read(address, LONGEST_TEXT).partition(b"\0")[0].decode("ascii")
        return f"0x{address:08x}"

    def _word(self, address: int) -> int:
        return _word(self._chip, address)


def fault_reasons(chip: Chip) -> str:
    """Return the bits of the fault status registers in words."""
    status, hard = _word(chip, CFSR), _word(chip, HFSR)
    reasons = [words for bit, words in CFSR_WORDS.items() if status >> bit & 1]
    if hard & VECTOR_UNREADABLE:
        reasons.append("the vector of an exception could not be read")
    if hard & BREAKPOINT:
        reasons.append("a breakpoint instruction without a debugger")
    if hard & ESCALATED and not reasons:
        reasons.append("a supervisor call where its priority does not allow it")
    what = " and ".join(reasons) or "for a reason that its registers do not say"
    if status & (BFAR_VALID | MMFAR_VALID):
        return f"{what} at 0x{_word(chip, BFAR if status & BFAR_VALID else MMFAR):08x}"
    return what


def _word(chip: Chip, address: int) -> int:
    return int(unpack("<I", chip.read(address, 4))[0])
