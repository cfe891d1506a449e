"""What the chip refuses, instruction by instruction: ARMv7-M Architecture Reference Manual, and ST's RM0090 and PM0214."""

from struct import pack, unpack

import pytest

from hil.errors import LabError
from hil.stm32f405 import chip as chip_module
from support.stm32_bench import FLASH, RAM, Bench

START, VECTORS, DATA = FLASH + 8, RAM + 0x4000, RAM + 0x2000
VTOR, CCR, SHCSR = 0xE000_ED08, 0xE000_ED14, 0xE000_ED24
GPIOA = 0x4002_0000
HARD_FAULT, MEM_MANAGE, BUS_FAULT, USAGE_FAULT = 3, 4, 5, 6
UNDEFINED, UNALIGNED = 1 << 16, 1 << 24  # in CFSR
UNALIGN_TRP = 1 << 3
FORCED = 1 << 30  # in HFSR
WORDS = bytes(range(0x81, 0xC1))  # in memory, from DATA on
RUN_US = 10


class Strict(Bench):
    """Instructions on a chip whose exceptions all end in a sleeping handler."""

    def __init__(self, code: str, registers: dict[str, int] | None = None, ccr: int = 0x200) -> None:
        instructions = bytes.fromhex(code)
        super().__init__(instructions)
        self.handler = START + len(instructions)
        self.chip.write(VECTORS, pack("<16I", *[self.handler | 1] * 16))
        self.chip.write(DATA, WORDS)
        self[VTOR], self[CCR] = VECTORS, ccr
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
    "ldrd r0, r1, [r4]": "d4e9 0001",
    "strd r0, r1, [r4, #8]": "c4e9 0201",
    "ldm r4, {r0, r1}": "94e8 0300",
    "ldm r4!, {r0, r8}": "b4e8 0101",
    "stm r4!, {r0, r1}": "03c4",
    "stmdb r4, {r0, r1}": "04e9 0300",
    "vldr s0, [r4]": "94ed 000a",
    "vstr s0, [r4, #4]": "84ed 010a",
    "vldm r4, {s0-s3}": "94ec 040a",
    "vstmdb r4!, {s0-s1}": "24ed 020a",
    "vldr d0, [r4]": "94ed 000b",
    "vstr d0, [r4, #8]": "84ed 020b",
    "vldm r4!, {d0-d1}": "b4ec 040b",
    "vstm r4, {d0}": "84ec 020b",
    "ldrex r0, [r4]": "54e8 000f",
    "strex r2, r0, [r4]": "44e8 0002",
}
HALF_WORDS = {"ldrexh r0, [r4]": "d4e8 5f0f", "strexh r2, r0, [r4]": "c4e8 520f"}
EVERY = ALIGNED | HALF_WORDS


def ids(table: dict[str, str]) -> dict[str, object]:
    return {"argvalues": list(table.values()), "ids": list(table)}


@pytest.mark.parametrize("code", **ids(EVERY))
@pytest.mark.parametrize("enabled", [False, True], ids=["", "handled"])
def test_an_unaligned_multiple_floating_or_exclusive_access_is_a_usage_fault(
    code: str, enabled: bool
) -> None:
    bench = Strict(code, {"r4": DATA + 1})
    bench[SHCSR] = 1 << 18 if enabled else 0
    assert bench.run() == (USAGE_FAULT if enabled else HARD_FAULT)
    assert (bench.cfsr, bench.chip.state.hfsr) == (UNALIGNED, 0 if enabled else FORCED)
    assert bench.stacked_pc == START
    assert bench.chip.register("r4") == DATA + 1
    assert bench.chip.read(DATA, len(WORDS)) == WORDS


@pytest.mark.parametrize("code", **ids(ALIGNED))
def test_a_half_word_is_no_alignment_for_them(code: str) -> None:
    bench = Strict(code, {"r4": DATA + 2})
    bench.run()
    assert bench.cfsr == UNALIGNED


@pytest.mark.parametrize("code", **ids(EVERY))
def test_the_same_accesses_to_aligned_words_pass(code: str) -> None:
    bench = Strict(code, {"r4": DATA + 20})  # not a multiple of eight
    assert (bench.run(), bench.cfsr) == (0, 0)


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


def half(offset: int) -> int:
    return int.from_bytes(WORDS[offset : offset + 2], "little")


