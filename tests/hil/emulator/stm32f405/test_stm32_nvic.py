"""The interrupt controller against a model of it: which exceptions run, in which order and nested how (B1.5, B3.4)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from struct import pack, unpack

import numpy as np
import pytest

pytest.importorskip("unicorn")

from hil.emulator.stm32f405.chip import FLASH, RAM, SOFTWARE
from support.stm32_bench import Bench

ISER, ISPR, ICPR, IABR, IPR = (0xE000_E000 + at for at in (0x100, 0x200, 0x280, 0x300, 0x400))
ICSR, VTOR, AIRCR, SHPR3, STIR = (0xE000_E000 + at for at in (0xD04, 0xD08, 0xD0C, 0xD20, 0xF00))
KEY, NO_REQUEST = 0x05FA << 16, 0x1FF
PENDSV, SYSTICK, FIRST, EXCEPTIONS = 14, 15, 16, 128
VECTORS, REQUESTS, LOG = RAM + 0x4000, RAM + 0x5000, RAM + 0x6000
# mrs r0, ipsr; ldr r1, [r4]; stm r7!, {r0, r1}; ldr r1, [r6, r0, lsl #2]; str r1, [r5]; b on; mrs r0, ipsr; stm r7!, {r0};
# bx lr
HANDLER = bytes.fromhex("eff30580 2168 03c7 56f82010 2960 ffe7 eff30580 01c7 7047")
SUPERVISOR_CALL = bytes.fromhex("00df")


class Logging(Bench):
    """A chip whose handlers log their numbers and what is at r4, request another interrupt, and log their number again."""

    def __init__(self) -> None:
        super().__init__(HANDLER + SUPERVISOR_CALL)

    def start(self, seen: int, requests: dict[int, int], calls: bool = False) -> None:
        self.chip.reset(SOFTWARE)
        self.chip.write(VECTORS, pack(f"<{EXCEPTIONS}I", *[(FLASH + 8) | 1] * EXCEPTIONS))
        self.chip.write(
            REQUESTS, pack(f"<{EXCEPTIONS}I", *(requests.get(one, NO_REQUEST) for one in range(EXCEPTIONS)))
        )
        self[VTOR] = VECTORS
        for name, value in (("r4", seen), ("r5", STIR), ("r6", REQUESTS), ("r7", LOG)):
            self.chip.set_register(name, value)
        self.chip.set_register("pc", FLASH + 8 + len(HANDLER) + (0 if calls else len(SUPERVISOR_CALL)))

    def log(self) -> list[int]:
        self.wait(1000)
        size = self.chip.register("r7") - LOG
        return list(unpack(f"<{size // 4}I", self.chip.read(LOG, size)))


@dataclass
class Model:
    """What the manual has, in the plainest form."""

    priority: list[int]
    group_bits: int  # PRIGROUP
    base: int
    primask: bool
    faultmask: bool
    enabled: set[int]
    pending: set[int]
    requests: dict[int, int]
    seen: Callable[["Model"], int]
    active: list[int] = field(default_factory=list)
    log: list[int] = field(default_factory=list)

    def group(self, priority: int) -> int:
        return priority - priority % 2 ** (self.group_bits + 1)

    def level(self) -> int:
        levels = [256, *(self.group(self.priority[one]) for one in self.active)]
        levels += [self.group(self.base)] * (self.base > 0) + [0] * self.primask + [-1] * self.faultmask
        return min(levels)

    def serve(self) -> None:
        while ready := self.pending & (self.enabled | {PENDSV, SYSTICK}):
            first = min(ready, key=lambda one: (self.priority[one], one))
            if self.group(self.priority[first]) >= self.level():
                return
            self.pending.remove(first)
            self.active.append(first)
            self.log += [first, self.seen(self)]
            if first in self.requests:
                self.pending.add(FIRST + self.requests[first])
            self.serve()
            self.log.append(self.active.pop())


def bits(numbers: set[int], word: int) -> int:
    return sum(1 << one - FIRST - 32 * word for one in numbers if 0 <= one - FIRST - 32 * word < 32)


def icsr(model: Model) -> int:
    return model.active[-1] | (PENDSV in model.pending) << 28 | (SYSTICK in model.pending) << 26


def test_exceptions_run_in_the_order_and_nested_as_in_a_model() -> None:
    bench, rng = Logging(), np.random.default_rng(5)
    nested = 0
    for _ in range(150):
        raw = [int(word) for word in rng.integers(0, 1 << 32, EXCEPTIONS // 4)]
        priority = [byte & 0xF0 for byte in pack(f"<{EXCEPTIONS // 4}I", *raw)]
        enabled, pending = (
            {FIRST + int(one) for one in rng.choice(112, size, replace=False)} for size in (80, 12)
        )
        others = {PENDSV, SYSTICK} if rng.random() < 0.5 else {int(rng.choice((PENDSV, SYSTICK)))}
        up = rng.random() < 0.5  # one way: no chain of requests comes back to its begin
        requests = {
            one: int(rng.integers(one - FIRST + 1, 112) if up else rng.integers(0, one - FIRST))
            for one in rng.choice(np.arange(FIRST + 1, EXCEPTIONS - 1), 60, replace=False).tolist()
        }
        group_bits, base = int(rng.integers(8)), int(rng.choice((0, 0, 0, 0x50, 0xB0)))
        primask, faultmask = (bool(rng.random() < 0.08) for _ in range(2))
        word = int(rng.integers(5))
        at = (
            (IABR + 4 * word, lambda one, word=word: bits(set(one.active), word))
            if word < 4
            else (ICSR, icsr)
        )
        model = Model(
            priority, group_bits, base, primask, faultmask, enabled, pending | others, requests, at[1]
        )
        bench.start(at[0], requests)
        bench[AIRCR] = KEY | group_bits << 8
        bench[AIRCR] = 0x700  # without the key
        assert bench[AIRCR] == 0xFA05 << 16 | group_bits << 8
        for place, value in enumerate(raw):
            bench[SHPR3 - 12 + 4 * place if place < 4 else IPR + 4 * (place - 4)] = value
        bench.chip.set_register("basepri", base)
        bench.chip.set_register("primask", int(primask))
        bench.chip.set_register("faultmask", int(faultmask))
        for one in range(4):  # more than these, and some of them taken back
            rest = int(rng.integers(0, 1 << 32))
            for begin, numbers in ((ISER, enabled), (ISPR, pending)):
                bench[begin + 4 * one] = rest | bits(numbers, one)
                bench[begin + 0x80 + 4 * one] = ~bits(numbers, one) & 0xFFFF_FFFF
                assert bench[begin + 4 * one] == bench[begin + 0x80 + 4 * one] == bits(numbers, one)
        bench[ICSR] = 1 << 28 | 1 << 26
        bench[ICSR] = (PENDSV not in others) << 27 | (SYSTICK not in others) << 25
        model.serve()
        log = bench.log()
        assert log == model.log
        assert [bench[ISPR + 4 * one] for one in range(4)] == [bits(model.pending, one) for one in range(4)]
        assert [bench[IABR + 4 * one] for one in range(4)] == [0] * 4
        nested += any(a != b for a, b in zip(log[0::3], log[2::3], strict=True))
    assert nested > 30


# Requests: every line is the sum of its flags that are enabled, while they last.

USART_AT = {1: (0x4001_1000, 37), 2: (0x4000_4400, 38), 3: (0x4000_4800, 39), 4: (0x4000_4C00, 52), 5: (0x4000_5000, 53),
            6: (0x4001_1400, 71)}  # fmt: skip
SPI_AT = {1: (0x4001_3000, 35), 2: (0x4000_3800, 36), 3: (0x4000_3C00, 51)}
I2C_AT = {1: (0x4000_5400, 31), 2: (0x4000_5800, 33), 3: (0x4000_5C00, 72)}


def requested(bench: Bench) -> set[int]:
    """Return the interrupts that are pending again once all were cleared: their requests go on."""
    for word in range(4):
        bench[ICPR + 4 * word] = 0xFFFF_FFFF
    return {irq for irq in range(112) if bench.is_pending(irq)}


@pytest.mark.long
@pytest.mark.parametrize("number", USART_AT)
def test_a_usart_requests_while_an_enabled_flag_is_set(number: int) -> None:
    base, irq = USART_AT[number]
    control = 1 << 13 | 12  # enabled, both directions
    for fed, written, flags in (
        (0, 0, 0xC0),
        (0, 1, 0x80),
        (0, 2, 0),
        (1, 0, 0xE0),
        (2, 0, 0xE8),
        (2, 0, 0xC8),
    ):
        bench = Bench()
        bench[base + 8], bench[base + 12] = 84, control
        bench.chip.feed(number, bytes(fed))
        bench.wait(50)
        for _ in range(written):
            bench[base + 4] = 0
        if flags == 0xC8:
            bench[base] = ~0x20 & 0xFFFF_FFFF  # RXNE is cleared, the overrun stays
        assert bench[base] == flags
        for enabled in range(0, 0x100, 0x20):
            bench[base + 12] = control | enabled
            wanted = enabled & flags & 0xE0 or (enabled & 0x20 and flags & 8)
            assert requested(bench) == ({irq} if wanted else set())
    bench[base + 12] = control | 0x20
    assert (requested(bench), bench[base + 4], requested(bench)) == ({irq}, 0, set())


@pytest.mark.long
@pytest.mark.parametrize("number", SPI_AT)
def test_a_spi_requests_while_an_enabled_flag_is_set(number: int) -> None:
    base, irq = SPI_AT[number]
    for written, us, flags in ((0, 0, 2), (2, 0, 0x80), (1, 50, 3), (2, 50, 0x43)):
        bench = Bench()
        bench[base] = 1 << 2 | 1 << 6 | 5 << 3
        for _ in range(written):
            bench[base + 12] = 0
        bench.wait(us)
        assert bench[base + 8] == flags
        for enabled in range(0, 0x100, 0x20):  # ERRIE, RXNEIE, TXEIE
            bench[base + 4] = enabled
            wanted = enabled & (0x20 * (flags >> 6 & 1) | 0x40 * (flags & 1) | 0x80 * (flags >> 1 & 1))
            assert requested(bench) == ({irq} if wanted else set())
    bench[base + 4] = 0x60
    assert (requested(bench), bench[base + 12], requested(bench)) == ({irq}, 0xFF, set())


@pytest.mark.long
@pytest.mark.parametrize("number", I2C_AT)
def test_an_i2c_controller_requests_events_and_errors_while_an_enabled_flag_is_set(number: int) -> None:
    base, irq = I2C_AT[number]
    bench = Bench()
    bench.chip.add_device(number, 0x50, np.zeros(256, np.uint8))
    bench[base + 0x1C], bench[base] = 35, 1

    def begin(byte: int) -> None:
        bench[base] = 1 << 8 | 1
        bench.until(base + 0x14, 1)
        bench[base + 0x10] = byte

    def judge(flags: int) -> None:
        assert bench[base + 0x14] == flags
        for enabled in range(8):  # ITERREN, ITEVTEN, ITBUFEN
            bench[base + 4] = enabled << 8
            events = enabled & 2 and (flags & 7 or (enabled & 4 and flags & 0xC0))
            errors = enabled & 1 and flags & 0x400
            assert requested(bench) == {one for one, wanted in ((irq, events), (irq + 1, errors)) if wanted}

    judge(0)
    bench[base] = 1 << 8 | 1
    bench.wait(100)
    judge(1)  # SB
    bench[base + 0x10] = 0x50 << 1
    bench.wait(100)
    judge(2)  # ADDR
    bench[base + 4] = 2 << 8
    assert (requested(bench), bench[base + 0x18], requested(bench)) == ({irq}, 7, set())
    judge(0x80)  # TXE
    bench[base + 0x10] = 0
    bench.wait(100)
    judge(0x84)  # and BTF
    begin(0x50 << 1 | 1)
    bench.wait(100)
    bench[base + 0x18]
    bench.wait(100)
    judge(0x40)  # RXNE
    bench[base + 4] = 6 << 8
    assert (requested(bench), bench[base + 0x10], requested(bench)) == ({irq}, 0, set())
    bench[base] = 1 << 9 | 1
    bench.wait(100)
    bench[base + 0x10]
    begin(0x51 << 1)
    bench.wait(100)
    judge(0x400)  # AF


def test_a_handler_runs_again_while_its_request_goes_on() -> None:
    bench = Logging()
    bench.start(IABR, {})
    bench[USART_AT[6][0] + 12] = 1 << 13 | 1 << 7  # TXE of a USART that sends nothing
    bench[ISER + 8] = 1 << 71 - 64
    bench.wait(10)
    times = (bench.chip.register("r7") - LOG) // 12
    assert 20 < times < 60
    assert bench.chip.read(LOG, 12 * (times - 1)) == pack("<3I", 87, 0, 87) * (times - 1)


@pytest.mark.parametrize("number", [112, 127, 0x100, NO_REQUEST])
def test_a_trigger_of_an_interrupt_that_does_not_exist_changes_nothing(number: int) -> None:
    bench = Bench()
    bench[STIR] = number
    assert [bench[place + 4 * word] for place in (ISPR, IABR) for word in range(4)] == [0] * 8


def profiled(code: str) -> Bench:
    """A chip whose cycles are charged to a function from FLASH + 8 on."""
    bench = Bench(bytes.fromhex(code))
    bench.chip.profile([(FLASH + 8, FLASH + 64)])
    return bench


def test_a_handler_s_time_leaves_out_those_that_interrupt_it_and_its_worst_has_an_instant() -> None:
    """Exception 17 is interrupted by 18 each third time."""
    bench, begins = Logging(), []
    bench.start(IABR, {})
    bench.chip.profile([(FLASH + 8, FLASH + 64)])
    bench[ISER], bench[IPR] = 6, 0x10 << 16 | 0x20 << 8
    for one in range(9):
        bench.wait(40)
        bench.chip.write(REQUESTS + 4 * 17, pack("<I", 2 if one % 3 == 2 else NO_REQUEST))
        begins.append(bench.chip.state.now)
        bench[ISPR] = 2
    bench.wait(40)
    profile = bench.chip.profiled()
    outer, inner = profile.service[17], profile.service[18]
    assert (outer.count, inner.count) == (9, 3)
    own, longer = inner.cycles // 3, inner.cycles // 3 + 3  # the return to it is one more jump
    assert (inner.worst, inner.when - begins[2]) == (own, pytest.approx(20, abs=12))
    assert (outer.cycles, outer.worst, outer.when) == (6 * own + 3 * longer, longer, begins[2])
    octave = own.bit_length() - 1
    assert {at: outer.bin[at] for at in range(256) if outer.bin[at]} == {
        (octave - 3) * 8 + (own >> octave - 3 & 7): 9
    }
    assert profile.total[33 + 17] == outer.cycles
    assert sum(profile.total) == bench.chip.state.now


@pytest.mark.parametrize(("register", "kind"), [("10", 0), ("11", 1), ("13", 0)])
def test_a_reset_ends_what_was_masked(register: str, kind: int) -> None:
    bench = profiled(
        f"80f3 {register}88 ffe7 00bf ffe7"
    )  # msr primask, basepri or faultmask, r0; b on; nop; b on
    bench.chip.set_register("r0", 0xF1)
    bench.wait(10)
    assert bench.chip.profiled().masked[kind].cycles == 0
    bench.chip.reset(SOFTWARE)
    bench.wait(10)
    assert bench.chip.profiled().masked[kind].cycles == 0


@pytest.mark.parametrize(("register", "kind"), [("10", 0), ("11", 1), ("13", 0)])
def test_the_longest_time_with_interrupts_masked_is_kept_with_its_places(register: str, kind: int) -> None:
    """Twenty instructions, then thirty, then ten."""
    mask, unmask = f"80f3 {register}88", f"81f3 {register}88"  # msr, r0 or r1
    bench = profiled("".join(mask + "00bf" * length + unmask for length in (20, 30, 10)))
    bench.chip.set_register("r0", 0xF1)
    begin = bench.chip.state.now
    bench.wait(10)
    longest = bench.chip.profiled().masked[kind]
    assert longest.cycles == pytest.approx(32, abs=2)
    assert longest.when - begin == pytest.approx(4 + 20 + 4 + 4, abs=6)
    assert (longest.begin, longest.end) == (8 + 48 + 4, 8 + 48 + 68)
    assert longest.root == 32  # what runs before all tasks
    assert bench.chip.profiled().masked[1 - kind].cycles == 0


def test_processor_time_belongs_to_the_task_that_the_last_switch_has_chosen() -> None:
    """Forty tasks, of which the last nine share a place; the outside chooses the next one, and whether it is ready.

    The first one begins by a supervisor call.
    """
    bench, rng = Logging(), np.random.default_rng(3)
    bench.start(IABR, {}, calls=True)
    current, blocks, ready = RAM + 0x100, [RAM + 0x8000 + 0x40 * one for one in range(40)], RAM + 0x200
    state = bench.chip.state
    state.kernel.current_place, state.kernel.stack_offset, state.kernel.container_offset = current, 0x30, 0x14
    state.kernel.ready_begin, state.kernel.ready_end, state.tracing = ready, ready + 40, 1
    for block in blocks:
        bench[block + 0x14] = ready
    expected: dict[int, dict[str, int]] = {}
    order: list[int] = []
    running = -1
    for one in (*range(40), *rng.integers(0, 40, 120).tolist()):
        container = int(rng.choice((ready, ready + 20, ready + 40, ready - 20)))
        if running >= 0:
            bench[blocks[min(running, 31)] + 0x14] = container
        bench[current] = blocks[one]
        bench[ICSR] = (running >= 0) << 28
        before = state.now
        bench.wait(int(rng.integers(1, 30)))
        if one == min(running, 31):
            assert state.switch_count == len(order)
            continue
        place, now = min(one, 31), state.task_switch[len(order)].now
        order.append(blocks[one])
        assert before < now < before + 168
        if running >= 0:
            last = expected[min(running, 31)]
            last["cycles"] += now - last["since"]
            last["ran"] = now
            if container not in (ready, ready + 20):
                last["busy"] = 0
        mine = expected.setdefault(place, {"cycles": 0, "times": 0, "busy": 0, "ran": 0})
        mine["since"], mine["times"] = now, mine["times"] + 1
        mine["busy"] = mine["busy"] or now
        running = one
    assert [state.task_switch[at].block for at in range(state.switch_count)] == order
    assert (state.task_count, state.running) == (32, min(running, 31))
    for place, mine in expected.items():
        task = state.task[place]
        found = {"cycles": task.cycles, "times": task.times, "busy": task.busy_since, "ran": task.ran}
        assert found == {name: mine[name] for name in found}, place
    bench.chip.reset(SOFTWARE)
    assert not any(state.task[place].busy_since for place in range(32))
    assert [state.task[place].cycles for place in expected] == [mine["cycles"] for mine in expected.values()]


def test_time_that_an_outside_load_takes_is_charged_to_nobody() -> None:
    bench = profiled("")
    for us in (5, 7, 3):
        bench.chip.state.owed += us * 168
        bench.wait(20)
    profile, state = bench.chip.profiled(), bench.chip.state
    assert (state.owed, state.taken) == (0, 15 * 168)
    assert sum(profile.total) == state.now - state.taken == 45 * 168


def test_no_activation_of_a_task_goes_on_over_a_reset() -> None:
    bench, (current, first, second, ready) = Logging(), (RAM + 0x100, RAM + 0x8000, RAM + 0x8040, RAM + 0x200)
    state = bench.chip.state

    def switch(block: int) -> None:
        bench[current], bench[ICSR] = block, 1 << 28
        bench.wait(5)

    for _ in range(2):
        bench.start(IABR, {})
        begin = state.now
        bench[first + 0x14] = bench[second + 0x14] = ready
        state.kernel.current_place, state.kernel.stack_offset, state.kernel.container_offset = (
            current,
            0x30,
            0x14,
        )
        state.kernel.ready_begin, state.kernel.ready_end = ready, ready + 20
        if not state.profile:
            bench.chip.profile([(FLASH + 8, FLASH + 64)])
        for block in (first, second, first, second):
            switch(block)
    bench[second + 0x14] = 0  # both wait now
    switch(first)
    bench[first + 0x14] = 0
    switch(second)
    log = bench.chip.profiled().log
    ended = [(log[at].task, log[at].begin >= begin) for at in range(bench.chip.profiled().logged)]
    assert ended == [(1, True), (0, True)]
