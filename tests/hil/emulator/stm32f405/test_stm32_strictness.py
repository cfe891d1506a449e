"""What the chip refuses, instruction by instruction: ARMv7-M Architecture Reference Manual, and ST's RM0090 and PM0214."""

from struct import pack, unpack

import numpy as np
import pytest

from hil.emulator.stm32f405 import chip as chip_module
from hil.emulator.stm32f405.chip import StopReason
from hil.errors import LabError
from support.stm32_bench import FLASH, RAM, Bench

START, VECTORS, DATA = FLASH + 8, RAM + 0x4000, RAM + 0x2000
VTOR, CCR, SHPR2, SHCSR, CFSR, HFSR, CPACR, MPU_CTRL = (
    0xE000_E000 + offset for offset in (0xD08, 0xD14, 0xD1C, 0xD24, 0xD28, 0xD2C, 0xD88, 0xD94)
)
GPIOA, TIM3_ARR, APB1ENR = 0x4002_0000, 0x4000_042C, 0x4002_3840
CCM, NO_MEMORY = 0x1000_0000, 0x3000_0000
HARD_FAULT, MEM_MANAGE, BUS_FAULT, USAGE_FAULT = 3, 4, 5, 6
IACCVIOL, IBUSERR, PRECISERR, BFARVALID = 1, 1 << 8, 1 << 9, 1 << 15  # in CFSR
UNSTKERR, STKERR = 1 << 11, 1 << 12
UNDEFINED, INVSTATE, INVPC, NOCP, UNALIGNED, DIVBYZERO = (1 << bit for bit in (16, 17, 18, 19, 24, 25))
UNALIGN_TRP, DIV_0_TRP, STKALIGN = 1 << 3, 1 << 4, 1 << 9  # in CCR
VECTTBL, FORCED, DEBUGEVT = 1 << 1, 1 << 30, 1 << 31  # in HFSR
HANDLED = 0b111 << 16  # in SHCSR: the three faults have handlers of their own
FLOATS = 0xF << 20  # in CPACR
WORDS = bytes(range(0x81, 0xC1))  # in memory, from DATA on
RUN_US = 10


class Strict(Bench):
    """Instructions on a chip whose exceptions all end in a sleeping handler."""

    def __init__(
        self, code: str, registers: dict[str, int] | None = None, ccr: int = STKALIGN, cpacr: int = FLOATS
    ) -> None:
        instructions = bytes.fromhex(code)
        super().__init__(instructions)
        self.handler = START + len(instructions)
        self.chip.write(VECTORS, pack("<16I", *[self.handler | 1] * 16))
        self.chip.write(DATA, WORDS)
        self[VTOR], self[CCR], self[CPACR] = VECTORS, ccr, cpacr
        for name, value in (registers or {}).items():
            self.chip.set_register(name, value)

    def run(self) -> int:
        """Run to the end and return the number of the exception, 0 without one."""
        self.wait(RUN_US)
        assert self.chip.register("pc") - self.handler in (0, 2)
        return self.chip.register("xpsr") & 0x1FF

    @property
    def stacked_pc(self) -> int:
        return int(unpack("<I", self.chip.read(self.chip.register("msp") + 24, 4))[0])

    @property
    def cfsr(self) -> int:
        return int(self.chip.state.cfsr)


ALIGNED = {
    "ldrd r0, r1, [r4]": "d4e9 0001", "strd r0, r1, [r4, #8]": "c4e9 0201", "ldm r4, {r0, r1}": "94e8 0300",
    "ldm r4!, {r0, r8}": "b4e8 0101", "stm r4!, {r0, r1}": "03c4", "stmdb r4, {r0, r1}": "04e9 0300",
    "vldr s0, [r4]": "94ed 000a", "vstr s0, [r4, #4]": "84ed 010a", "vldm r4, {s0-s3}": "94ec 040a",
    "vstmdb r4!, {s0-s1}": "24ed 020a", "vldr d0, [r4]": "94ed 000b", "vstr d0, [r4, #8]": "84ed 020b",
    "vldm r4!, {d0-d1}": "b4ec 040b", "vstm r4, {d0}": "84ec 020b", "ldrex r0, [r4]": "54e8 000f",
    "strex r2, r0, [r4]": "44e8 0002",
}  # fmt: skip
HALF_WORDS = {"ldrexh r0, [r4]": "d4e8 5f0f", "strexh r2, r0, [r4]": "c4e8 520f"}
EVERY = ALIGNED | HALF_WORDS


