"""What the emulator said of the tests' firmware, it still says: its reports, its counts and its answers to a debugger.

Crashes of every kind, where the cycles went, a debugger's random questions, what the debugging information knows, and
what the time line and the kernel's structures hold after random use. If a change is meant: make approve.
"""

import dataclasses
import hashlib
import socket
import struct
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.emulator.stm32f405 import crash as crashes
from hil.emulator.stm32f405.chip import CYCLES_PER_US, RAM, SOFTWARE, WATCHDOG, Chip, StopReason
from hil.emulator.stm32f405.coverage import ImageLines
from hil.emulator.stm32f405.cpu_profile import functions_of
from hil.emulator.stm32f405.debugged_chip import DebuggedChip
from hil.emulator.stm32f405.freertos import FreeRtos, Wait
from hil.emulator.stm32f405.gdb import GdbServer
from hil.emulator.stm32f405.gdb_protocol import (
    REGISTERS,
    SIGINT,
    SIGTRAP,
    RemoteProtocol,
    ResumeRequest,
    framed,
)
from hil.emulator.stm32f405.image import Image
from hil.emulator.stm32f405.literals import literals
from hil.emulator.stm32f405.processor import ChipProcessor
from hil.emulator.stm32f405.stopped_tasks import LOOKS, PERIODS, SETTLED_US, TaskWatch
from hil.emulator.stm32f405.unnamed_freertos import UnnamedFreeRtos
from hil.errors import LabError
from hil.world.body import Carrier
from hil.world.room import Room
from support.approved import Log, approve, judge, tiers
from support.crazyflie_board import Board, image
from support.flight_backwards import Flight
from support.random_use import by_seed
from support.stm32_firmware import build
from support.stm32_machine import FirmwareOnChip, Profiled

REPORTS = Path(__file__).with_name("emulator.json")
MISTAKES = range(21)  # `enum planted` of the tests' firmware
NAMELESS = (1, 3, 5, 7, 9, 10, 11, 16, 19)
HANG = 9  # ends by the watchdog
PACKETS, SEEDS = 150, range(1, 4)
USUAL = ("-g", "-DUSUAL_PLACES", "-fno-strict-aliasing")  # what is found without symbols
MADE_WITH = ("ziglang", "pyelftools")


def crash(planted: int) -> list[str]:
    """Return what a board says of a mistake, what counts as a failure, its resets and its last outputs."""
    board = Board(planted)
    board.run(0, 450 if planted == HANG else 130)
    own = board.crazyflie
    return [
        *board.said,
        f"failures {len(own.failures)}, known {own.known}, resets {own.resets}, {board.counts[-3:]}",
    ]


def nameless(planted: int) -> list[str]:
    """Return what a board says of a mistake whose image has no names."""
    elf = Image(build(flags=USUAL))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cf2.bin"
        path.write_bytes(elf.code)
        board = Board(planted, own=Image(path))
    assert elf.symbol("planted").address == image().symbol("planted").address
    board.run(0, 450 if planted == HANG else 60)
    own = board.crazyflie
    tasks = own.tasks.tasks() if own.tasks is not None else []
    names = [task.name for task in own.processor.tasks]
    return [
        *board.said[:12],
        f"{len(board.said)}, {own.known}, {own.resets}, {own.clock_us}, {tasks}, {names}",
    ]


def carried() -> dict[str, str]:
    """Return what the sensors of a board that a body carries show, and what the ESC of its second motor answers."""
    log, motion = Log(), Made(p_WB=np.zeros(3), q_WB=np.array((1.0, 0.0, 0.0, 0.0)))
    escs = np.array((4_000.0, 7_000.0, 9_000.0, 11_000.0))
    carrier = Carrier(motion, np.random.default_rng(1), Room(0.0, 2.0, 2.5), ("flow2", "multiranger"), escs)  # type: ignore[arg-type]
    outputs = ((2, 0), (1, 1), (3, 2), (3, 3))
    board = Board(carrier=carrier, outputs=outputs, polls=True)
    own = board.crazyflie
    edges = image().symbol("edges")
    for ms in range(0, 90, 3):
        motion.p_WB[2] = 0.01 * ms
        board.run(ms, ms + 3)
        own.parts.sample((ms, 1, 2, 3, 4, 5))
        shown = (own.parts.gyro[:10], own.parts.accel[:30], own.parts._barometer._registers[:12])
        log.note("registers", ms, *(one.tobytes().hex() for one in shown))
        log.note("edges", ms, own.chip.read(edges.address, edges.size).hex())
        log.note("state", ms, own.parts.device_type, board.counts[-1:], own.radio._heard_us, own._crashed)
        own._outside.eeprom[ms] = ms
        log.note(
            "decks", own.radio._decks.answer(0x20, b"").hex(), own.radio._decks.answer(0x21, b"\1").hex()
        )
    state, names = own.chip.state, ("size", "address_bytes", "bus", "address", "pairs", "watched")
    for device in state.device[0 : state.devices]:
        log.note("devices", *(getattr(device, name) for name in names), bytes(device.memory[0:4]).hex())
    for esc in state.esc[0 : state.escs]:
        log.note("escs", esc.rpm[0], esc.timer, esc.channel, esc.poles)
    log.note("said", *board.said)
    return log.told()


