"""A whole board with the tests' own firmware, which goes wrong: what is reported once, after each reset, and not at all."""

import re
from types import SimpleNamespace as Made

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from firmware_py.export.elf import Symbol
from hil.emulator.crazyflie import crazyflie, radio_line
from hil.emulator.stm32f405.chip import SOFTWARE, WATCHDOG, StopReason
from hil.emulator.stm32f405.image import Image
from hil.emulator.stm32f405.stopped_tasks import SETTLED_US, StoppedTask
from support.crazyflie_board import Board, image
from support.stm32_firmware import PLACE

(
    NOTHING, BUS_FAULT, UNDEFINED, ASSERTION, HUNGRY_WATCHDOG, NULL_CALL, NULL_READ, NULL_WRITE, DIVISION, HANG, OVERFLOW,
) = range(11)  # fmt: skip
IN_REPORT = r", in task REPORT: go_wrong \(firmware.c:\d+\) < report \(firmware.c:\d+\)"
BUSY = (
    r"hang: busy for 10 ms without waiting for anything, in task SPIN-0: .*"  # that it is, from its start on
)


@pytest.mark.long
@pytest.mark.parametrize(("planted", "line"), [
    (BUS_FAULT, f"HardFault: access to where there is no memory at 0x30000000{IN_REPORT}"),
    (UNDEFINED, f"HardFault: undefined instruction{IN_REPORT}"),
    (NULL_CALL, r"HardFault: jump to an even address: not Thumb code, in task REPORT: 0x00000000, .* < go_wrong .*"),
])  # fmt: skip
def test_a_fault_is_a_failure_once_and_what_kept_other_tasks_from_running_comes_first(
    planted: int, line: str
) -> None:
    board = Board(planted)
    handler = image().symbol("Stuck_Handler").address
    board.crazyflie.chip.write(handler, b"\xfe\xe7")  # b . : a loop of one instruction
    said = board.run(0, 60)
    assert [bool(re.fullmatch(pattern, text)) for pattern, text in zip((BUSY, line), said, strict=True)] == [
        True
    ] * 2
    assert board.crazyflie.failures == said
    assert board.run(60, 120) == []
    assert board.crazyflie.resets == {WATCHDOG: 0, SOFTWARE: 0}


def test_each_assertion_and_its_reset_are_reported_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    board = Board(ASSERTION)
    said = board.run(0, 60)
    failed = r"assertion how != ASSERTION failed at firmware.c:\d+" + IN_REPORT
    by_itself = r"reset by software, in task REPORT: assertFail .* < go_wrong .* < report .*"
    expected = (BUSY, failed, by_itself) * 5
    assert [bool(re.fullmatch(pattern, text)) for pattern, text in zip(expected, said, strict=True)] == [
        True
    ] * 15
    assert board.crazyflie.resets == {WATCHDOG: 0, SOFTWARE: 5}
    watch = board.crazyflie._watch
    assert watch is not None
    assert 50_000 < watch._from_us - SETTLED_US < 60_000  # from the last reset on
    assert board.crazyflie.failures == said


def test_a_watchdog_that_nobody_feeds_resets_and_names_who_ran_each_time() -> None:
    board = Board(HANG)
    said = board.run(0, 450)
    hang = r"hang: busy for 201 ms without waiting for anything, in task REPORT: hang \(firmware.c:\d+\) < go_wrong .*"
    reset = r"watchdog reset: nobody fed it in time; this ran then, in task REPORT: hang \(.*"
    expected = (hang, reset) * 2
    assert [bool(re.fullmatch(pattern, text)) for pattern, text in zip(expected, said, strict=True)] == [
        True
    ] * 4
    assert board.crazyflie.resets == {WATCHDOG: 2, SOFTWARE: 0}


@pytest.mark.long
@pytest.mark.parametrize(("planted", "line"), [
    (NULL_READ, f"null pointer: read at 0x00000008, where the chip has its flash again; .*{IN_REPORT}"),
    (NULL_WRITE, f"null pointer: write to 0x0000000c, which has no effect and causes no fault{IN_REPORT}"),
    (DIVISION, f"division by zero: its result is 0; no fault follows, .*{IN_REPORT}"),
])  # fmt: skip
def test_what_has_no_effect_is_reported_once_and_is_no_failure(planted: int, line: str) -> None:
    board = Board(planted)
    (said,) = board.run(0, 60)
    assert re.fullmatch(line, said)
    assert (board.crazyflie.failures, board.crazyflie.known) == ([], [])


@pytest.mark.long
def test_a_mistake_that_bitcraze_s_firmware_is_known_for_is_kept_and_not_printed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for known, printed in (({("go_wrong", 0x0C)}, False), ({("go_wrong", 0x08)}, True), ({("report", 0x0C)}, False),
                           ({("ledInit", 0x0C)}, True)):  # fmt: skip
        monkeypatch.setattr(crazyflie, "KNOWN_WRITES", known)
        board = Board(NULL_WRITE)
        assert len(board.run(0, 15)) == printed
        assert len(board.crazyflie.known) == (not printed)


def test_a_stack_that_overflows_is_the_first_failure() -> None:
    board = Board(OVERFLOW)
    assert re.fullmatch(r"stack overflow, in task REPORT: dig \(.*", board.run(0, 15)[0])
    assert board.crazyflie.failures[0] == board.said[0]


