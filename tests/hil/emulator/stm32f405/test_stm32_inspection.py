"""What is read of a running firmware: its kernel's tasks, and what it died of, with task, function, line and callers."""

import os
import re
from dataclasses import astuple, replace
from pathlib import Path
from struct import pack
from types import SimpleNamespace as Made

import numpy as np
import pytest

from hil.emulator.crazyflie.log_table import log_table, parameter_table
from hil.emulator.stm32f405 import stopped_tasks
from hil.emulator.stm32f405.chip import Chip, StopReason, build_machine
from hil.emulator.stm32f405.crash import CrashReports
from hil.emulator.stm32f405.freertos import QUEUE_CODE, FreeRtos, Wait
from hil.emulator.stm32f405.image import Image
from hil.emulator.stm32f405.processor import ChipProcessor
from hil.emulator.stm32f405.stopped_tasks import StoppedTask, TaskWatch
from hil.emulator.stm32f405.unnamed_freertos import UnnamedFreeRtos
from support.stm32_firmware import SOURCES, build, image_with
from support.stm32_machine import FirmwareOnChip

MS = 1000
(
    BUS_FAULT, UNDEFINED, ASSERTION, HUNGRY_WATCHDOG, NULL_CALL, NULL_READ, NULL_WRITE, DIVISION, HANG, OVERFLOW,
    BRIEF_OVERFLOW, LAST_CALL, MUTEX, SUSPENDED, DELAYED, DELETED, UNALIGNED, BREAKPOINT, MASKED_CALL,
) = range(1, 20)  # fmt: skip
FIRMWARE = (SOURCES / "firmware.c").read_text(encoding="utf-8").splitlines()
COMPILERS = pytest.mark.parametrize("compiler", ["clang", pytest.param("gcc", marks=pytest.mark.long)])


def line_of(text: str) -> int:
    """The only line of the firmware with that text."""
    (found,) = (number for number, line in enumerate(FIRMWARE, 1) if text in line)
    return found


def reports_of(machine: FirmwareOnChip) -> CrashReports:
    return CrashReports(machine.image, machine.chip, FreeRtos(machine.image, machine.chip.read), "assertFail")


def run_to_end(machine: FirmwareOnChip, end_ms: int) -> StopReason:
    """Run until something else than outputs stops the chip, or for so long."""
    why = StopReason.SERIAL
    while why and not why & ~(StopReason.SERIAL | StopReason.COMPARE):
        why = machine.run(end_ms * MS)
    return why


@COMPILERS
def test_the_tasks_are_those_that_were_created(compiler: str) -> None:
    machine = FirmwareOnChip(compiler)
    kernel = FreeRtos(machine.image, machine.chip.read)
    assert not kernel.running
    assert kernel.current_block == 0
    run_to_end(machine, 30)
    tasks = {task.name: task for task in kernel.tasks()}
    assert kernel.running
    assert {name: task.priority for name, task in tasks.items()} == {
        "FILTER": 3, "FROZEN": 3, "REPORT": 2, "SPIN-0": 1, "SPIN-1": 1, "IDLE": 0,
    }  # fmt: skip
    # FILTER waits for a sample without a time-out, which FreeRTOS keeps with the suspended; REPORT waits for its time.
    assert [tasks[name].state for name in ("FILTER", "FROZEN", "REPORT", "IDLE")] == [
        "blocked", "suspended", "blocked", "ready",
    ]  # fmt: skip
    assert {tasks["SPIN-0"].state, tasks["SPIN-1"].state} == {"ready", "running"}
    assert tasks[kernel.name(kernel.current_block)].state == "running"