def profile() -> list[str]:
    """Return where the cycles of 200 ms went."""
    return list(told(Profiled("clang").run_with_samples(200_000), "profile"))


def profiles() -> dict[str, str]:
    """Return hashes of where the cycles went of code without inlining: in peace, with resets, in a scenario."""
    log = Log()
    for planted, scenario, end_us in ((0, 0, 60_000), (3, 0, 30_000), (0, 2, 5_000), (0, 3, 5_000)):
        firmware = Profiled("clang", flags=("-g", "-fno-inline"), planted=planted, scenario=scenario)
        for line in told(firmware.run_with_samples(end_us), "profile"):
            log.note(f"{planted} {scenario} {line.split('.')[1].split('[')[0].split(':')[0]}", line)
    return log.told()


def told(value: Any, name: str) -> Iterator[str]:
    """Yield the members of nested records, a line for each number or text; arrays by count, first, last and sum."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from told(getattr(value, field.name), f"{name}.{field.name}")
    elif isinstance(value, np.ndarray):
        yield f"{name}: {value.size} {value[:1]} {value[-1:]} {value.sum():.6g}"
    elif isinstance(value, list | tuple) and value and not isinstance(value[0], int | float | str):
        for number, one in enumerate(value):
            yield from told(one, f"{name}[{number}]")
    else:
        yield f"{name}: {value:.6g}" if isinstance(value, float) else f"{name}: {value}"


def picking(seed: int) -> tuple[np.random.Generator, Callable[..., Any]]:
    """Return random numbers, and what picks one of its arguments."""
    rng = np.random.default_rng(seed)
    return rng, lambda *of: of[int(rng.integers(len(of)))]


def debugger(seed: int) -> list[str]:
    """Return what random packets of a debugger are answered, between short runs; the last one knows the tasks."""
    (rng, pick), firmware = picking(seed), FirmwareOnChip()
    knows = seed == SEEDS[-1]
    kernel = FreeRtos(firmware.image, firmware.chip.read) if knows else None
    protocol, threads = RemoteProtocol(firmware.chip, kernel, knows), (1, 2, 3)
    found = []
    for number in range(PACKETS):
        if knows and number == 10:
            firmware.run(3_000)
            threads = tuple(one.block for one in kernel.tasks())  # type: ignore[union-attr]
        at, register = RAM + 4 * int(rng.integers(0, 64)), int(rng.integers(len(REGISTERS) + 1))
        length = pick(0, 1, 2, 4, 16)
        packet = pick(
            "?", "g", f"p{register:x}", f"m{at:x},{length:x}", f"m{at:x},{length:x}", f"M{at:x},4:{rng.bytes(4).hex()}",
            f"Z{pick(0, 1, 2, 3, 4)},{at:x},{pick(1, 2, 4)}", f"z{pick(0, 1, 2, 3, 4)},{at:x},{pick(1, 2, 4)}",
            "qfThreadInfo", f"qThreadExtraInfo,{pick(*threads):x}", f"Hg{pick(*threads):x}", f"Hg{pick(*threads):x}",
            f"H{pick('g', 'c')}{pick(-1, 0, 1, 2)}", f"T{pick(9, *threads):x}", pick("bc", "vCont;s", "C05", "S05"),
            f"qXfer:features:read:target.xml:{pick(0, 100, 9000):x},{pick(10, 9000):x}",
            "qC", "qSupported", "vCont?", "qAttached", f"P{pick(0, 1, 5):x}={rng.bytes(4).hex()}", "D", "bs", "c", "s",
            "qRcmd,666f6f",
        )  # fmt: skip
        answer = protocol.receive(framed(packet.encode()))
        if protocol.request is not ResumeRequest.STOP:
            why = firmware.run(int(firmware.chip.now_us) + pick(20, 700))
            found.append(f"{packet} {protocol.request.name}: {StopReason(why)} {firmware.chip.now_us}")
            answer += protocol.stopped(pick(SIGTRAP, SIGINT), pick(None, at), bool(rng.integers(2)))
        text = answer.decode("latin-1")
        found.append(f"{packet} -> {text if len(text) < 90 else hashlib.sha256(answer).hexdigest()[:12]}")
    found.append(f"{sorted(firmware.chip.breakpoints)} {protocol.take_changes()} {protocol.take_changes()}")
    return [*found, str(protocol.stored())]


class Session:
    """A debugger that sets breakpoints and watchpoints anywhere, steps, interrupts and leaves, without a socket."""

    checkpoints, from_us, is_connected = None, 0, True

    def __init__(self, seed: int) -> None:
        (self.rng, self.pick), self.log = picking(seed), Log()
        self.firmware = FirmwareOnChip()
        image, chip = self.firmware.image, self.firmware.chip
        self.places = [
            one.address + 2 * int(self.rng.integers(one.size // 2)) for one in image.functions if one.size
        ]
        self.words = [
            image.symbol(name).address for name in ("xTickCount", "tasks", "queue", "samples_taken", "eeprom")
        ]
        chip.crash_points |= {image.symbol(name).address for name in ("assertFail", "Stuck_Handler")}

    def attach(self, chip: Chip, kernel: FreeRtos) -> None:
        self.protocol = RemoteProtocol(chip, kernel)

    def wants_to_stop(self) -> bool:
        return bool(self.rng.random() < 0.1)

    def hold(self, signal: int, watched: int | None = None, at_begin: bool = False) -> ResumeRequest:
        """Send some packets, of which the last one resumes."""
        chip, pick, protocol = self.firmware.chip, self.pick, self.protocol
        self.log.note(
            "held", signal, watched, at_begin, chip.now_us, chip.register("pc"), chip.state.instructions
        )
        if protocol.request is not ResumeRequest.STOP:
            self.log.note("reported", protocol.stopped(signal, watched, at_begin))
        for _ in range(pick(0, 1, 3)):
            set_or_clear, place, word = pick("Z", "Z", "z"), pick(*self.places), pick(*self.words)
            packet = pick(f"{set_or_clear}0,{place:x},2", f"{set_or_clear}0,{place:x},2", f"{set_or_clear}2,{word:x},4",
                          f"{set_or_clear}{pick(3, 4)},{word:x},{pick(1, 4)}", "g", "?")  # fmt: skip
            protocol.receive(framed(packet.encode()))
        if len(chip.breakpoints) > 4:
            for place in sorted(chip.breakpoints):
                protocol.receive(framed(b"z0,%x,2" % place))
        protocol.receive(framed(pick(b"c", b"c", b"s", b"s", b"vCont;s:1;c")))
        return protocol.request

    def told(self) -> dict[str, str]:
        chip, kernel = self.firmware.chip, FreeRtos(self.firmware.image, self.firmware.chip.read)
        debugged, end = DebuggedChip(chip, self, kernel), 0  # type: ignore[arg-type]
        for _ in range(150):
            end += self.pick(10, 300, 1_000) * CYCLES_PER_US
            why = debugged.run(end)
            self.log.note("ran", why, chip.state.now, chip.register("pc"))
            if why & StopReason.RESET:
                chip.reset(SOFTWARE)
        return self.log.told()


def remote(seed: int) -> dict[str, str]:
    """Return what debuggers are answered on a socket, one after the other, which ask in one piece and leave or hang up."""
    (rng, pick), firmware, log = picking(seed), FirmwareOnChip(), Log()
    server = GdbServer(0, lambda port: log.note("waiting", port == server.port))
    kernel = FreeRtos(firmware.image, firmware.chip.read)
    chip, end_us = DebuggedChip(firmware.chip, server, kernel if seed % 2 else None), 0
    lines = [firmware.image.symbol(name).address for name in ("send_line", "tick", "vTaskSwitchContext")]
    for number in range(8):
        end_us = 1_000 + firmware.chip.now_us
        if pick(True, False, False):
            with socket.create_connection(("127.0.0.1", server.port)) as browser:
                browser.sendall(b"GET / HTTP/1.1")
                while number and server.wants_to_stop():
                    log.note("refused", number)
        with socket.create_connection(("127.0.0.1", server.port)) as line:
            packets = [
                pick(b"c", b"s", b"g", b"?", b"qC", b"QStartNoAckMode", b"Z0,%x,2" % pick(*lines), b"bs", b"vCont;s",
                     b"z0,%x,2" % pick(*lines), b"P4=%s" % rng.bytes(4).hex().encode())
                for _ in range(pick(2, 6, 20))
            ]  # fmt: skip
            last = pick(b"", b"\x03", framed(b"D"), framed(b"k"), b"$bad#00")
            line.sendall(b"+" + b"".join(map(framed, packets)) + last)
            line.shutdown(socket.SHUT_WR)
            begun = False
            while not begun or server.is_connected:
                try:
                    log.note(
                        "ran", chip.run(end_us * CYCLES_PER_US), firmware.chip.now_us, server.is_connected
                    )
                except KeyboardInterrupt:
                    log.note("killed", number, firmware.chip.now_us)
                begun, end_us = True, max(end_us, firmware.chip.now_us) + 100
            log.note("answers", b"".join(iter(lambda: line.recv(1 << 16), b"")))
    server.close()
    return log.told()


def backwards(seed: int) -> dict[str, str]:
    """Return where a flight stops that a debugger lets run and step, forward and back, in its first 100 ms."""
    (_, pick), log = picking(seed), Log()
    with TemporaryDirectory() as folder:
        flight = Flight(Path(folder) / "log")
        line, ticks = (flight.place(name) for name in ("send_line", "xTickCount"))
        flight.ask(b"Z0,%x,2" % line)
        for number in range(16):
            if number % 4 == 0:
                packet = b"%s2,%x,4" % (pick(b"Z", b"z"), ticks)
                log.note("set", packet, flight.ask(packet))
            late = int.from_bytes(bytes.fromhex(flight.ask(b"m%x,4" % ticks).decode()), "little") > 100
            back = pick(b"bc", b"bs", b"bs")
            packet = back if late else pick(b"c", b"c", b"c", b"s", back) if number else b"c"
            log.note("stopped", packet, *flight.stop(packet))
        log.note("ended", flight.end(), flight.path.read_text().split())
    return log.told()


def known(flags: tuple[str, ...]) -> dict[str, str]:
    """Return what an image's names and debugging information say of every address, name and line."""
    image, log = Image(build(flags=flags)), Log()
    for address in range(image.base, image.base + len(image.code), 2):
        log.note("lines", image.place(address), image.variable_at(address))
        log.note("frames", image.debug.frames._rules_at(address))
    for line, name in product(range(1, 700, 3), ("firmware.c", "exceptions.c", "measured.c", "other.c")):
        log.note("addresses", image.debug.address_of(f"{name}:{line}"))
    for row in image.debug.rows:
        log.note("rows", Path(row.path).name, row.begin, row.end, row.line, row.is_statement)
    functions = [one.address for one in image.functions]
    for at, name in product(
        functions[::9], ("tskTaskControlBlock", "xLIST", "QueueDefinition", "SNAPSHOT_DATA", "none")
    ):
        try:
            log.note("structures", image.debug.structure(name, at))
        except LabError as error:
            log.note("structures", str(error).partition(": ")[2])
    for name in ("tasks", "bus_guard", "box", "stacks", "queue", "line"):
        try:
            log.note("variables", image.debug.variable(name, functions[0]))
        except LabError as error:
            log.note("variables", str(error).partition(": ")[2])
    log.note(
        "image", image.base, image.memory, sorted(image.constants), image.initial_stack_pointer, image.reset
    )
    log.note("literals", sorted(literals(image.code)))
    return log.told()