def ids(table: dict[str, str]) -> dict[str, object]:
    return {"argvalues": list(table.values()), "ids": list(table)}


@pytest.mark.long
@pytest.mark.parametrize("code", **ids(EVERY))
@pytest.mark.parametrize("enabled", [False, True], ids=["", "handled"])
def test_an_unaligned_multiple_floating_or_exclusive_access_is_a_usage_fault(
    code: str, enabled: bool
) -> None:
    bench = Strict(code, {"r4": DATA + 1})
    bench[SHCSR] = HANDLED if enabled else 0
    assert bench.run() == (USAGE_FAULT if enabled else HARD_FAULT)
    assert (bench.cfsr, bench.chip.state.hfsr) == (UNALIGNED, 0 if enabled else FORCED)
    assert bench.stacked_pc == START
    assert bench.chip.register("r4") == DATA + 1
    assert bench.chip.read(DATA, len(WORDS)) == WORDS


@pytest.mark.long
@pytest.mark.parametrize("code", **ids(ALIGNED))
def test_a_half_word_is_no_alignment_for_them(code: str) -> None:
    bench = Strict(code, {"r4": DATA + 2})
    bench.run()
    assert bench.cfsr == UNALIGNED


@pytest.mark.long
@pytest.mark.parametrize("code", **ids(EVERY))
def test_the_same_accesses_to_aligned_words_pass(code: str) -> None:
    bench = Strict(code, {"r4": DATA + 20})  # not a multiple of eight
    assert (bench.run(), bench.cfsr) == (0, 0)


@pytest.mark.long
def test_an_unaligned_access_that_is_not_executed_is_no_fault() -> None:
    # cmp r6, #1; ite eq; vldreq d0, [r4]; movne r7, #5
    bench = Strict("012e 0cbf 94ed 000b 0527", {"r4": DATA + 1})
    assert bench.run() == 0
    assert bench.chip.register("r7") == 5


@pytest.mark.parametrize("register", ["s0", "d0"])
def test_an_unaligned_access_in_an_it_block_is_a_fault(register: str) -> None:
    # cmp r6, #0; itt eq; vldreq [r4]; moveq r7, #5; behind d0 the block is executed to its end, before the fault
    bench = Strict(f"002e 04bf 94ed 000{'a' if register == 's0' else 'b'} 0527", {"r4": DATA + 1})
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.stacked_pc) == (UNALIGNED, START + 4)


def word(offset: int) -> int:
    return int.from_bytes(WORDS[offset : offset + 4], "little")


SINGLE = {
    "ldr r0, [r4]": "2068", "ldr r0, [r4, #8]": "a068", "ldr.w r0, [r4, #1]": "d4f8 0100", "ldr r0, [r4], #5": "54f8 050b",
    "ldr r0, [r4, #-2]!": "54f8 020d", "ldr r0, [r4, r5]": "6059", "ldr r0, [r4, r5, lsl #1]": "54f8 1500",
    "ldrt r0, [r4]": "54f8 000e", "ldrh r0, [r4, #2]": "6088", "ldrsh r0, [r4, r5]": "605f",
    "ldrsh.w r0, [r4, #2]": "b4f9 0200",
    "str r0, [r4, #4]": "6060", "str r0, [r4, r5]": "6051", "str.w r0, [r4, #1]": "c4f8 0100", "strh r0, [r4, #2]": "6080",
}  # fmt: skip


def random_access(rng: np.random.Generator) -> tuple[bytes, int, int]:
    """A load or store of one register, its base and its index, in every encoding (A5.2.4, A5.3.7 to A5.3.10)."""
    low = [int(register) for register in rng.permutation(8)]
    high = [int(register) for register in rng.permutation(13)]
    loads, half = int(rng.integers(2)), int(rng.integers(2))
    if rng.random() < 0.4:
        target, base, index = low[:3]
        operation = int(rng.choice((0, 1, 4, 5, 7)))
        by_index = 0x5000 | operation << 9 | index << 6
        by_number = (0x8000 if half else 0x6000) | loads << 11 | int(rng.integers(32)) << 6
        return pack("<H", int(rng.choice((by_index, by_number))) | base << 3 | target), base, index
    target, base, index = high[:3]
    target = base if rng.random() < 0.1 else target
    signed = int(loads and half and rng.random() < 0.5)
    first = 0xF800 | signed << 8 | (1 if half else 2) << 5 | loads << 4 | base
    before, adds, writes_back = (int(bit) for bit in rng.integers(0, 2, 3))
    form, number = rng.integers(3), int(rng.integers(100))
    if form == 0:
        return pack("<2H", first | 0x80, target << 12 | number), base, index
    if form == 1:
        return pack("<2H", first, target << 12 | int(rng.integers(4)) << 4 | index), base, index
    # Without an offset before it an access moves the base, which then is not what it loads.
    writes_back = target != base and (writes_back or not before)
    flags = (before or not writes_back) << 10 | adds << 9 | writes_back << 8
    return pack("<2H", first, target << 12 | 0x800 | flags | number), base, index