def test_outputs_are_told_when_one_has_changed_and_a_missing_peripheral_once() -> None:
    board = Board()
    assert board.run(0, 100) == []
    assert len(board.counts) > 5
    assert all(before != after for before, after in zip(board.counts, board.counts[1:], strict=False))
    assert all(1000 <= first < 2000 and second == 0 for first, second in board.counts[1:])
    state = board.crazyflie.chip.state
    for address in (0x4001_2000, 0x4000_5401):
        state.unknown[state.unknown_count] = address
        state.unknown_count += 1
        board.crazyflie.report_unknown()
        board.crazyflie.report_unknown()
    assert board.said == [
        "the image uses a peripheral that is not modelled, at 0x40012000: it reads as 0",
        "the image uses a peripheral whose clock is off (RCC), at 0x40005400: it reads as 0 and keeps nothing",
    ]


def test_a_task_that_hangs_or_stopped_is_reported_once_and_nothing_after_a_crash(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    board = Board()
    own, reported = board.crazyflie, list[object]()
    stopped = StoppedTask(0x2000_0100, 70_000, 1_000, "waits")
    looked: list[int] = []

    def busy(least_us: int) -> tuple[int, int]:
        looked.append(least_us)
        return 0x2000_0200 if len(looked) < 3 else 0x2000_0300, 211_000

    monkeypatch.setattr(own.processor, "longest_busy", busy)
    monkeypatch.setattr(own, "_watch", Made(newly_stopped=lambda: [stopped] if len(looked) == 1 else []))
    monkeypatch.setattr(
        own, "_crashes", Made(hang=lambda *of: ("hang", *of), stopped=lambda *of: ("stopped", *of))
    )
    monkeypatch.setattr(own, "_report", reported.append)
    for _ in range(3):
        own._look_at_tasks(10_000)
    own._crashed = True
    own._look_at_tasks(10_000)
    assert looked == [10_000] * 3
    assert reported == [
        ("hang", 0x2000_0200, 211_000), ("stopped", 0x2000_0100, 70_000, 1_000, "waits"), ("hang", 0x2000_0300, 211_000),
    ]  # fmt: skip


@pytest.mark.parametrize(("planted", "polled"), [(NOTHING, [*range(16, 41, 2)]), (ASSERTION, [])])
def test_a_host_finds_a_board_a_while_after_its_last_reset(
    monkeypatch: pytest.MonkeyPatch, planted: int, polled: list[int]
) -> None:
    """A failed assertion resets every 11 ms."""
    monkeypatch.setattr(radio_line, "GATE_US", 15_000)
    board, fed = Board(planted, polls=True), list[int]()
    chip = board.crazyflie.chip
    monkeypatch.setattr(chip, "feed", lambda usart, data: fed.append(chip.now_us // 1000))
    board.run(0, 40)
    assert board.crazyflie.resets[SOFTWARE] == (0 if polled else 3)
    assert fed == polled


def test_a_lock_up_is_a_failure_once_and_nothing_is_looked_for_behind_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(crazyflie, "HANG_US", 50_000)  # less than the 70 ms from it to the next look
    board = Board(BUS_FAULT)
    board.crazyflie.chip.write(image().base + 4 * 3, b"\1\0\0\x30")  # the HardFault's handler is nowhere
    (said,) = board.run(0, 30)
    assert re.match(
        r"lock-up, no fault handler could run: .* at 0x30000000, in exception 3 \(Stuck_Handler\)", said
    )
    assert board.run(30, 180) == []
    assert (board.crazyflie.failures, board.crazyflie.resets) == ([said], {WATCHDOG: 0, SOFTWARE: 0})


def test_a_busy_task_that_loses_its_stack_is_reported_and_then_the_fault() -> None:
    board, end_ms, running = Board(), 30, 0
    own = board.crazyflie
    board.run(0, end_ms)
    while own.processor.longest_busy(5_000) is None or running != own.processor.longest_busy(5_000)[0]:  # type: ignore[index]
        board.run(end_ms, end_ms + 1)
        end_ms += 1
        running = 0 if own.chip.register("xpsr") & 0x1FF else own.processor.current.block
    own.chip.set_register("sp", 0x3000_0000)
    own.chip.pin("C", 14, True)  # an interrupt, whose frame has no memory
    hang, fault = board.run(end_ms, end_ms + 20)
    assert re.fullmatch(r"hang: busy for \d\d ms without waiting for anything, in task SPIN-[01]", hang)
    assert re.fullmatch(
        r"HardFault: no memory .* while entering an exception; .*, 0x30000000, in task SPIN-[01]", fault
    )


def test_two_causes_at_once_are_one_reset_by_the_watchdog() -> None:
    board = Board()
    board.run(0, 10)
    board.crazyflie._act(StopReason.WATCHDOG | StopReason.RESET)
    assert board.crazyflie.resets == {WATCHDOG: 1, SOFTWARE: 0}
    assert [line.partition(":")[0] for line in board.said] == ["hang", "watchdog reset"]
    assert board.crazyflie.chip.resets == 2, "that of power-on, and this one"


def test_the_firmwares_own_clock_counts_its_timers_overflows() -> None:
    board, own = Board(), image()
    assert board.crazyflie.clock_us is None
    known = Image(own.path)
    known._variables["usecTimerHighCount"] = [Symbol("usecTimerHighCount", PLACE, 4, False, True)]
    board = Board(own=known)
    board.run(0, 20)
    for high in (0, 3):
        board.crazyflie.chip.write(PLACE, high.to_bytes(4, "little"))
        count = int.from_bytes(board.crazyflie.chip.read(0x4000_1424, 4), "little")
        assert 0 < count < 1 << 16
        assert board.crazyflie.clock_us == (high << 16) + count