def covered() -> dict[str, str]:
    """Return which lines, functions and branches ran, across resets and asleep, and counted on after another request."""
    log = Log()
    for planted, flags in ((3, ("-g",)), (0, ("-g", "-DCALM"))):
        firmware = FirmwareOnChip(flags=flags, planted=planted)
        lines = ImageLines(firmware.image)
        for end_us in (20_000, 30_300, 40_700):
            firmware.chip.record()
            while firmware.chip.now_us < end_us:
                if firmware.run(end_us) & StopReason.RESET:
                    firmware.chip.reset(SOFTWARE)
            for file in lines.coverage(firmware.chip.passages):
                name, counts = Path(file.path).name, sorted(file.lines.items())
                log.note(name, planted, end_us, file.lines_run, counts, file.functions, file.branches)
            log.note("passages", end_us, *firmware.chip.passages.sum(axis=0))
    return log.told()


def kernel(seed: int) -> dict[str, str]:
    """Return what the kernel's structures say while they are moved at random, with names and without."""
    (rng, pick), log = picking(seed), Log()
    firmware = FirmwareOnChip(flags=USUAL)
    image, chip = firmware.image, firmware.chip
    named, unnamed = FreeRtos(image, chip.read), UnnamedFreeRtos.of(image, chip.read)
    assert unnamed is not None
    log.note("before", named.running, named.current_block, unnamed.running, unnamed.places, unnamed.tasks())
    place = {name: image.symbol(name).address for name in ("tasks", "bus_guard", "xSuspendedTaskList")}
    while chip.now_us < 30_000 + 500 * seed:
        firmware.run(30_000 + 500 * seed)
    queue, task = named._queue, named._task
    assert queue is not None
    lists = [place["bus_guard"] + queue[f"xTasksWaitingTo{what}"].offset for what in ("Receive", "Send")]
    for _ in range(60):
        for kernel in (named, unnamed):
            try:
                views = kernel.tasks()
            except LabError as error:
                views = [str(error)]
            log.note(type(kernel).__name__, kernel.running, kernel.places, kernel.heap_bytes, *views)
        for number in range(6):
            block = place["tasks"] + task.size * number
            log.note("waits", number, waits(named, block))
            if block != named.current_block:
                log.note("registers", number, saved(named, block))
        block = place["tasks"] + task.size * int(rng.integers(6))
        lie = image.symbol(pick("xSuspendedTaskList", "xSuspendedTaskList", "pxReadyTasksLists", "xDelayedTaskList1",
                                "xTasksWaitingTermination")).address  # fmt: skip
        words = pick(
            [(block + task["xStateListItem.pxContainer"].offset, pick(lie, lie, lie, 0))],
            [(block + task["xEventListItem.pxContainer"].offset, pick(0, *lists, *lists, lie))],
            [(block + task["uxBasePriority"].offset, pick(0, 1, 3))],
            [(place["bus_guard"] + queue[name].offset, pick(0, 0, 1, 1, 1, block, 70_000)) for name in (
                "uxItemSize", "uxLength", "uxMessagesWaiting", "pcHead", "u.xSemaphore.xMutexHolder")],
            [(block + task["xStateListItem.xItemValue"].offset, pick(0, 7, 3_600_000, 0x7FFF_FFFF))],
            [(block + task["ucNotifyState"].offset, pick(0, 1, 2))],
            [(lie + named._list["uxNumberOfItems"].offset, pick(0, 1, 2, 0xFFFF_FFFF))],
        )  # fmt: skip
        for at, word in words:
            chip.write(at, struct.pack("<I", word))
    return log.told()