LOADS = {  # with r4 = DATA + 5 and r5 = 2: code, r0, r4
    "ldr r0, [r4]": ("2068", word(5), 5),
    "ldr r0, [r4, #8]": ("a068", word(13), 5),
    "ldr.w r0, [r4, #1]": ("d4f8 0100", word(6), 5),
    "ldr r0, [r4], #5": ("54f8 050b", word(5), 10),
    "ldr r0, [r4, #-2]!": ("54f8 020d", word(3), 3),
    "ldr r0, [r4, r5]": ("6059", word(7), 5),
    "ldr r0, [r4, r5, lsl #1]": ("54f8 1500", word(9), 5),
    "ldrt r0, [r4]": ("54f8 000e", word(5), 5),
    "ldr r4, [r4]": ("2468", None, word(5) - DATA),
    "ldrh r0, [r4, #2]": ("6088", half(7), 5),
    "ldrsh r0, [r4, r5]": ("605f", half(7) | 0xFFFF_0000, 5),
    "ldrsh.w r0, [r4, #2]": ("b4f9 0200", half(7) | 0xFFFF_0000, 5),
    "ldrh r0, [r4], #2": ("34f8 020b", half(5), 7),
}
STORES = {  # with r0 = 0x44332211: code, offset, bytes, r4
    "str r0, [r4, #4]": ("6060", 9, 4, 5),
    "str r0, [r4, r5]": ("6051", 7, 4, 5),
    "str.w r0, [r4, #1]": ("c4f8 0100", 6, 4, 5),
    "str r0, [r4], #5": ("44f8 050b", 5, 4, 10),
    "strh r0, [r4, #2]": ("6080", 7, 2, 5),
    "strh r0, [r4, #-2]": ("24f8 020c", 3, 2, 5),
}


@pytest.mark.parametrize(("code", "loaded", "moved"), LOADS.values(), ids=LOADS.keys())
def test_an_unaligned_load_of_one_register_is_carried_out(code: str, loaded: int | None, moved: int) -> None:
    bench = Strict(code, {"r4": DATA + 5, "r5": 2})
    assert bench.run() == 0
    assert loaded in (None, bench.chip.register("r0"))
    assert bench.chip.register("r4") == DATA + moved


@pytest.mark.parametrize(("code", "offset", "size", "moved"), STORES.values(), ids=STORES.keys())
def test_an_unaligned_store_of_one_register_is_carried_out(
    code: str, offset: int, size: int, moved: int
) -> None:
    bench = Strict(code, {"r0": 0x4433_2211, "r4": DATA + 5, "r5": 2})
    assert bench.run() == 0
    expected = WORDS[:offset] + pack("<I", 0x4433_2211)[:size] + WORDS[offset + size :]
    assert bench.chip.read(DATA, len(WORDS)) == expected
    assert bench.chip.register("r4") == DATA + moved


SINGLE = {name: row[0] for name, row in (LOADS | STORES).items()}


@pytest.mark.parametrize("code", **ids(SINGLE))
def test_unalign_trp_forbids_every_unaligned_access(code: str) -> None:
    bench = Strict(code, {"r4": DATA + 5, "r5": 2}, ccr=0x200 | UNALIGN_TRP)
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.stacked_pc) == (UNALIGNED, START)


def test_an_unaligned_access_to_a_peripheral_is_a_usage_fault() -> None:
    bench = Strict("2068", {"r4": GPIOA + 2})
    bench.run()
    assert bench.cfsr == UNALIGNED


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


def test_a_step_over_an_unaligned_load_ends_after_it() -> None:
    bench = Strict("2068 2068 0137", {"r4": DATA + 5})
    bench.chip.step()
    assert (bench.chip.register("pc"), bench.chip.register("r0")) == (START + 2, word(5))
    instructions = bench.chip.state.instructions
    bench.chip.step()
    assert bench.chip.register("pc") == START + 4
    assert bench.chip.state.instructions == instructions  # counted at the begin of their block


@pytest.mark.parametrize(("code", "kind"), [("2068", 3), ("2060", 2)], ids=["read", "written"])
def test_a_watchpoint_sees_an_unaligned_access(code: str, kind: int) -> None:
    bench = Strict(code, {"r4": DATA + 5})
    bench.chip.watch(kind, DATA + 8, 1, True)
    assert bench.chip.run(1680) & chip_module.Why.WATCHPOINT
    assert bench.chip.state.watch_address == DATA + 8


def test_masks_are_read_as_they_were_written() -> None:
    # movs r0, #0x5f; msr basepri, r0; mrs r1, basepri; movs r0, #0x70; msr basepri_max, r0; mrs r2, basepri_max
    # cpsid f; mrs r3, faultmask; cpsie f; mrs r4, faultmask
    bench = Strict("5f20 80f3 1188 eff3 1181 7020 80f3 1288 eff3 1282 71b6 eff3 1383 61b6 eff3 1384")
    assert bench.run() == 0
    assert [bench.chip.register(f"r{n}") for n in (1, 2, 3, 4)] == [0x50, 0x50, 1, 0]


ARMV8_M = {
    "lda r0, [r4]": "d4e8 af0f",
    "stl r0, [r4]": "c4e8 af0f",
    "tt r0, r4": "44e8 00f0",
    "vseleq.f32 s0, s0, s0": "00fe 000a",
    "vmaxnm.f32 s0, s0, s0": "80fe 000a",
    "vrintz.f32 s0, s0": "b6ee c00a",
}


@pytest.mark.parametrize("code", **ids(ARMV8_M))
def test_an_instruction_of_a_later_core_is_undefined(code: str) -> None:
    bench = Strict(code, {"r4": DATA})
    assert bench.run() == HARD_FAULT
    assert (bench.cfsr, bench.stacked_pc) == (UNDEFINED, START)


def test_an_unknown_unicorn_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chip_module, "CORTEX_M4_FEATURES", 0x1234_5678_9ABC_DEF0)
    with pytest.raises(LabError, match="this version of unicorn"):
        Bench()
