"""The machine code of the core on the emulated Cortex-M4: its bits, and what it takes.

Bits are compared with Python; instructions and cycles with capstone's reading of the image and a cache of another make.
"""

import re
from collections import Counter, OrderedDict
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from types import SimpleNamespace

import capstone
import numpy as np
import pytest
from unicorn import UC_HOOK_BLOCK, UC_HOOK_CODE

from firmware_py.config import parameters_of
from firmware_py.core_runner import CoreBlocks, CoreRunner
from firmware_py.export.arm_image import CoreImage, build_image
from firmware_py.export.c99 import Translation, translate
from firmware_py.export.cycles import count
from firmware_py.export.elf import FLASH
from firmware_py.export.errors import ExportError
from firmware_py.export.usage import CLOCK_MHZ
from hil.board.cores.cortex_m4 import ALIGNMENT, ROOM, STACK_LEAST, CortexM4Runner
from hil.config import load_config
from hil.emulator.stm32f405.chip import build_machine

CONFIG = load_config()
CACHE_LINES, LINE, WAIT_STATES, REFILL = 64, 16, 5, 3  # STM32F405 at 168 MHz, Cortex-M4

# Cycles by ARM's Cortex-M4 Technical Reference Manual, sections 3.3.1 and 7.2.3; lists of registers count by themselves.
MANUAL = {
    1: "mov movs movw movt mvn mvns add adds addw sub subs subw rsb rsbs adc adcs sbc sbcs cmp cmn tst teq and ands orr "
    "orrs orn eor eors bic bics lsl lsls lsr lsrs asr asrs ror ubfx sbfx bfi bfc uxtb uxth sxtb sxth adr mul muls mla mls "
    "umull umlal smull smlal smmul smmla clz b bl bx cbz cbnz it ite itt itte ittt itet itee itete iteet iteee itttt "
    "ittte ittee ittet itett nop usat ssat vadd vsub vmul vnmul vabs vneg vcmp vcmpe vcvt vmov vmrs vmsr",
    2: "ldr ldrb ldrh ldrsb ldrsh str strb strh vldr vstr",
    3: "ldrd strd tbb tbh vmla vmls vnmla vnmls vfma vfms",
    12: "sdiv udiv",
    14: "vdiv vsqrt",
}
CYCLES = {name: cycles for cycles, names in MANUAL.items() for name in names.split()}
CONDITIONS = ("", "eq", "ne", "hs", "lo", "mi", "pl", "vs", "vc", "hi", "ls", "ge", "lt", "gt", "le")
LISTS = ("push", "pop", "ldm", "stm", "vpush", "vpop", "vldm", "vstm")
ARITHMETIC = ("vadd", "vsub", "vmul", "vnmul", "vmla", "vmls", "vnmla", "vnmls", "vdiv")


@pytest.fixture(scope="module")
def core() -> Translation:
    return translate()


@pytest.fixture(scope="module")
def image(core: Translation) -> CoreImage:
    return build_image(core.source, core.header)


@pytest.fixture(scope="module")
def optimised(core: Translation) -> CoreImage:
    return build_image(core.source, core.header, "-O2")


@dataclass(frozen=True)
class Listed:
    """An instruction as capstone reads it."""

    address: int
    size: int
    cycles: int
    conditional: bool  # in an IT block: takes its time when it is skipped as well


def listed(image: CoreImage) -> list[Listed]:
    reader = capstone.Cs(capstone.CS_ARCH_ARM, capstone.CS_MODE_THUMB | capstone.CS_MODE_MCLASS)
    found: list[Listed] = []
    index, written, left = 0, "", 0  # left: in the IT block
    while index * 2 < len(image.code):
        if index in image.constants:
            index, written = index + 1, ""
            continue
        one = next(reader.disasm(image.code[index * 2 : index * 2 + 4], FLASH + index * 2))
        name = one.mnemonic.split(".")[0]
        operands = re.split(r",\s*", one.op_str.replace("{", "").replace("}", ""))
        cycles = cycles_of(name, one.op_str)
        arithmetic = name.startswith(ARITHMETIC)
        cycles += arithmetic and written in operands[1:]
        written = operands[0] if arithmetic else ""
        found.append(Listed(one.address, one.size, cycles, left > 0))
        left = len(name) - 1 if name.startswith("it") else left - 1
        index += one.size // 2
    return found