def waits(kernel: FreeRtos, block: int) -> Wait | str | None:
    try:
        return kernel.endless_wait(block)
    except LabError as error:
        return str(error)


def saved(kernel: FreeRtos, block: int) -> object:
    """Return the registers of a task: as they are, and as if its frame had a padding or floats."""
    found = []
    try:
        place = kernel._word(block + kernel._task["pxTopOfStack"].offset)
        found.append(sorted(kernel.saved_registers(block).items()))
    except LabError as error:
        return str(error)
    for exc_return, status in product((0xFFFF_FFED, 0xFFFF_FFFD), (0, 1 << 9)):
        frame = struct.pack("<9I", *range(8), exc_return).ljust(
            36 + (0 if exc_return & 16 else 64) + 28, b"\7"
        )
        memory = frame + struct.pack("<I", status)
        own = Made(_word=lambda at: place, _task=kernel._task)
        own._read = lambda at, size, memory=memory: memory[at - place :][:size]
        found.append(sorted(FreeRtos.saved_registers(own, block).items()))  # type: ignore[arg-type]
    return found


def time_line(seed: int) -> dict[str, str]:
    """Return where a chip's time went that runs in random portions, with resets, an outside load and a trace."""
    (_, pick), log = picking(seed), Log()
    firmware = FirmwareOnChip(flags=(*USUAL, "-DCALM") if seed == 2 else USUAL)
    chip, read = firmware.chip, firmware.chip.read
    own = (FreeRtos if seed % 2 else UnnamedFreeRtos).of(firmware.image, read)

    def act(why: int) -> None:
        log.note("acts", StopReason(why) if why in list(StopReason) else why, chip.now_us, processor.now_us)
        if pick(True, False, False):
            processor.stop_before(processor.now_us + pick(0, 1, 100))

    processor = ChipProcessor(chip, own, act, chip.run)
    processor.every(pick(700, 1_300), lambda now_us: log.note("every", now_us, processor.now_us))
    now_us = 0
    for number in range(80):
        what = pick(
            "run", "run", "run", "run", "until", "later", "stop", "trace", "reset", "sample", "sample"
        )
        now_us += pick(0, 1, 333, 1_000, 2_500)
        if what == "until":
            processor.run(now_us - 100, now_us)
        elif what == "later":
            processor.later(pick(0, 10, 3_000), lambda us: log.note("later", us, processor.now_us))
        elif what == "stop":
            processor.later(pick(1, 50), lambda us: processor.stop_before(us - processor.ahead_us + 30))
        elif what == "trace":
            processor.set_trace(pick(None, lambda *of: log.note("trace", *of)))
        elif what == "reset":
            chip.reset(pick(SOFTWARE, WATCHDOG))
        elif what == "sample":
            chip.pin("C", 14, True)
            chip.pin("C", 14, False)
        if number == 20:
            processor.begin(now_us)
            now_us = 0
        if number == 40:
            processor.occupy("load", lambda: pick(0, 100, 400))
        processor.run(now_us)
        processor.find_kernel()
        busy = processor.longest_busy(pick(0, 100, 500, 5_000))
        log.note("times", processor.now_us, processor.run_times_us(), processor.activations(), busy)
        log.note("tasks", processor.current, processor.task_names, processor.tasks)
    return log.told()