@pytest.mark.long
def test_a_task_has_the_state_of_the_list_that_it_is_in(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = FirmwareOnChip()
    kernel, variables = FreeRtos(machine.image, machine.chip.read), machine.image._variables
    run_to_end(machine, 30)
    delayed = variables.pop("xDelayedTaskList1")
    lists = {
        "xDelayedTaskList1": "blocked", "xDelayedTaskList2": "blocked", "xSuspendedTaskList": "suspended",
        "xTasksWaitingTermination": "deleted", "pxReadyTasksLists": "ready", "xPendingReadyList": "ready",
    }  # fmt: skip
    for name, state in lists.items():
        with monkeypatch.context() as patch:
            patch.setitem(variables, name, delayed)
            states = {task.name: task.state for task in kernel.tasks()}
        assert states.get("REPORT") == state, name


@pytest.mark.long
def test_without_the_code_of_queues_tasks_are_known_and_waits_have_an_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine = FirmwareOnChip()
    image, whole = machine.image, FreeRtos(machine.image, machine.chip.read)
    run_to_end(machine, 30)
    has = image.has
    monkeypatch.setattr(image, "has", lambda name: name != QUEUE_CODE and has(name))
    without = FreeRtos(image, machine.chip.read)
    assert without._queue is None
    assert without.tasks() == whole.tasks()
    event = image.symbol("bus_guard").address + whole._queue["xTasksWaitingToReceive"].offset  # type: ignore[index]
    assert without._wait_in(event) == Wait(f"it waits at {image.name_of(event, without._word)}")


@pytest.mark.long
@COMPILERS
def test_the_high_water_mark_is_what_was_never_written(compiler: str) -> None:
    machine = FirmwareOnChip(compiler)
    kernel = FreeRtos(machine.image, machine.chip.read)
    run_to_end(machine, 30)
    free = {task.name: task.stack_free_bytes for task in kernel.tasks()}
    stacks = machine.image.symbol("stacks")
    for number, name in enumerate(("REPORT", "SPIN-0", "SPIN-1", "FILTER", "FROZEN", "IDLE")):
        stack = machine.chip.read(stacks.address + 1024 * number, 1024)
        assert free[name] == re.match(b"\xa5*", stack).end()  # type: ignore[union-attr]
        assert 600 < free[name] < 1000
    machine.chip.write(stacks.address + 64, b"\x00")
    assert {task.name: task.stack_free_bytes for task in kernel.tasks()}["REPORT"] == 64


def test_an_image_without_heap_4_has_no_free_bytes_of_it() -> None:
    machine = FirmwareOnChip()
    assert FreeRtos(machine.image, machine.chip.read).heap_bytes == (None, None)
    names = "xFreeBytesRemaining", "xMinimumEverFreeBytesRemaining"
    image = image_with(**dict.fromkeys(names, 4))
    for number, name in enumerate(names, 7):
        machine.chip.write(image.symbol(name).address, pack("<I", number))
    assert FreeRtos(image, machine.chip.read).heap_bytes == (7, 8)
    del image._variables[names[1]]
    assert FreeRtos(image, machine.chip.read).heap_bytes == (None, None)


def crashed(machine: FirmwareOnChip) -> str:
    """Run into the first crash and return it in words."""
    reports = reports_of(machine)
    machine.chip.crash_points |= reports.addresses
    assert run_to_end(machine, 100) == StopReason.BREAK
    return str(reports.here())


@COMPILERS
def test_a_bus_fault_is_reported_with_address_task_function_line_and_callers(compiler: str) -> None:
    text = crashed(FirmwareOnChip(compiler, planted=BUS_FAULT))
    place = f"go_wrong (firmware.c:{line_of('return REGISTER(0x30000000)')})"
    caller = f"report (firmware.c:{line_of('go_wrong(planted)')})"
    reason = "access to where there is no memory at 0x30000000"
    assert text == f"HardFault: {reason}, in task REPORT: {place} < {caller}"


@COMPILERS
@pytest.mark.parametrize(
    ("planted", "reason", "text"),
    [
        (UNDEFINED, "undefined instruction", "udf #7"),
        (UNALIGNED, "unaligned access", "vldr s0, [%0]"),
        (BREAKPOINT, "a breakpoint instruction without a debugger", "bkpt #0"),
        (MASKED_CALL, "a supervisor call where its priority does not allow it", "svc #0"),
    ],
)
def test_a_fault_is_reported_with_its_place(compiler: str, planted: int, reason: str, text: str) -> None:
    crash = crashed(FirmwareOnChip(compiler, planted=planted))
    place = f"go_wrong (firmware.c:{line_of(text)})"
    assert crash.startswith(f"HardFault: {reason}, in task REPORT: {place} < report (firmware.c:")


@pytest.mark.long
@COMPILERS
def test_an_assertion_is_reported_with_text_and_caller(compiler: str) -> None:
    machine = FirmwareOnChip(compiler, planted=ASSERTION)
    text = crashed(machine)
    line = line_of("assert_that(how != ASSERTION)")
    caller = f"report (firmware.c:{line_of('go_wrong(planted)')})"
    assert text == (
        f"assertion how != ASSERTION failed at firmware.c:{line}, in task REPORT: go_wrong (firmware.c:{line}) < {caller}"
    )
    # What the firmware itself keeps for after the reset says the same.
    machine.chip.crash_points.clear()
    assert run_to_end(machine, 100) & StopReason.RESET
    magic, _, file, kept = machine.peek_all("snapshot", 4)
    assert (magic, kept) == (0x2F8A_001F, line)
    assert machine.chip.read(file, 11) == b"firmware.c\0"


@COMPILERS
def test_an_assertion_that_is_a_functions_last_call_names_the_function(compiler: str) -> None:
    line = line_of("assert_that(how != LAST_CALL)")
    text = crashed(FirmwareOnChip(compiler, planted=LAST_CALL))
    assert re.search(rf"in task REPORT: check_last[\w.]* \(firmware.c:({line - 1}|{line})\) < ", text)


def test_the_place_of_an_assertion_begins_its_trace_once() -> None:
    line, reports = line_of("assert_that(how != ASSERTION)"), reports_of(FirmwareOnChip())
    place, caller = f"go_wrong (firmware.c:{line})", "report (firmware.c:1)"
    for trace in ((), (caller,), (place, caller), ("go_wrong (firmware.c:1)", caller)):
        expected = (place, *trace[-1:])
        assert reports._with_place(f"firmware.c:{line}", trace) == expected
        assert reports._with_place("other.c:1", trace) == trace


@COMPILERS
def test_a_call_through_a_null_pointer_is_a_change_to_arm_code(compiler: str) -> None:
    text = crashed(FirmwareOnChip(compiler, planted=NULL_CALL))
    place = f"go_wrong (firmware.c:{line_of('nobody();')})"
    reason = "jump to an even address: not Thumb code"
    assert text.startswith(
        f"HardFault: {reason}, in task REPORT: 0x00000000, outside every function < {place} < report ("
    )


def stopped(machine: FirmwareOnChip, why: StopReason) -> tuple[ChipProcessor, CrashReports]:
    processor = machine.processor()
    assert run_to_end(machine, 100) == why
    return processor, reports_of(machine)


@pytest.mark.long
@COMPILERS
@pytest.mark.parametrize(
    ("planted", "why", "expected", "text"),
    [
        (NULL_READ, StopReason.LOW_READ, "null pointer: read at 0x00000008, ", "return nowhere[2]"),
        (NULL_WRITE, StopReason.LOW_WRITE, "null pointer: write to 0x0000000c, ", "nowhere[3] = 1"),
    ],
)
def test_a_null_access_reports_once(
    compiler: str, planted: int, why: StopReason, expected: str, text: str
) -> None:
    machine = FirmwareOnChip(compiler, planted=planted)
    _, reports = stopped(machine, why)
    crash = str(reports.low_access(machine.chip.state.fault_address, why is StopReason.LOW_WRITE))
    assert crash.startswith(expected)
    assert f"in task REPORT: go_wrong (firmware.c:{line_of(text)}) < report (" in crash
    lines = machine.peek("lines_sent")
    assert run_to_end(machine, 100) == StopReason.TIME
    assert machine.peek("lines_sent") > lines + 3


@pytest.mark.long
def test_flash_is_read_at_address_0() -> None:
    machine = FirmwareOnChip(planted=NULL_READ)
    stopped(machine, StopReason.LOW_READ)
    machine.chip.step()
    words = [machine.chip.register(name) for name in ("r0", "r1", "r2", "r3")]
    assert 0xFFFF_FFFF in words  # erased: the image begins at 16 kB


@pytest.mark.long
@COMPILERS
def test_the_first_division_by_zero_is_reported_where_it_is(compiler: str) -> None:
    machine = FirmwareOnChip(compiler, planted=DIVISION)
    _, reports = stopped(machine, StopReason.DIVISION)
    text = str(reports.division())
    assert text.startswith("division by zero: its result is 0; no fault follows")
    assert f"in task REPORT: go_wrong (firmware.c:{line_of('return 7 / zero')}) < report (" in text
    assert run_to_end(machine, 100) == StopReason.TIME


@pytest.mark.long
@COMPILERS
def test_the_task_that_hangs_is_named_while_others_run(compiler: str) -> None:
    machine = FirmwareOnChip(compiler, planted=HANG)
    processor = machine.processor()
    for us in range(10_000, 80_000, 1000):  # FILTER, above it, waits for samples
        machine.chip.pin("C", 14, True)
        machine.chip.pin("C", 14, False)
        machine.run(us)
    assert run_to_end(machine, 85) == StopReason.TIME
    assert machine.peek("samples_taken") > 50
    found = processor.longest_busy(5_000)
    assert found is not None
    block, us = found
    assert 40_000 < us < 75_000
    text = str(reports_of(machine).hang(block, us))
    begin = line_of("static void hang(void)")
    assert re.match(
        r"hang: busy for \d+ ms without waiting for anything, in task REPORT: hang \(firmware.c:(\d+)\) < ",
        text,
    )
    assert begin < int(re.findall(r"hang \(firmware.c:(\d+)", text)[0]) < begin + 4
    assert "< report (firmware.c:" in text


def test_a_task_that_hangs_is_named_from_within_an_interrupt() -> None:
    machine = FirmwareOnChip(planted=HANG)
    processor = machine.processor()
    run_to_end(machine, 60)
    machine.chip.breakpoints |= {machine.image.symbol("tick").address}
    assert run_to_end(machine, 100) == StopReason.BREAK
    found = processor.longest_busy(5_000)
    assert found is not None
    assert ", in task REPORT: hang (firmware.c:" in str(reports_of(machine).hang(*found))


def test_a_task_that_waits_is_not_busy() -> None:
    machine = FirmwareOnChip()
    processor = machine.processor()
    run_to_end(machine, 50)
    found = processor.longest_busy(20_000)
    assert found is not None
    kernel = FreeRtos(machine.image, machine.chip.read)
    assert kernel.name(found[0]) in ("SPIN-0", "SPIN-1")  # REPORT, FILTER and FROZEN are above them


A, B, C, IDLE = range(1, 5)


@pytest.mark.parametrize(("since_us", "found"), [
    ({}, None), ({A: 9_001}, None), ({A: 9_000}, (A, 1_000)), ({IDLE: 1}, None), ({IDLE: 1, A: 8_000}, (A, 2_000)),
    ({A: 1, C: 8_000}, (C, 2_000)), ({C: 9_500, A: 1}, (A, 9_999)), ({A: 7_000, B: 5_000}, (B, 5_000)),
    ({A: 5_000, B: 7_000}, (A, 5_000)),
])  # fmt: skip
def test_the_task_that_blocks_others_is_busy_long_enough_not_idle_and_first_by_priority(
    since_us: dict[int, int], found: tuple[int, int] | None
) -> None:
    names = {A: ("a", 1), B: ("b", 1), C: ("c", 2), IDLE: ("IDLE", 9)}
    views = {block: Made(name=name, priority=priority) for block, (name, priority) in names.items()}
    tasks = [Made(block=block, busy_since=168 * since_us.get(block, 0)) for block in views]
    chip = Made(state=Made(task=tasks, task_count=4, now=168 * 10_000))
    kernel = Made(places=(0,) * 5, task=lambda block, state: views[block])
    processor = ChipProcessor(chip, kernel, lambda why: None, lambda until: 0)  # type: ignore[arg-type]
    assert processor.longest_busy(1_000) == found


def test_tasks_of_one_name_are_numbered_and_their_names_have_no_spaces() -> None:
    names = {1: "my task", 2: "other", 3: "my task", 4: "my task", 5: "other"}
    kernel = Made(places=(0,) * 5, task=lambda block, state: Made(name=names[block], priority=1))
    state = Made(task=[Made(block=block) for block in names], task_count=5)
    processor = ChipProcessor(Made(state=state), kernel, lambda why: None, lambda until: 0)  # type: ignore[arg-type]
    for _ in range(2):
        assert processor.task_names == ["my_task", "other", "my_task#2", "my_task#3", "other#2"]


@pytest.mark.long
@COMPILERS
def test_a_stack_that_overflows_names_its_task_at_once(compiler: str) -> None:
    machine = FirmwareOnChip(compiler, planted=OVERFLOW)
    _, reports = stopped(machine, StopReason.OVERFLOW)
    text = str(reports.overflow(machine.chip.state.overflow))
    assert text.startswith("stack overflow, in task REPORT: dig (firmware.c:")
    assert re.search(r"\), \d\d times < (go_wrong \(firmware.c:\d+\) < )?report ", text)


def test_a_stack_that_overflows_within_one_block_names_its_task_at_the_next_interrupt() -> None:
    machine = FirmwareOnChip(planted=BRIEF_OVERFLOW)
    _, reports = stopped(machine, StopReason.OVERFLOW)
    text = str(reports.overflow(machine.chip.state.overflow))
    assert text.startswith("stack overflow, some calls before this place, in task REPORT: ")


def test_an_assertion_without_text_is_reported_by_its_addresses() -> None:
    machine = FirmwareOnChip(planted=ASSERTION)
    crashed(machine)
    machine.chip.set_register("r0", 0x3000_0000)
    machine.chip.set_register("r1", 0x0808_0000)  # erased flash
    text = str(reports_of(machine).here())
    assert text.startswith("assertion 0x30000000 failed at 0x08080000:")


@pytest.mark.long
def test_a_watchdog_reset_names_the_running_task() -> None:
    machine = FirmwareOnChip(planted=HUNGRY_WATCHDOG)
    reports = reports_of(machine)
    assert run_to_end(machine, 400) & StopReason.WATCHDOG
    text = str(reports.watchdog())
    assert re.match(r"watchdog reset: nobody fed it in time; this ran then, in task SPIN-[01]: ", text)
    assert re.search(r"check_fp_registers \(firmware.c:\d+\) < spin_[01] \(firmware.c:\d+\)", text)


def test_a_fault_in_an_interrupt_names_its_handler() -> None:
    machine = FirmwareOnChip()
    reports = reports_of(machine)
    run_to_end(machine, 30)
    # The handler's first instruction becomes an undefined one; the code around it is not touched.
    handler = machine.image.symbol("EXTI15_10_Handler").address
    machine.chip.write(handler, bytes.fromhex("00de"))
    machine.chip.crash_points |= reports.addresses
    machine.chip.pin("C", 14, True)
    assert run_to_end(machine, 100) == StopReason.BREAK
    assert str(reports.here()).startswith(
        "HardFault: undefined instruction, in interrupt 40 (EXTI15_10_Handler): EXTI15_10_Handler (firmware.c:"
    )


def test_an_unreadable_frame_is_reported() -> None:
    machine = FirmwareOnChip(planted=BUS_FAULT)
    crashed(machine)
    machine.chip.set_register("psp", 0x3000_0000)
    text = str(reports_of(machine).here())
    assert text.endswith("0x30000000; there is no memory at its stack pointer, 0x30000000, in task REPORT")


@pytest.mark.long
def test_an_unhandled_fault_is_reported_as_lock_up() -> None:
    machine = FirmwareOnChip()
    run_to_end(machine, 30)
    while machine.chip.register("xpsr") & 0x1FF:
        machine.chip.step()
    machine.chip.set_register("sp", 0x3000_0000)
    assert run_to_end(machine, 100) == StopReason.LOCKUP
    text = str(reports_of(machine).lockup())
    assert text.startswith("lock-up, no fault handler could run: access to where there is no memory ")
    assert re.search(r", in task [\w-]+: \w+ \(firmware.c:\d+\)", text)


def test_before_the_scheduler_main_is_named() -> None:
    machine = FirmwareOnChip(planted=BUS_FAULT)
    reports = reports_of(machine)
    machine.chip.breakpoints |= {machine.image.symbol("assertFail").address}
    machine.chip.set_register("pc", machine.image.symbol("go_wrong").address)
    machine.chip.set_register("r0", ASSERTION)
    machine.chip.set_register("lr", machine.image.reset | 1)
    assert run_to_end(machine, 100) == StopReason.BREAK
    assert "in main, before the scheduler ran: go_wrong (" in str(reports.here())


ELF = os.environ.get("FLOATY_CF2_ELF", "")


@pytest.mark.skipif(
    not ELF, reason="FLOATY_CF2_ELF names no ELF of a Crazyflie: its kernel and lines are not read"
)
def test_a_real_crazyflie_image_is_read() -> None:
    image = Image(Path(ELF))
    memory = bytearray(0x2_0000)

    def read(address: int, size: int) -> bytes:
        return bytes(memory[address - 0x2000_0000 :][:size])

    kernel = FreeRtos(image, read)
    memory[image.symbol("xTickCount").address - 0x2000_0000 :][:4] = pack("<I", 0)
    assert image.place(image.symbol("assertFail").address).startswith("assertFail (cfassert.c:")
    assert kernel.heap_bytes[0] == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("planted", "reason"),
    [
        (MUTEX, "it waits for mutex bus_guard, which task SPIN-0 holds"),
        (SUSPENDED, "it is suspended"),
        (DELAYED, "it is delayed for ever"),
        (DELETED, "it was deleted"),
    ],
)
def test_a_regular_task_that_waits_for_ever_is_named_with_what_it_waits_for(
    monkeypatch: pytest.MonkeyPatch, planted: int, reason: str
) -> None:
    monkeypatch.setattr(stopped_tasks, "SETTLED_US", 0)
    machine = FirmwareOnChip()
    machine.processor()  # counts what tasks do
    kernel = FreeRtos(machine.image, machine.chip.read)
    watch = TaskWatch(machine.chip, kernel)

    def look_until(end_ms: int) -> list[StoppedTask]:
        found = []
        for ms in range(machine.chip.now_us // MS + 40, end_ms, 40):
            run_to_end(machine, ms)
            found += watch.newly_stopped()
        return found

    assert not look_until(600)  # FROZEN never ran regularly
    machine.poke("planted", planted)
    stopped = look_until(795)
    assert [kernel.name(task.block) for task in stopped] == ["REPORT"]
    assert stopped[0].reason == reason
    assert 3_000 < stopped[0].period_us < 20_000
    assert stopped[0].silent_us >= 10 * stopped[0].period_us
    crash = str(reports_of(machine).stopped(*astuple(stopped[0])))
    assert re.match(
        rf"stopped: silent for \d+ ms .*{reason}, in task REPORT: .* < report \(firmware.c:", crash
    ), crash


@pytest.mark.long
def test_a_task_without_samples_is_named_with_the_list_where_it_waits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine = FirmwareOnChip()
    kernel = FreeRtos(machine.image, machine.chip.read)
    run_to_end(machine, 30)
    (task,) = (one for one in kernel.tasks() if one.name == "FILTER")
    assert kernel.endless_wait(task.block) == Wait("it waits at waiting_for_samples")


@pytest.mark.long
@COMPILERS
def test_tasks_are_found_by_their_shape_without_symbols(compiler: str, tmp_path: Path) -> None:
    elf = Image(build(compiler, ("-g", "-DUSUAL_PLACES", "-fno-strict-aliasing")))
    (tmp_path / "cf2.bin").write_bytes(elf.code)
    image = Image(tmp_path / "cf2.bin")
    chip = Chip(image.code, image.base, build_machine())
    chip.add_device(1, 0x50, np.full(8192, 0xFF, np.uint8), 2)
    named, kernel = FreeRtos(elf, chip.read), UnnamedFreeRtos.of(image, chip.read)
    assert kernel is not None
    processor = ChipProcessor(chip, kernel, lambda why: None, chip.run)
    assert (kernel.places[0], kernel.running, kernel.tasks(), kernel.heap_bytes) == (
        0,
        False,
        [],
        (None, None),
    )
    processor.run(30_000)
    processor.find_kernel()
    processor.run(60_000)
    *places, end = named.places
    assert kernel.places == (*places, end)
    assert kernel.running
    assert {task.name for task in processor.tasks} == {"REPORT", "SPIN-0", "SPIN-1"}
    for ours, theirs in zip(kernel.tasks(), named.tasks(), strict=True):
        state = {"suspended": "blocked"}.get(theirs.state, theirs.state)  # the lists have no names
        assert ours == replace(theirs, state=state, base_priority=ours.priority)
        assert kernel.endless_wait(ours.block) is None
    assert UnnamedFreeRtos.of(Image(build(compiler)), chip.read).places[0] == 0  # type: ignore[union-attr]


@pytest.mark.parametrize("named", [True, False])
@COMPILERS
def test_log_variables_and_parameters_are_read_from_the_images_own_tables(
    compiler: str, named: bool, tmp_path: Path
) -> None:
    machine = FirmwareOnChip(compiler)
    run_to_end(machine, 5)
    image = machine.image
    if not named:
        (tmp_path / "cf2.bin").write_bytes(image.code)
        image = Image(tmp_path / "cf2.bin")
    log = {variable.name: variable for variable in log_table(image, machine.chip)}
    assert list(log) == ["queue.taken", "queue.lost"]  # not what a function would have to be called for
    machine.poke("samples_lost", 42)
    assert log["queue.lost"].read() == 42
    table = parameter_table(image, machine.chip)
    found = {name: (one.number, one.scalar.name, one.writable, one.read()) for name, one in table.items()}
    assert found == {
        "test.gain": (0, "F32", True, 1.5),
        "test.revision": (1, "U8", False, 7),
        "wait.timeout": (3, "U16", True, 500),
    }


# What the list of a queue's waiting tasks means, by the queue's members (queue.c of FreeRTOS): the item's size, its length,
# the items that wait, its first byte (0 in a mutex), and the mutex's holder.
RECEIVE, SEND = "xTasksWaitingToReceive", "xTasksWaitingToSend"
WAITS = [
    (RECEIVE, (4, 10, 0, 0x2000_0100, 0), Wait("it waits for an item of queue bus_guard", for_messages=True)),
    (RECEIVE, (4095, 65_535, 0, 0x2000_0100, 0), Wait("it waits for an item of queue bus_guard", for_messages=True)),
    (SEND, (4, 10, 10, 0x2000_0100, 0), Wait("it waits for room in queue bus_guard")),
    (RECEIVE, (0, 1, 0, 0x2000_0100, 0), Wait("it waits for semaphore bus_guard")),
    (RECEIVE, (0, 1, 0, 0, 0), Wait("it waits for mutex bus_guard")),
    (RECEIVE, (0, 1, 0, 0, 1), Wait("it waits for mutex bus_guard, which task SPIN-0 holds")),
    *((RECEIVE, (size, length, waiting, 0x2000_0100, 0), Wait("it waits at bus_guard"))  # no queue
      for size, length, waiting in ((4, 0, 0), (4, 65_536, 0), (4096, 10, 0), (4, 10, 1))),
    (SEND, (4, 10, 9, 0x2000_0100, 0), Wait("it waits at bus_guard")),
]  # fmt: skip


@pytest.mark.parametrize(("member", "values", "wait"), WAITS)
def test_a_wait_for_a_queue_is_told_by_its_members(member: str, values: tuple[int, ...], wait: Wait) -> None:
    machine = FirmwareOnChip()
    kernel = FreeRtos(machine.image, machine.chip.read)
    run_to_end(machine, 5)
    queue, layout = machine.image.symbol("bus_guard").address, kernel._queue
    assert layout is not None
    names = ("uxItemSize", "uxLength", "uxMessagesWaiting", "pcHead", "u.xSemaphore.xMutexHolder")
    holder = next(task.block for task in kernel.tasks() if task.name == "SPIN-0")
    for name, value in zip(names, (*values[:4], values[4] and holder), strict=True):
        machine.chip.write(queue + layout[name].offset, pack("<I", value))
    assert kernel._wait_in(queue + layout[member].offset) == wait


def test_a_task_is_delayed_for_ever_beyond_an_hour_also_where_the_ticks_wrap() -> None:
    machine = FirmwareOnChip()
    kernel = FreeRtos(machine.image, machine.chip.read)
    run_to_end(machine, 30)
    tasks = {task.name: task for task in kernel.tasks()}
    wakes = tasks["REPORT"].block + kernel._task["xStateListItem.xItemValue"].offset
    for now, ticks, ever in (
        (100, 3_600_000, False), (100, 3_600_001, True), (2**32 - 10, 3_600_000, False), (2**32 - 10, 3_600_001, True),
        (100, 2**32 - 1, True), (100, 0, False),
    ):  # fmt: skip
        machine.poke("xTickCount", now)
        machine.chip.write(wakes, pack("<I", (now + ticks) % 2**32))
        expected = Wait("it is delayed for ever") if ever else None
        assert kernel.endless_wait(tasks["REPORT"].block) == expected, (now, ticks)
    assert kernel.endless_wait(tasks["IDLE"].block) is None
    assert kernel.endless_wait(tasks["FROZEN"].block) == Wait("it is suspended")
    notify = tasks["FROZEN"].block + kernel._task["ucNotifyState"].offset
    for state, wait in ((1, "it waits for a notification"), (2, "it is suspended")):
        machine.chip.write(notify, bytes((state,)))
        assert kernel.endless_wait(tasks["FROZEN"].block) == Wait(wait)