@pytest.mark.long
def test_each_load_and_store_of_one_register_is_that_of_a_core_that_aligns_nothing() -> None:
    from unicorn import UC_ARCH_ARM, UC_MODE_THUMB, Uc, arm_const

    bench, rng, reference = Strict("00bf 00bf"), np.random.default_rng(9), Uc(UC_ARCH_ARM, UC_MODE_THUMB)
    reference.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M4)
    reference.mem_map(FLASH, 0x1000)
    reference.mem_map(RAM, 0x2_0000)
    names = [f"r{number}" for number in range(13)]
    numbers = [getattr(arm_const, f"UC_ARM_REG_R{number}") for number in range(13)]
    for _ in range(500):
        code, base, index = random_access(rng)
        memory = rng.bytes(512)
        registers = rng.integers(0, 1 << 32, 13).tolist()
        registers[index], registers[base] = int(rng.integers(16)), DATA + 200 + int(rng.integers(8))
        bench.chip.write(START, code)
        bench.chip.write(DATA, memory)
        reference.mem_write(START, code)
        reference.mem_write(DATA, memory)
        for name, number, value in zip(names, numbers, registers, strict=True):
            bench.chip.set_register(name, value)
            reference.reg_write(number, value)
        bench.chip.set_register("pc", START)
        bench.chip.step()
        reference.emu_start(START | 1, START + len(code), count=1)
        found = [bench.chip.register(name) for name in names]
        assert found == [reference.reg_read(number) for number in numbers], code.hex()
        assert bench.chip.read(DATA, 512) == bytes(reference.mem_read(DATA, 512)), code.hex()
        assert bench.chip.register("pc") == START + len(code)


@pytest.mark.parametrize("code", **ids(SINGLE))
def test_unalign_trp_forbids_every_unaligned_access(code: str) -> None:
    bench = Strict(code, {"r4": DATA + 5, "r5": 2}, ccr=STKALIGN | UNALIGN_TRP)
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.stacked_pc) == (UNALIGNED, START)


@pytest.mark.long
@pytest.mark.parametrize(
    ("address", "status"),
    [
        (GPIOA, UNALIGNED), (0x5000_0000, UNALIGNED), (0xA000_0000, UNALIGNED), (0xC000_0000, UNALIGNED),
        (0x6000_0000, PRECISERR | BFARVALID), (0x9FFF_FFF0, PRECISERR | BFARVALID),
    ],
    ids=hex,
)  # fmt: skip
def test_an_unaligned_access_to_a_device_is_a_usage_fault(address: int, status: int) -> None:
    bench = Strict("2068", {"r4": address + 2})
    bench.run()
    assert bench.cfsr == status


def test_an_unaligned_access_within_a_block_costs_what_an_aligned_one_costs() -> None:
    code = "2068 0137 2068 0137"  # ldr r0, [r4]; adds r7, #1; twice
    benches = [Strict(code, {"r4": DATA + offset}) for offset in (4, 5)]
    assert [bench.run() for bench in benches] == [0, 0]
    assert [bench.chip.register("r7") for bench in benches] == [2, 2]
    states = [bench.chip.state for bench in benches]
    assert states[0].instructions == states[1].instructions
    assert states[0].sleeping == states[1].sleeping


def test_an_unaligned_load_in_an_it_block_keeps_the_condition_of_the_next() -> None:
    # cmp r6, #0; itte eq; ldreq r0, [r4]; addeq r7, #5; addne r7, #1
    bench = Strict("002e 06bf 2068 0537 0137", {"r4": DATA + 5})
    assert bench.run() == 0
    assert (bench.chip.register("r0"), bench.chip.register("r7")) == (word(5), 5)