def watch(seed: int) -> dict[str, str]:
    """Return which of some tasks are reported as stopped, that run regularly, rarely, or no longer."""
    (_, pick), log = picking(seed), Log()
    tasks = [Made(block=0x100 * number, times=0, ran=0) for number in range(1, 5)]
    chip = Made(now_us=0, state=Made(task=tasks, task_count=3, running=0))
    reasons: dict[int, Wait | None] = {}
    stopped = TaskWatch(chip, Made(endless_wait=reasons.get))  # type: ignore[arg-type]
    chip.now_us, period_us, alive = SETTLED_US - 500_000, 100_000, {1, 2, 3, 4}
    for _ in range(600):
        chip.now_us += period_us
        for number, task in enumerate(tasks, 1):
            if number in alive and pick(True, number < 4):
                task.times += pick(1, 1, number)
                task.ran = (chip.now_us - pick(0, 0, 50_000)) * CYCLES_PER_US
        if pick(*(8 * [False]), True):
            alive ^= {pick(1, 2, 3, 4)}
        if pick(*(20 * [False]), True):
            reasons[0x100 * pick(1, 2, 3, 4)] = pick(None, Wait("a"), Wait("b"), Wait("c", for_messages=True))
        chip.state.task_count, chip.state.running = pick(3, 4, 4, 4), pick(0, 0, 1)
        log.note("stopped", chip.now_us, *stopped.newly_stopped())
        if pick(*(150 * [False]), True):
            stopped.restart()
    assert LOOKS == PERIODS == 10
    return log.told()


