"""GDB's remote serial protocol for a Cortex-M4F: packets in, packets out, without a socket or a clock.

The machine is stopped while packets are answered; `GdbServer` (gdb.py) carries the bytes.
"""

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from enum import Enum, auto
from typing import Any, Protocol
from xml.etree.ElementTree import Element, SubElement, tostring

from hil.emulator.stm32f405.freertos import FreeRtos, TaskView
from hil.errors import LabError

PACKET_SIZE = 0x4000
SIGINT, SIGTRAP, SIGABRT = 2, 5, 6
INTERRUPT = b"\x03"
ESCAPE, ESCAPED_WITH = 0x7D, 0x20
# Of received bytes: a packet or its beginning, an acknowledgement, Ctrl-C; anything between them is dropped.
ITEM = re.compile(rb"\$(?:([^#]*)#(..)|.*)|[-+\x03]", re.DOTALL)
MALFORMED, FAULT = b"E01", b"E0e"  # the numbers of EPERM and EFAULT
# Name and bytes, in the order of the target description: the index is the register's number on the wire.
CORE = tuple((name, 4) for name in (*(f"r{n}" for n in range(13)), "sp", "lr", "pc", "xpsr"))
FLOATING = (*((f"d{n}", 8) for n in range(16)), ("fpscr", 4))
SYSTEM = tuple((name, 4) for name in ("msp", "psp", "primask", "basepri", "faultmask", "control"))
REGISTERS = (*CORE, *FLOATING, *SYSTEM)
TYPES = {"sp": "data_ptr", "pc": "code_ptr", "msp": "data_ptr", "psp": "data_ptr"}


class Debuggee(Protocol):
    """A stopped machine. Its registers have the names of `REGISTERS`; addresses in `breakpoints` are even."""

    breakpoints: set[int]

    def watch(self, kind: int, address: int, size: int, on: bool) -> None:
        """Set or clear a stop after writes (2), reads (3) or both (4) of memory; raises `LabError` if it cannot."""

    def read(self, address: int, size: int) -> bytes:
        """Return memory; raises `LabError` at any other address."""

    def write(self, address: int, data: bytes) -> None:
        """Change memory, also code; raises `LabError` at any other address."""

    def register(self, name: str) -> int:
        """Return a register, without its sign."""

    def set_register(self, name: str, value: int) -> None:
        """Change a register."""


class ResumeRequest(Enum):
    """The debugger's request to the machine."""

    STOP = auto()
    RUN = auto()
    STEP = auto()
    BACK_STEP = auto()  # to the instruction before
    BACK_RUN = auto()  # to the last stop before
    DETACH = auto()
    KILL = auto()


BACK = (ResumeRequest.BACK_STEP, ResumeRequest.BACK_RUN)
RUNNING = (ResumeRequest.RUN, ResumeRequest.STEP, *BACK)


class MalformedError(Exception):
    """A packet without the arguments of its command."""


def target_description() -> str:
    """Return the description of the registers for GDB."""

    target = Element("target", version="1.0")
    SubElement(target, "architecture").text = "arm"
    for name, registers in (("m-profile", CORE), ("vfp", FLOATING), ("m-system", SYSTEM)):
        feature = SubElement(target, "feature", name=f"org.gnu.gdb.arm.{name}")
        for register, size in registers:
            kind = "ieee_double" if size == 8 else TYPES.get(register, "uint32")
            SubElement(feature, "reg", name=register, bitsize=str(8 * size), type=kind)
    return f'<?xml version="1.0"?><!DOCTYPE target SYSTEM "gdb-target.dtd">{tostring(target, "unicode")}'


def framed(payload: bytes) -> bytes:
    """Return a packet: escaped, with its checksum."""
    escaped = b"".join(bytes((ESCAPE, b ^ ESCAPED_WITH)) if b in b"#$}*" else bytes((b,)) for b in payload)
    return b"$%s#%02x" % (escaped, sum(escaped) & 0xFF)