def test_behind_an_it_block_that_ends_with_an_unaligned_load_nothing_is_conditional() -> None:
    bench = Strict(
        "002e 08bf 2068 0537 0137", {"r4": DATA + 5}
    )  # cmp r6, #0; it eq; ldreq r0, [r4]; adds r7, #5; #1
    assert bench.run() == 0
    assert (bench.chip.register("r0"), bench.chip.register("r7")) == (word(5), 6)


@pytest.mark.parametrize(("code", "place"), [("dff8 0500", 17), ("5ff8 0500", 7)])
def test_an_unaligned_load_by_the_pc_counts_from_a_word(code: str, place: int) -> None:
    bench = Strict(f"00bf {code} 0137")  # nop; ldr.w r0, [pc, #5 or #-5]
    assert bench.run() == 0
    assert bench.chip.register("r0") == int.from_bytes(bench.chip.read(FLASH + place, 4), "little")


def test_a_step_over_an_unaligned_load_ends_after_it() -> None:
    bench = Strict("2068 2068 0137", {"r4": DATA + 5})
    bench.chip.step()
    assert (bench.chip.register("pc"), bench.chip.register("r0")) == (START + 2, word(5))
    instructions = bench.chip.state.instructions
    bench.chip.step()
    assert bench.chip.register("pc") == START + 4
    assert bench.chip.state.instructions == instructions  # counted at the begin of their block


def test_a_step_does_not_wake_a_processor_that_sleeps() -> None:
    bench = Strict("30bf 4ff0 0500 0137")  # wfi; mov.w r0, #5; adds r7, #1
    chip = bench.chip
    assert chip.step() & StopReason.STEP
    slept_at = chip.state.now
    assert not chip.step(slept_at + 500) & StopReason.STEP
    assert (chip.register("pc"), chip.state.now) == (START + 2, slept_at + 500)


@pytest.mark.long
@pytest.mark.parametrize(
    ("code", "kind", "first", "last"),
    [
        ("2068", 3, 5, 8),
        ("2060", 2, 5, 8),
        ("2068", 3, 4, 7),
        ("2060", 2, 4, 7),
        ("84ed 000b", 2, 0, 7),
        ("94ed 000b", 3, 0, 7),
    ],
    ids=["unaligned read", "unaligned write", "read", "write", "double written", "double read"],
)
def test_a_watchpoint_sees_an_access_by_each_of_its_bytes_and_no_other(
    code: str, kind: int, first: int, last: int
) -> None:
    for place in (first - 1, first, last, last + 1):
        for watched in (2, 3, 4):
            bench = Strict(code, {"r4": DATA + first})
            bench.chip.watch(watched, DATA + place, 1, True)
            seen = first <= place <= last and watched in (kind, 4)
            assert bool(bench.chip.run(1680) & StopReason.WATCHPOINT) == seen
            assert bench.chip.state.watch_address == (DATA + place if seen else 0)
            other = 2 + (watched - 1) % 3
            with pytest.raises(LabError):
                bench.chip.watch(other, DATA + place, 1, False)
            bench.chip.watch(watched, DATA + place, 1, False)


def test_an_access_inside_a_watched_range_is_reported_by_its_own_address() -> None:
    bench = Strict("2068", {"r4": DATA + 4})
    bench.chip.watch(3, DATA, 16, True)
    assert bench.chip.run(1680) & StopReason.WATCHPOINT
    assert bench.chip.state.watch_address == DATA + 4


def test_an_interrupt_that_is_masked_ends_a_sleep_that_went_on_over_a_run() -> None:
    bench = Strict("72b6 30bf 0137 fee7")  # cpsid i; wfi; adds r7, #1; b to itself
    bench.wait(5)
    assert bench.chip.register("r7") == 0
    bench[0xE000_E100] = bench[0xE000_E200] = 1  # interrupt 0 is enabled and pending
    bench.wait(5)
    assert (bench.chip.register("r7"), bench.chip.register("xpsr") & 0x1FF) == (1, 0)


def test_a_reset_in_front_of_the_end_of_a_block_forgets_that_end() -> None:
    bench = Strict("00bf 00bf 71b6")  # nop; nop; cpsid f
    bench.chip.breakpoints = {START + 2}
    assert bench.chip.run(1680) & StopReason.BREAK
    bench.chip.reset(1 << 28)
    bench.chip.breakpoints = set()
    bench.chip.set_register("pc", START + 6)
    bench.wait(10)
    assert bench.chip.register("faultmask") == 0