def reasons() -> dict[str, str]:
    """Return the words for each bit of the fault status registers, alone and with the next."""
    log = Log()
    for status, hard in product(
        [0, *(1 << n | 1 << m for n in range(26) for m in (n, n + 1))], (0, 2, 1 << 30, 3 << 30)
    ):
        words = {crashes.CFSR: status, crashes.HFSR: hard, crashes.MMFAR: 0x1234, crashes.BFAR: 0x5678}
        chip: Any = Made(read=lambda at, size, words=words: struct.pack("<I", words[at]))
        log.note("reasons", crashes.fault_reasons(chip))
    firmware = FirmwareOnChip()
    for kernel in (None, FreeRtos(firmware.image, firmware.chip.read)):
        reports = crashes.CrashReports(firmware.image, firmware.chip, kernel, "assertFail")
        log.note("who", *(reports._who(number) for number in range(100)))
    for trace in ((), ("a",), ("a", "a", "b"), ("a", "b", "b", "b", "a")):
        log.note("crash", crashes.Crash("what", "who", trace))
    return log.told()


class Stopped:
    """A chip that has stopped anywhere: with any registers, status and frame."""

    def __init__(self, chip: Chip, at: int, codes: list[int], calls: list[int], seed: int) -> None:
        (self.rng, pick), self._chip, task = picking(seed), chip, RAM + 0x1_F800
        self.state = Made(task_return=pick(0xFFFF_FFFD, 0xFFFF_FFED))
        bits = 1 << int(self.rng.integers(26))
        self.words = {
            crashes.CFSR: pick(0, bits, bits, 1 << 12, 1 << 15 | bits, 1 << 7 | bits, 0x8080),
            crashes.HFSR: pick(0, 2, 1 << 30, 1 << 31), crashes.MMFAR: 0x1234, crashes.BFAR: 0x5678,
        }  # fmt: skip
        frame = [*self.rng.integers(1 << 32, size=5).tolist(), pick(*calls) | 1, pick(*codes)]
        status = pick(0, 0, 15, 56, 0x200, 0x20F) | 1 << 24
        above = [pick(*calls) | 1 if pick(True, False) else task for _ in range(64)]
        chip.write(task, struct.pack("<72I", *frame, status, *above))
        ends = (task, task, task, task + 4, 0x3000_0000, RAM + 0x2_0000 - 32, RAM + 0x2_0000 - 28)
        self._registers = {f"r{n}": pick(task, at, 0x2000_0000, n) for n in range(13)} | {
            "sp": pick(task, task + 32, *ends), "msp": pick(*ends), "psp": pick(*ends),
            "lr": pick(0xFFFF_FFFD, 0xFFFF_FFED, 0xFFFF_FFF9, 0xFFFF_FFF1, pick(*calls) | 1),
            "xpsr": pick(0, 0, 3, 4, 5, 6, 7, 15, 56) | 1 << 24, "pc": pick(at, *codes[:4]),
        }  # fmt: skip

    def register(self, name: str) -> int:
        return int(self._registers[name])

    def read(self, address: int, size: int) -> bytes:
        word = self.words.get(address)
        return self._chip.read(address, size) if word is None else struct.pack("<I", word)