class Framing:
    """Splits received bytes into packets; drops more than `2 * PACKET_SIZE` without an end."""

    def __init__(self) -> None:
        self._waiting = b""

    def split_packets(self, data: bytes) -> list[bytes]:
        """Return complete items: `$payload` of good packets, `!` for each with a wrong checksum, `+`, `-` and Ctrl-C."""
        received, self._waiting, found = self._waiting + data, b"", []
        for item in ITEM.finditer(received):
            payload, checksum = item.groups()
            if not item[0].startswith(b"$"):
                found.append(item[0])
            elif payload is None:  # its end has not arrived yet
                self._waiting = item[0] if len(item[0]) <= 2 * PACKET_SIZE else b""
            else:
                good = checksum.lower() == b"%02x" % (sum(payload) & 0xFF)
                found.append(b"$" + payload if good else b"!")
        return found


class RemoteProtocol:
    """One debugger of one machine: answers its queries; `request` is its request to the machine."""

    def __init__(self, debuggee: Debuggee, kernel: FreeRtos | None = None, backwards: bool = False) -> None:
        """`kernel` has the tasks, GDB's threads, each by the address of its control block.

        `backwards`: the machine can go back in time.
        """
        self._debuggee, self._kernel, self._backwards = debuggee, kernel, backwards
        self._thread = 0  # whose registers are requested; 0: those of the machine
        self._framing = Framing()
        self._items: list[bytes] = []
        self._watched: set[tuple[int, int, int]] = set()
        self._tasks: dict[int, str] = {}  # all that were seen
        self._acknowledging = True
        self._signal = SIGTRAP
        self._last = b""
        self.request = ResumeRequest.STOP
        self.interrupted = False  # Ctrl-C arrived while the machine ran
        self._changed = False  # it has changed registers or memory
        self._commands: dict[bytes, Callable[[bytes], bytes]] = {
            b"?": lambda _: self._stop_reply(),
            b"g": lambda _: self._registers(range(len(REGISTERS))),
            b"p": lambda rest: self._registers((_hex(rest),)),
            b"P": self._set_one_register,
            b"m": self._read,
            b"M": self._write,
            b"Z": lambda rest: self._breakpoint(rest, True),
            b"z": lambda rest: self._breakpoint(rest, False),
            b"c": lambda rest: self._resume(ResumeRequest.RUN, rest),
            b"s": lambda rest: self._resume(ResumeRequest.STEP, rest),
            b"C": lambda rest: self._resume(ResumeRequest.RUN, rest.partition(b";")[2]),
            b"S": lambda rest: self._resume(ResumeRequest.STEP, rest.partition(b";")[2]),
            b"v": self._continue,
            b"b": self._go_back,
            b"q": self._query,
            b"Q": self._set,
            b"H": self._select,
            b"T": lambda rest: b"OK" if _hex(rest) in self._all_threads() else MALFORMED,
            b"D": lambda _: self._leave(ResumeRequest.DETACH, b"OK"),
            b"k": lambda _: self._leave(ResumeRequest.KILL, b""),
        }

    def receive(self, data: bytes) -> bytes:
        """Return the answer to received bytes. While the machine runs, packets wait until it stops."""
        self._items += self._framing.split_packets(data)
        answers, waiting = b"", []
        for item in self._items:
            if self.request is ResumeRequest.STOP or not item.startswith(b"$"):
                answers += self._answered(item)
            else:
                waiting.append(item)
        self._items = waiting
        return answers

    def stopped(self, signal: int, watched: int | None = None, at_begin: bool = False) -> bytes:
        """Return the report that the running machine has stopped: at a watched access, or where its time begins."""
        self.request, self._signal, self.interrupted, self._thread = ResumeRequest.STOP, signal, False, 0
        self._last = framed(self._stop_reply(watched, at_begin))
        return self._last + self.receive(b"")

    def stored(self) -> dict[str, Any]:
        """Return, as JSON has it, what the debugger has set, which does not go back in time with the machine."""
        return {
            "breakpoints": sorted(self._debuggee.breakpoints), "watched": sorted(self._watched),
            "acknowledging": self._acknowledging, "tasks": list(self._tasks.items()),
        }  # fmt: skip

    def restore(self, stored: dict[str, Any]) -> None:
        """Set what `stored` has returned; the machine runs."""
        self._debuggee.breakpoints.clear()
        self._debuggee.breakpoints.update(stored["breakpoints"])
        watched = {(kind, address, size) for kind, address, size in stored["watched"]}
        for one in self._watched - watched:
            self._debuggee.watch(*one, on=False)
        for one in watched - self._watched:
            self._debuggee.watch(*one, on=True)
        self._watched, self._acknowledging = watched, stored["acknowledging"]
        self._tasks = dict(stored["tasks"])
        self._items, self._framing = [], Framing()
        self.request, self.interrupted, self._changed = ResumeRequest.RUN, False, False

    def take_changes(self) -> bool:
        """Return whether registers or memory were changed since the last call."""
        changed, self._changed = self._changed, False
        return changed

    @property
    def has_stops(self) -> bool:
        """Whether there is a breakpoint or a watchpoint."""
        return bool(self._debuggee.breakpoints or self._watched)

    def leave(self, request: ResumeRequest) -> None:
        """Remove all breakpoints from the machine."""
        self._debuggee.breakpoints.clear()
        for watched in self._watched:
            self._debuggee.watch(*watched, on=False)
        self._watched.clear()
        self.request = request

    def _answered(self, item: bytes) -> bytes:
        if item == INTERRUPT:
            self.interrupted = self.request in RUNNING
        if not item.startswith(b"$"):
            return {b"!": b"-" if self._acknowledging else b"", b"-": self._last}.get(item, b"")
        acknowledgement = b"+" if self._acknowledging else b""
        self._last = self._reply(item[1:])
        return acknowledgement + self._last

    def _reply(self, payload: bytes) -> bytes:
        """Return the answer to a packet; nothing while the machine runs or after it was killed."""
        command = self._commands.get(payload[:1])
        if command is None:
            return framed(b"")
        try:
            answer = command(payload[1:])
        except MalformedError:
            return framed(MALFORMED)
        except LabError:
            return framed(FAULT)
        return b"" if self.request in (*RUNNING, ResumeRequest.KILL) else framed(answer)

    def _stop_reply(self, watched: int | None = None, at_begin: bool = False) -> bytes:
        why = b"replaylog:begin;" if at_begin else b"" if watched is None else b"watch:%x;" % watched
        return b"T%02x%sthread:%x;" % (self._signal, why, self._running)

    def _registers(self, numbers: Iterable[int]) -> bytes:
        """Return registers of the selected thread; `x` for those not saved."""
        kept = None
        if self._kernel is not None and not self._is_machine():
            kept = self._kernel.saved_registers(self._thread)
        found = b""
        for name, size in map(_known, numbers):
            if kept is None or (name, size) in SYSTEM:  # registers that the processor has only once
                value: int | None = self._debuggee.register(name)
            else:
                value = kept.get(name)
            found += b"xx" * size if value is None else value.to_bytes(size, "little").hex().encode()
        return found

    def _is_machine(self) -> bool:
        return self._thread in (0, self._running)

    @property
    def _running(self) -> int:
        """Return the thread whose registers are the machine's: 1 without a scheduler."""
        return self._kernel.current_block if self._kernel is not None and self._kernel.running else 1

    def _all_threads(self) -> dict[int, str]:
        """Return all threads, the running one first; it is the only one without a scheduler."""
        running, tasks = self._running, list[TaskView]()
        if self._kernel is not None and self._kernel.running:
            with suppress(LabError):  # the scheduler is moving a task from list to list
                tasks = self._kernel.tasks()
            for task in tasks:
                self._tasks[task.block] = f"{task.name}, {task.state}, priority {task.priority}"
        every = self._tasks if running in self._tasks else {}
        return {running: every.get(running, "")} | every

    def _select(self, rest: bytes) -> bytes:
        """Select the thread for register access; ignore the choice of which one runs."""
        if rest[:1] == b"g":
            self._thread = 0 if rest[1:] in (b"0", b"-1") else _hex(rest[1:])
            if self._thread and self._thread not in self._all_threads():
                self._thread = 0
                return MALFORMED
        return b"OK"

    def _set_one_register(self, rest: bytes) -> bytes:
        number, _, value = rest.partition(b"=")
        name, size = _known(_hex(number))
        data = _unhex(value)
        if len(data) != size:
            raise MalformedError
        if not self._is_machine():
            raise LabError("the registers of a task that does not run cannot be changed")
        self._debuggee.set_register(name, int.from_bytes(data, "little"))
        self._changed = True
        return b"OK"

    def _read(self, rest: bytes) -> bytes:
        address, size = _pair(rest)
        return self._debuggee.read(address, min(size, PACKET_SIZE // 2)).hex().encode()

    def _write(self, rest: bytes) -> bytes:
        where, _, content = rest.partition(b":")
        address, size = _pair(where)
        data = _unhex(content)
        if not data or len(data) != size:
            raise MalformedError
        self._debuggee.write(address, data)
        self._changed = True
        return b"OK"

    def _breakpoint(self, rest: bytes, on: bool) -> bytes:
        kind, _, place = rest.partition(b",")
        if kind not in (b"0", b"1", b"2", b"3", b"4"):
            return b""
        address, size = _pair(place) if b"," in place else (_hex(place), 2)
        if kind in (b"0", b"1"):
            change = self._debuggee.breakpoints.add if on else self._debuggee.breakpoints.discard
            change(address & ~1)
            return b"OK"
        watched = (int(kind), address, size)
        if on != (watched in self._watched):
            self._debuggee.watch(*watched, on=on)
            self._watched ^= {watched}
        return b"OK"

    def _resume(self, request: ResumeRequest, address: bytes) -> bytes:
        if address:
            self._debuggee.set_register("pc", _hex(address) & ~1)
            self._changed = True
        self.request = request
        return b""

    def _continue(self, rest: bytes) -> bytes:
        """Resume by `vCont`, with which GDB leaves the steps to us: its own miss instructions within IT blocks."""
        if rest == b"Cont?":
            return b"vCont;c;C;s;S"
        name, *actions = rest.split(b";")
        if name == b"Cont" and actions:
            steps = any(action[:1] in (b"s", b"S") for action in actions)
            self.request = ResumeRequest.STEP if steps else ResumeRequest.RUN
        return b""

    def _go_back(self, rest: bytes) -> bytes:
        if self._backwards and rest in (b"s", b"c"):
            self.request = ResumeRequest.BACK_STEP if rest == b"s" else ResumeRequest.BACK_RUN
        return b""

    def _query(self, rest: bytes) -> bytes:
        if rest.startswith(b"Supported"):
            more = b";ReverseStep+;ReverseContinue+" if self._backwards else b""
            return b"PacketSize=%x;qXfer:features:read+;QStartNoAckMode+%s" % (PACKET_SIZE, more)
        if rest.startswith(b"Xfer:features:read:target.xml:"):
            offset, size = _pair(rest.rpartition(b":")[2])
            text = target_description().encode()
            return (b"m" if offset + size < len(text) else b"l") + text[offset : offset + size]
        if rest.startswith(b"ThreadExtraInfo,"):
            return self._all_threads().get(_hex(rest.partition(b",")[2]), "").encode().hex().encode()
        if rest == b"fThreadInfo":
            return b"m" + b",".join(b"%x" % thread for thread in self._all_threads())
        fixed = {b"Attached": b"1", b"C": b"QC%x" % self._running, b"sThreadInfo": b"l"}
        return fixed.get(rest, b"")

    def _set(self, rest: bytes) -> bytes:
        if rest != b"StartNoAckMode":
            return b""
        self._acknowledging = False
        return b"OK"

    def _leave(self, request: ResumeRequest, answer: bytes) -> bytes:
        self.leave(request)
        return answer


def _known(number: int) -> tuple[str, int]:
    if number >= len(REGISTERS):
        raise MalformedError
    return REGISTERS[number]


def _hex(digits: bytes) -> int:
    if not re.fullmatch(rb"[0-9a-fA-F]+", digits):
        raise MalformedError
    return int(digits, 16)


def _unhex(digits: bytes) -> bytes:
    try:
        return bytes.fromhex(digits.decode("ascii"))
    except ValueError:
        raise MalformedError from None


def _pair(text: bytes) -> tuple[int, int]:
    first, _, second = text.partition(b",")
    return _hex(first), _hex(second)