STACKING = {
    "push {r0}": "01b4", "push {r0, lr}": "01b5", "push.w {r0, r8}": "2de9 0101", "sub sp, #8": "82b0",
    "sub.w sp, #8": "adf1 080d",
    "mov sp, r4": "a546", "add sp, r5": "ad44", "str r0, [sp, #-4]!": "4df8 040d", "strd r0, r1, [sp, #-8]!": "6de9 0201",
    "vpush {d8}": "2ded 028b", "vpush {s16}": "2ded 018a", "subw sp, sp, #8": "adf2 080d", "sub.w sp, sp, r6": "adeb 060d",
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("code", **ids(STACKING))
def test_each_instruction_that_lowers_the_stack_pointer_may_overflow_a_stack(code: str) -> None:
    for room, overflows in ((0, True), (64, False)):
        bench = Strict(f"{code} ffe7", {"r4": RAM + 0xFF0, "r5": -8 & 0xFFFF_FFFF, "r6": 8})
        bench.chip.state.stack_begin, bench.chip.state.task[0].block = RAM + 0x1000 - room, 7
        assert bool(bench.chip.run(1680) & StopReason.OVERFLOW) == overflows
        assert bench.chip.state.overflow == 7 * overflows
        bench.chip.reset(1 << 28)
        assert (bench.chip.state.overflow, bench.chip.state.stack_begin) == (0, 0)


def test_masks_are_read_as_they_were_written() -> None:
    # movs r0, #0x5f; msr basepri_max, r0; mrs r1, basepri; movs r0, #0x70; msr basepri_max, r0; mrs r2, basepri_max
    # msr basepri, r0; mrs r5, basepri; cpsid f; mrs r3, faultmask; cpsie f; mrs r4, faultmask
    raised = "5f20 80f3 1288 eff3 1181 7020 80f3 1288 eff3 1282"  # the maximum raises 0 and lowers nothing
    # movs r0, #1; msr faultmask, r0; mrs r9, faultmask; movs r0, #2; msr faultmask, r0; mrs r10, faultmask
    by_msr = "0120 80f3 1388 eff3 1389 0220 80f3 1388 eff3 138a"
    both = "73b6 eff3 138b 63b6 eff3 138c"  # cpsid if; mrs r11, faultmask; cpsie if; mrs r12, faultmask
    bench = Strict(f"{raised} 80f3 1188 eff3 1185 71b6 eff3 1383 61b6 eff3 1384 {by_msr} {both}")
    assert bench.run() == 0
    assert [bench.chip.register(f"r{n}") for n in (11, 12)] == [1, 0]
    assert [bench.chip.register(f"r{n}") for n in (1, 2, 5, 3, 4, 9, 10)] == [0x50, 0x50, 0x70, 1, 0, 1, 0]


ARMV8_M = {
    "lda r0, [r4]": "d4e8 af0f",
    "stl r0, [r4]": "c4e8 af0f",
    "tt r0, r4": "44e8 00f0",
    "vseleq.f32 s0, s0, s0": "00fe 000a",
    "vmaxnm.f32 s0, s0, s0": "80fe 000a",
    "vrintz.f32 s0, s0": "b6ee c00a",
}


@pytest.mark.long
@pytest.mark.parametrize("code", **ids(ARMV8_M))
def test_an_instruction_of_a_later_core_is_undefined(code: str) -> None:
    bench = Strict(code, {"r4": DATA})
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.stacked_pc) == (UNDEFINED, START)


def test_a_stack_pointer_is_a_multiple_of_four() -> None:
    bench = Strict("80f3 0888 80f3 0988", {"r0": DATA + 3})  # msr msp, r0; msr psp, r0
    assert bench.run() == 0
    assert [bench.chip.register(name) for name in ("msp", "psp")] == [DATA, DATA]


def test_an_unknown_unicorn_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chip_module, "CORTEX_M4_FEATURES", 0x1234_5678_9ABC_DEF0)
    with pytest.raises(LabError, match="this version of unicorn"):
        Bench()


# Floats, divisions, breakpoints


FLOAT_INSTRUCTIONS = {
    "vldr s0, [r4]": "94ed 000a",
    "vadd.f32 s0, s0, s0": "30ee 000a",
    "vmov s0, r0": "00ee 100a",
    "vpush {d8}": "2ded 028b",
    "vmrs r0, fpscr": "f1ee 100a",
}