def cycles_of(name: str, operands: str) -> int:
    root = next((root for root in LISTS if name.startswith(root)), None)
    if root is not None:
        registers = operands[operands.index("{") :].strip("{}").split(",")
        words = sum(2 if register.strip().startswith("d") else 1 for register in registers)
        return 1 + words
    return next(CYCLES[stem] for suffix in CONDITIONS if (stem := name.removesuffix(suffix)) in CYCLES)


@pytest.mark.parametrize(
    ("code", "cycles"), [("91ed000a", 2), ("91ed000b", 3), ("81ed000b", 3), ("2ded048b", 5)],
    ids=["vldr s0", "vldr d0", "vstr d0", "vpush d8-d9"],
)  # fmt: skip
def test_a_double_is_two_words_of_memory(code: str, cycles: int) -> None:
    assert count(bytes.fromhex(code)).cycles[-1] == cycles


def runner_of(image: CoreImage) -> Callable[[CoreBlocks], CoreRunner]:
    return lambda blocks: CortexM4Runner(blocks, image, build_machine())


def started(image: CoreImage) -> tuple[CoreBlocks, CortexM4Runner]:
    blocks = CoreBlocks(parameters_of(CONFIG), runner_of(image))
    assert isinstance(blocks.run, CortexM4Runner)
    blocks.run.call("reset")
    return blocks, blocks.run


def feed(blocks: CoreBlocks, tick: int) -> None:
    """Write the inputs of a tick."""
    rng = np.random.default_rng(tick)
    data = blocks.data.fields
    data.mode = tick % 3 != 0
    data.gyro_sum[:] = rng.integers(-300, 300, 3)
    data.gyro_samples = 10
    quaternion = np.array([1.0, 0, 0, 0]) + 0.05 * rng.normal(size=4)
    data.pose_position[:] = 0.1 * rng.normal(size=3)
    data.pose_quaternion[:] = quaternion / np.linalg.norm(quaternion)
    data.pose_age_us = int(rng.integers(15_000, 130_000))


def memory(blocks: CoreBlocks) -> list[bytes]:
    return [block.bytes() for block in blocks.named.values()]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["image", "optimised"])