def reported(seed: int) -> dict[str, str]:
    """Return what is reported of a chip that has stopped anywhere, before its scheduler runs and after it."""
    (_, pick), firmware, log = picking(seed), FirmwareOnChip(), Log()
    while firmware.chip.now_us < 30_000:
        firmware.run(30_000)
    elf, chip = firmware.image, firmware.chip
    own = elf if seed != SEEDS[-1] else Image(Path("cf2.bin"), None, elf.code)
    kernel = FreeRtos(elf, chip.read)
    blocks = [view.block for view in kernel.tasks()]
    whole = crashes.CrashReports(elf, chip, kernel, "assertFail")
    calls = [at for at in range(elf.base, elf.base + len(elf.code) + 3, 2) if whole._follows_call(at)]
    starts = [one.address for one in elf.functions]
    log.note("calls", len(calls), calls[:3], calls[-3:])
    for number in range(120):
        codes = [pick(*starts), pick(*calls), pick(*starts) + pick(0, 2, 4, 10), pick(0, 0x3000_0000)]
        text = elf.base + elf.code.find(pick(b"how != ASSERTION", b"firmware.c", b"\0\0"))
        stopped: Any = Stopped(chip, elf.symbol("assertFail").address, codes, calls, 1_000 * seed + number)
        stopped._registers |= {"r0": pick(text, 0x3000_0000), "r1": pick(text, elf.base), "r2": number}
        firmware.poke("xSchedulerRunning", pick(0, 1, 1))
        running = kernel.current_block
        reports = crashes.CrashReports(own, stopped, pick(kernel, kernel, kernel, None), "assertFail")
        for name in ("here", "watchdog", "lockup", "software_reset", "division"):
            log.note(name, getattr(reports, name)())
        log.note("low", reports.low_access(pick(0, 0x3FF, 0x400, 0x8000), pick(True, False)))
        if reports._kernel is None:
            continue
        begin, block = kernel.stack_begin(running), pick(running, running, *blocks)
        stopped._registers["sp"] = pick(begin - 4, begin, begin + 4, stopped.register("sp"))
        log.note("overflow", reports.overflow(block))
        log.note("hang", reports.hang(block, pick(999, 1_000, 211_999)))
        silent_us, period_us = pick((70_000, 1_000), (999_999, 12_345), (1_500, 1))
        log.note("stopped", reports.stopped(block, silent_us, period_us, "it waits"))
    return log.told()