@pytest.mark.long
@pytest.mark.parametrize("code", **ids(FLOAT_INSTRUCTIONS))
def test_floats_before_they_are_enabled_are_a_usage_fault(code: str) -> None:
    bench = Strict(code, {"r4": DATA}, cpacr=0)
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.stacked_pc) == (NOCP, START)
    assert Strict(code, {"r4": DATA}).run() == 0


def test_floats_are_enabled_and_disabled_by_the_code_itself() -> None:
    # str r1, [r0]; dsb; isb; vmov s0, r0; str r2, [r0]; dsb; isb; vmov s0, r0
    barriers = "bff3 4f8f bff3 6f8f"
    code = f"0160 {barriers} 00ee 100a 0260 {barriers} 00ee 100a"
    bench = Strict(code, {"r0": CPACR, "r1": FLOATS, "r2": 0}, cpacr=0)
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.stacked_pc) == (NOCP, START + 24)


@pytest.mark.long
@pytest.mark.parametrize("code", ["91fb f2f0", "b1fb f2f0", "91fb fcf0"], ids=["sdiv", "udiv", "by r12"])
def test_a_division_by_zero_is_a_usage_fault_if_the_firmware_wants_it_so(code: str) -> None:
    bench = Strict(code, {"r1": 7, "r4": 1}, ccr=STKALIGN | DIV_0_TRP)
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.stacked_pc) == (DIVBYZERO, START)
    bench = Strict(code, {"r0": 1, "r1": 7})
    assert (bench.run(), bench.chip.register("r0")) == (0, 0)


def test_a_breakpoint_holds_each_arrival_once() -> None:
    bench = Strict("0137 fde7")  # adds r7, #1; b to it
    chip = bench.chip
    chip.breakpoints = {START}
    for moves_pc, counted in ((True, 0), (True, 0), (False, 1), (False, 2)):
        if moves_pc:
            chip.set_register("pc", START + 2)
        assert chip.run(chip.state.now + 1000) & StopReason.BREAK
        assert (chip.register("pc"), chip.register("r7")) == (START, counted)
    chip.set_register("pc", START + 2)
    chip.step()  # onto it
    assert chip.run(chip.state.now + 1000) & StopReason.BREAK
    assert (chip.register("pc"), chip.register("r7")) == (START, 3)


def test_there_is_room_for_64_breakpoints_and_one_that_went_makes_room() -> None:
    chip = Strict("").chip
    chip.breakpoints = {FLASH + 2 * number for number in range(64)}
    chip.run(1)
    chip.breakpoints |= {FLASH + 128}
    with pytest.raises(LabError, match="more breakpoints"):
        chip.run(1)
    other = Strict("").chip
    other.breakpoints = {FLASH + 2 * number for number in range(64)}
    other.run(1)
    other.breakpoints = {FLASH + 128 + 2 * number for number in range(63)}
    other.run(1)


def test_a_breakpoint_instruction_without_a_debugger_is_a_hard_fault() -> None:
    bench = Strict("00be")
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.chip.state.hfsr, bench.stacked_pc) == (0, DEBUGEVT, START)


# Memory


@pytest.mark.long
@pytest.mark.parametrize(
    ("target", "exception", "status"),
    [
        (GPIOA, MEM_MANAGE, IACCVIOL),
        (0x5000_0000, MEM_MANAGE, IACCVIOL),
        (0xA000_0000, MEM_MANAGE, IACCVIOL),
        (0xE000_E000, MEM_MANAGE, IACCVIOL),
        (0xFFFF_FFF8, MEM_MANAGE, IACCVIOL),  # as a return from an exception, outside of one
        (CCM, BUS_FAULT, IBUSERR),
        (NO_MEMORY, BUS_FAULT, IBUSERR),
        (0x6000_0000, BUS_FAULT, IBUSERR),
    ],
    ids=hex,
)
def test_no_code_is_fetched_from_devices_and_from_where_no_bus_leads(
    target: int, exception: int, status: int
) -> None:
    bench = Strict("2047", {"r4": target | 1})  # bx r4
    bench[SHCSR] = HANDLED
    assert bench.run() == exception
    assert (bench.cfsr, bench.stacked_pc) == (status, target)