def test_instructions_and_cycles_are_those_of_capstone(kind: str, request: pytest.FixtureRequest) -> None:
    image = request.getfixturevalue(kind)
    sums = count(image.code, image.constants)
    instructions = listed(image)
    assert len(instructions) > 1000
    assert sums.instructions[-1] == len(instructions)
    wrong = [
        (hex(one.address), one.cycles, int(after - before))
        for one in instructions
        for i in [(one.address - FLASH) // 2]
        for before, after in [(sums.cycles[i], sums.cycles[i + one.size // 2])]
        if after - before != one.cycles
    ]
    assert wrong == []


@pytest.mark.long
@pytest.mark.parametrize("kind", ["image", "optimised"])
def test_a_call_costs_the_instructions_of_its_path(kind: str, request: pytest.FixtureRequest) -> None:
    image = request.getfixturevalue(kind)
    blocks, runner = started(image)
    for tick in range(20):
        feed(blocks, tick)
        runner.call("file_pose")
        runner.call("estimate")
    instructions = {one.address: one for one in listed(image)}
    starts: list[int] = []
    ways: list[tuple[int, int]] = []
    runner._chip._cpu.hook_add(UC_HOOK_CODE, lambda cpu, address, size, user: starts.append(address))
    runner._chip._cpu.hook_add(UC_HOOK_BLOCK, lambda cpu, address, size, user: ways.append((address, size)))
    runner._chip._cpu.ctl_flush_tb()
    feed(blocks, 20)
    runner.call("estimate")
    ways.pop()  # where the call returns to
    passed: list[int] = []
    cycles, lines, at = 0, OrderedDict[int, None](), 0
    for address, size in ways:
        cycles += REFILL * (address != at)
        at = address
        while at < address + size:
            passed.append(at)
            cycles += instructions[at].cycles
            at += instructions[at].size
        for line in range(address // LINE, (address + size - 1) // LINE + 1):
            cycles += WAIT_STATES * (line not in lines)
            lines[line] = None
            lines.move_to_end(line)
            if len(lines) > CACHE_LINES:
                lines.popitem(last=False)
    assert runner.cycles == cycles
    assert runner.instructions == len(passed) > len(starts) > 5_000
    assert Counter(starts) < Counter(passed)
    assert all(instructions[at].conditional for at in Counter(passed) - Counter(starts))


def test_looking_ahead_tells_the_cost_and_leaves_the_memory_alone(image: CoreImage) -> None:
    (blocks, runner), (direct, other) = started(image), started(image)
    for tick in range(30):
        for each in (blocks, direct):
            feed(each, tick)
        assert runner.call("file_pose") == other.call("file_pose")
        filed = other.cycles
        before = memory(blocks)
        cost_us = runner.estimate_us()
        assert memory(blocks) == before
        other.call("estimate")
        assert cost_us == -(-(filed + other.cycles) // CLOCK_MHZ)
        runner.call("estimate")
        cost_us = runner.control_us()
        other.call("control")
        assert cost_us == -(-other.cycles // CLOCK_MHZ)
        runner.call("control")
        assert memory(blocks) == memory(direct)
    assert runner.usage == other.usage


def test_look_ahead_results_are_dropped_when_the_inputs_change(image: CoreImage) -> None:
    (blocks, runner), (direct, other) = started(image), started(image)
    for each in (blocks, direct):
        feed(each, 1)
    runner.estimate_us()
    for each in (blocks, direct):
        each.data.fields.gyro_sum[0] += 100
    runner.call("estimate")
    other.call("estimate")
    assert memory(blocks) == memory(direct)
    runner.estimate_us()
    runner.control_us()  # overwrites what the estimator has left in RAM
    runner.call("estimate")
    other.call("estimate")
    assert memory(blocks) == memory(direct)


def test_code_that_goes_astray_is_stopped(image: CoreImage) -> None:
    _, runner = started(
        replace(image, entries={**image.entries, "control": (FLASH + len(image.code) + 2) | 1})
    )
    with pytest.raises(ExportError, match=r"control stopped at 0x0800....: undefined instruction"):
        runner.call("control")


@pytest.mark.long
@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("(void)*(volatile int32_t *)4;", "read near address 0"),
        ("*(volatile int32_t *)4 = 1;", "write near address 0"),
        ("for (volatile int32_t spin = 1; spin != 0;) { spin = 1; }", "it has run for a second"),
        ("volatile int32_t zero = 0; zero = 7 / zero;", ""),  # is 0
    ],
)
def test_a_call_that_cannot_end_names_its_reason(core: Translation, statement: str, reason: str) -> None:
    begin = r"(void floaty_core_control\([^)]*\) \{\n)"
    blocks, runner = started(build_image(re.sub(begin, rf"\1    {statement}\n", core.source), core.header))
    if reason:
        with pytest.raises(ExportError, match=rf"control stopped at 0x0800....: {reason}"):
            runner.call("control")
    else:
        runner.call("control")
        assert blocks.control.fields.count.all()


@pytest.mark.long
def test_memory_that_leaves_no_room_for_the_stack_is_refused(image: CoreImage) -> None:
    blocks, runner = started(image)
    most = ROOM - STACK_LEAST
    for size, fits in ((most - runner._stack_end, True), (most - runner._stack_end + 1, False)):
        blocks.named["spare"] = SimpleNamespace(memory=np.zeros(size, np.uint8))  # type: ignore[assignment]
        reason = f"the core's memory is {most + ALIGNMENT} bytes: at most {most} fit"
        with nullcontext() if fits else pytest.raises(ExportError, match=reason):
            runner_of(image)(blocks)


def test_the_core_leaves_room_on_the_board(image: CoreImage) -> None:
    blocks, runner = started(image)
    for tick in range(50):
        feed(blocks, tick)
        runner.call("file_pose")
        runner.call("estimate")
        runner.call("control")
    usage = runner.usage
    assert usage.flash_bytes < 16_384
    assert usage.ram_bytes == sum(map(len, memory(blocks))) < 8_192
    assert 0 < usage.stack_bytes < 1_024
    assert usage.entries["estimate"].calls == usage.entries["control"].calls == 50
    # A tenth of the tick.
    assert usage.entries["estimate"].worst_us + usage.entries["control"].worst_us < 1_000
    assert 0 < usage.entries["estimate"].mean_us < usage.entries["estimate"].worst_us


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "refused"),
    [
        (lambda text: text + "\nint floaty_state = 1;\n", "variable memory"),
        (
            lambda text: text.replace("void floaty_core_control", "static void floaty_core_control"),
            "floaty_core_control",
        ),
        (lambda text: text + "\nint floaty_wrong(void) { return; }\n", "error:"),
    ],
)
def test_code_that_is_no_core_fails(core: Translation, change: Callable[[str], str], refused: str) -> None:
    with pytest.raises(ExportError, match=refused) as error:
        build_image(change(core.source), core.header)
    assert "\n" not in str(error.value)


def test_a_build_is_reused(core: Translation, image: CoreImage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_py.export.compilers.subprocess", None)
    assert build_image(core.source, core.header) == image