def memory(seed: int) -> dict[str, str]:
    """Return what a chip holds after random writes, runs and returns to what was saved."""
    (rng, pick), firmware, log = picking(seed), FirmwareOnChip(), Log()
    chip: Chip = firmware.chip
    chip.add_device(2, 0x51, np.zeros(16, np.uint8))
    chip.record()
    if seed == 2:
        chip.empty_flash_cache()
    chip.profile([(one.address, one.address + one.size) for one in functions_of(firmware.image)])
    kept = [chip.save()]
    places = (0, 0x0800_4000, 0x0810_0000 - 8, 0x1000_0000, 0x1001_0000 - 4, RAM + 0x1F000, RAM + 0x2_0000 - 8,
              0x1FFF_7800, 0x1FFF_7A10, 0x4000_0000, 0x4002_3800, 0x4007_FFFC, 0xE000_ED00, 0x3000_0000)  # fmt: skip
    for _ in range(120):
        at, size = pick(*places) + pick(0, 0, 1, 2, 4), pick(1, 2, 4, 4, 7, 16)
        what = pick("read", "read", "write", "run", "step", "save", "restore", "register", "pin", "reset")
        try:
            if what == "read":
                log.note(what, hex(at), chip.read(at, size).hex())
            elif what == "write" and at >= 0x1000_0000:
                chip.write(at & ~3, rng.bytes(4 * (size + 3 >> 2)))
            elif what == "run":
                log.note(what, int(firmware.run(int(chip.now_us) + pick(1, 300, 2_000))), chip.now_us)
            elif what == "step":
                log.note(what, chip.step(), chip.step(int(chip.state.now) + pick(0, 100)), chip.state.now)
            elif what == "save":
                kept = [*kept[-3:], chip.save()]
            elif what == "restore":
                chip.restore(pick(*kept))
            elif what == "register":
                name = pick(
                    "r0", "sp", "lr", "pc", "xpsr", "msp", "psp", "s3", "d4", "basepri", "control", "fpscr"
                )
                log.note(what, name, chip.register(name))
            elif what == "pin":
                chip.pin("C", 14, pick(True, False))
                log.note(what, chip.feed(6, rng.bytes(size)), chip.sent(6).hex(), chip.sent(1).hex())
            elif what == "reset":
                chip.reset(pick(SOFTWARE, WATCHDOG))
        except LabError as error:
            log.note("refused", what, error)
        log.note(
            "state",
            chip.resets,
            chip.state.now,
            chip.register("pc"),
            int(chip.passages.sum()),
            chip.ram[::97].sum(),
        )
    profile = chip.profiled()
    nodes = profile.node[0 : profile.nodes]
    log.note("profile", *((one.function, one.cycles, one.asleep, one.calls) for one in nodes))
    log.note("cycles", chip.cycles_of_code().sum(), np.flatnonzero(chip.cycles_of_code())[:40])
    return log.told()


FOUND: dict[str, Callable[[], list[str] | dict[str, str]]] = {
    **{f"mistake {planted}": lambda planted=planted: crash(planted) for planted in MISTAKES},  # type: ignore[misc]
    **{f"debugger {seed}": lambda seed=seed: debugger(seed) for seed in SEEDS},  # type: ignore[misc]
    **{f"nameless {planted}": lambda planted=planted: nameless(planted) for planted in NAMELESS},  # type: ignore[misc]
    "profile": profile,
    "known DWARF 5": lambda: known(("-g",)),
    "known DWARF 4": lambda: known(("-gdwarf-4", "-fno-inline", "-ffunction-sections")),
    "covered": covered,
    "carried": carried,
    **{f"session {seed}": lambda seed=seed: Session(seed).told() for seed in SEEDS},  # type: ignore[misc]
    "profiles": profiles,
    "reasons": reasons,
    **by_seed(
        (kernel, time_line, watch, memory, remote, backwards, reported), SEEDS, lambda use, seed: use(seed)
    ),
}


# They reach no line that the others do not.
LONG = [
    *(f"{use} 2" for use in ("backwards", "kernel", "reported")), "backwards 3", "known DWARF 4", "memory 3", "profiles",
    "reported 1", "session 3", *(f"mistake {planted}" for planted in MISTAKES[::2]),
]  # fmt: skip


@pytest.mark.parametrize("name", tiers(FOUND, LONG))
def test_the_emulator_tells_what_it_told(name: str) -> None:
    judge(REPORTS, name, FOUND[name](), *MADE_WITH)


if __name__ == "__main__":
    approve(REPORTS, FOUND, *MADE_WITH)