@pytest.mark.long
@pytest.mark.parametrize("code", ["2068", "2060"], ids=["read", "written"])
@pytest.mark.parametrize(
    "address", [NO_MEMORY, RAM + 0x2_0000, 0x4008_0000, 0x6000_0000, 0xC000_0000], ids=hex
)
def test_an_access_to_where_nothing_is_is_a_bus_fault_with_its_address(code: str, address: int) -> None:
    bench = Strict(code, {"r4": address})
    bench[SHCSR] = HANDLED
    assert bench.run() == BUS_FAULT
    assert (bench.cfsr, bench.chip.state.bfar, bench.stacked_pc) == (PRECISERR | BFARVALID, address, START)


def test_the_first_sixteen_writers_near_address_0_are_reported_once() -> None:
    bench = Strict("2160" * 18 + "dae7", {"r4": 0x40})  # str r1, [r4]; b to the second
    reasons = [bench.chip.run(bench.chip.state.now + 500) for _ in range(20)]
    assert reasons == [StopReason.LOW_WRITE] * 16 + [StopReason.TIME] * 4


def test_a_store_to_locked_flash_has_no_effect() -> None:
    bench = Strict("2060", {"r4": FLASH + 0x8000})
    assert bench.run() == 0
    assert bench.chip.read(FLASH + 0x8000, 4) == b"\xff" * 4


@pytest.mark.long
@pytest.mark.parametrize("bit", [0, 6, 15, 31])
@pytest.mark.parametrize("before", [0, 0xFFFF_FFFF, 0x5A5A_A5A5])
@pytest.mark.parametrize("place", [DATA + 4, APB1ENR])
def test_a_bit_of_memory_or_of_a_peripheral_is_a_word_of_its_own(bit: int, before: int, place: int) -> None:
    region = place & 0xF000_0000
    alias = region + 0x0200_0000 + (place - region) * 32 + 4 * bit
    for value in (0, 1, 2, 3):  # only the lowest bit of it counts
        bench = Strict(
            "2868 2160 2a68", {"r1": value, "r4": alias, "r5": alias}
        )  # ldr r0, [r5]; str; ldr r2, [r5]
        bench[place] = before
        assert bench.run() == 0
        assert (bench.chip.register("r0"), bench.chip.register("r2")) == (before >> bit & 1, value & 1)
        assert bench[place] == before & ~(1 << bit) | (value & 1) << bit


def test_a_peripheral_without_a_clock_reads_as_zero_and_keeps_nothing() -> None:
    for clocks, expected in ((0, 0), (1 << 1, 100)):
        bench = Strict("2160 2068", {"r0": 1, "r1": 100, "r4": TIM3_ARR})  # str r1, [r4]; ldr r0, [r4]
        bench[APB1ENR] = clocks
        assert bench.run() == 0
        assert bench.chip.register("r0") == expected
        assert bench.chip.state.unknown_count == (0 if clocks else 1)


def test_a_memory_protection_unit_is_reported_as_missing() -> None:
    bench = Strict("2160", {"r1": 1, "r4": MPU_CTRL})
    assert bench.run() == 0
    assert bench.chip.state.unknown[0] == MPU_CTRL


# Exceptions


def with_handler(code: str, handler: str, **registers: int) -> Strict:
    """`svc #0` and its handler, which follows `code`; the other exceptions sleep."""
    bench = Strict(f"{code} 00df fee7 {handler}", registers)  # fee7: b to itself
    bench.chip.write(VECTORS + 4 * 11, pack("<I", (START + len(bytes.fromhex(code)) + 4) | 1))
    bench[SHCSR] = HANDLED
    return bench


INVALID_RETURNS = {  # handlers
    "to a handler that did not run": ("8ef0 080e 7047", INVPC),  # eor lr, #8
    "to nothing": ("8ef0 020e 7047", INVPC),  # eor lr, #2
    "with a frame of a handler": (
        "0798 0330 0790 7047",
        INVPC,
    ),  # ldr r0, [sp, #28]; adds r0, #3; str r0, [sp, #28]
    "with a frame of no Thumb code": ("0020 0790 7047", INVSTATE),  # movs r0, #0; str r0, [sp, #28]
    "with a frame in no memory": ("80f3 0988 6ff0 020e 7047", UNSTKERR),  # msr psp, r0; mvn lr, #2
}


@pytest.mark.parametrize(("handler", "status"), INVALID_RETURNS.values(), ids=INVALID_RETURNS.keys())
def test_an_invalid_return_from_an_exception_is_a_fault(handler: str, status: int) -> None:
    bench = with_handler("", handler, r0=NO_MEMORY)
    assert bench.run() == (BUS_FAULT if status == UNSTKERR else USAGE_FAULT)
    assert bench.cfsr == status
    assert bench.stacked_pc & 1 == 0


@pytest.mark.long
@pytest.mark.parametrize(("code", "ccr", "padding"), [
    ("01b4 00df", STKALIGN, 4), ("01b4 00df", 0, 0), ("00ee 100a 01b4 00df", STKALIGN, 4), ("00ee 100a 01b4 00df", 0, 4),
])  # fmt: skip
def test_a_frame_is_aligned_to_eight_bytes_unless_that_is_switched_off(
    code: str, ccr: int, padding: int
) -> None:
    """With floats it is always so. B1.5.7."""
    bench = Strict(code, ccr=ccr)  # vmov s0, r0; push {r0}; svc
    floats = 0x48 * code.startswith("00ee")
    before = bench.chip.register("msp") - 4
    assert bench.run() == 11
    frame = bench.chip.register("msp")
    assert before - frame == 0x20 + padding + floats
    assert bench[frame + 28] >> 9 & 1 == (padding == 4)


@pytest.mark.parametrize(
    ("code", "priority", "exception"),
    [("72b6 00df", 0, HARD_FAULT), ("81f3 1188 00df", 0x60, HARD_FAULT), ("81f3 1188 00df", 0x40, 11)],
    ids=["primask", "basepri", "more urgent"],
)
def test_a_supervisor_call_where_it_may_not_interrupt_is_a_hard_fault(
    code: str, priority: int, exception: int
) -> None:
    bench = Strict(code, {"r1": 0x50})  # cpsid i, or msr basepri, r1
    bench[SHPR2] = priority << 24
    assert bench.run() == exception
    assert bench.chip.state.hfsr == (FORCED if exception == HARD_FAULT else 0)


@pytest.mark.parametrize(
    ("priority", "exception"), [(0x30, USAGE_FAULT), (0x40, HARD_FAULT), (0x50, HARD_FAULT)]
)
def test_a_fault_in_a_handler_is_a_hard_fault_unless_it_is_more_urgent(priority: int, exception: int) -> None:
    bench = with_handler("", "00de")  # udf
    bench[SHPR2], bench[SHPR2 - 4] = 0x40 << 24, priority << 16
    assert bench.run() == exception
    assert bench.chip.state.hfsr == (FORCED if exception == HARD_FAULT else 0)
    bench[HFSR] = bench[CFSR] = 0
    assert (bench.cfsr, bench.chip.state.hfsr) == (UNDEFINED, FORCED if exception == HARD_FAULT else 0)
    bench[HFSR], bench[CFSR] = FORCED, UNDEFINED
    assert (bench[CFSR], bench[HFSR]) == (0, 0)


def test_flags_reach_the_handler() -> None:
    bench = Strict(
        "80fa 40f0 00df", {"r0": 0xFFFF_FFFF}
    )  # uadd8 r0, r0, r0; svc: the greater-or-equal of bytes
    bench.chip.set_register("xpsr", 0xF800_0000 | 1 << 24)
    assert bench.run() == 11
    assert bench.chip.register("xpsr") == 0xF80F_0000 | 1 << 24 | 11


def test_a_fault_while_interrupts_are_masked_is_a_hard_fault() -> None:
    bench = Strict("72b6 00de")  # cpsid i; udf
    bench[SHCSR] = HANDLED
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.chip.state.hfsr) == (UNDEFINED, FORCED)


@pytest.mark.parametrize("code", ["71b6 00de", "71b6 00df"], ids=["udf", "svc"])
def test_a_fault_while_faults_are_masked_locks_up(code: str) -> None:
    assert Strict(code).wait(RUN_US) & StopReason.LOCKUP  # cpsid f


def test_a_vector_table_without_memory_locks_up() -> None:
    bench = Strict("00df")
    bench[VTOR] = NO_MEMORY
    assert bench.wait(RUN_US) & StopReason.LOCKUP
    assert bench.chip.state.hfsr & VECTTBL


def test_an_exception_whose_frame_has_no_memory_is_a_hard_fault() -> None:
    bench = Strict("00df", {"msp": RAM + 0x10})
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.chip.state.hfsr) == (STKERR, FORCED)
