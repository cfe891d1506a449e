"""The budget of a call of own logic: loops that exceed it are refused, or stopped alike on every target."""

import re
from collections.abc import Callable
from pathlib import Path
from textwrap import indent
from typing import Any

import pytest

from firmware_py.config import parameters_of
from firmware_py.core.budget import CALL_CYCLES, LoopBudget, begin_call, charged_end
from firmware_py.core.structs import MODE_FLY
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks
from firmware_py.logic.budget import CLOCK_MHZ
from firmware_py.logic.loading import load_logic
from hil.board.cores.boards import BOARDS, runner_of
from hil.board.cores.cortex_m4 import CortexM4Runner
from hil.config import LabConfig
from hil.errors import LabError
from support.own_logic import ESTIMATOR, LAW, own_config
from support.paths import ROOT

IN_LAW = "    memory.ticks = i32(memory.ticks + 1)\n"
SLOT_MS = 4


def law(body: str, before: str = "") -> str:
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    return LAW.replace(IN_LAW, IN_LAW + lines).replace(
        "\n\n@kernel\ndef reset_law", f"\n\n{before}@kernel\ndef reset_law"
    )


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


Make = Callable[..., CoreBlocks]


@pytest.fixture
def blocks_of(tmp_path: Path) -> Make:
    """Return the memory of a core with own logic in flight, and what executes it on a board."""

    def make(text: str, board: str = "c", estimator: str = "") -> CoreBlocks:
        config = own_config(tmp_path, text, estimator)
        runner = runner_of(board, config.logic)
        blocks = CoreBlocks(parameters_of(config), runner, load_logic(config.logic))
        blocks.data.fields.mode = MODE_FLY
        return blocks

    return make


def overrun(blocks: CoreBlocks) -> str:
    assert blocks.logic is not None
    return blocks.logic.overrun(blocks.named)


def test_the_budget_is_the_part_of_the_control_slot_that_the_pages_state() -> None:
    assert CALL_CYCLES == SLOT_MS * 1000 * CLOCK_MHZ
    page = (ROOT / "docs" / "howto" / "own-logic.md").read_text(encoding="utf-8")
    assert f"{CALL_CYCLES:,}".replace(",", " ") in page


SUM = "for i in range({}):\n    memory.hidden = memory.hidden + DT"


@pytest.mark.long
@pytest.mark.parametrize(
    ("body", "before", "at"),
    [
        (SUM.format("2000000000"), "", "    for i in range(2000000000)"),
        (SUM.format("LONG"), "LONG = 2000000000\n\n\n", "    for i in range(LONG)"),
        (SUM.format("i32(2000000000)"), "", "    for i in range(i32"),
        (SUM.format("-2000000000, 4"), "", "    for i in range(-2000000000"),
        ("for k in range(2000):\n    for i in range(2000):\n        memory.hidden = DT", "", "    for k in"),
        ("for k in range(2000):\n    for i in range(k):\n        memory.hidden = DT", "", "    for k in"),
        (
            "if memory.ticks == 0:\n    " + SUM.format("2000000").replace("\n", "\n    "),
            "",
            "        for i in",
        ),
        (SUM.format("100000"), "", ""),
    ],
)
def test_a_known_loop_beyond_the_budget_is_refused(tmp_path: Path, body: str, before: str, at: str) -> None:
    text = law(body, before)
    if not at:
        load_logic(own_config(tmp_path, text).logic)
        return
    with pytest.raises(LabError) as error:
        own_config(tmp_path, text)
    assert str(error.value).startswith(f"{tmp_path / 'controller.py'}:{line_of(text, at)}: for ")
    assert str(error.value).endswith(": a call has 672000 (4 ms of a Cortex-M4): write a part for each tick")


@pytest.mark.long
def test_a_call_of_exactly_the_budget_is_admitted_and_one_more_cycle_is_not(tmp_path: Path) -> None:
    longest, one = (
        CALL_CYCLES // 5,
        "memory.hidden = memory.hidden + DT\n",
    )  # 5 cycles of a round, 1 of it alone
    with pytest.raises(LabError, match=r": for i in range"):
        own_config(tmp_path, law(SUM.format(longest + 1)))
    with pytest.raises(LabError, match=r": control_law takes at least (\d+) cycles") as beyond:
        own_config(tmp_path, law(SUM.format(longest)))
    found = re.search(r"at least (\d+)", str(beyond.value))
    assert found
    rest = int(found[1]) - CALL_CYCLES
    rounds = longest - -(-rest // 5)
    body = one * (5 * (longest - rounds) - rest) + SUM.format(rounds)
    own_config(tmp_path, law(body))
    with pytest.raises(LabError, match=f"control_law takes at least {CALL_CYCLES + 1} cycles"):
        own_config(tmp_path, law(one + body))


@pytest.mark.long
def test_a_call_costs_four_cycles_more_than_what_it_calls(tmp_path: Path) -> None:
    add = "memory.hidden = memory.hidden + DT"
    helper = f"@kernel\ndef step(memory: Memory) -> None:\n    {add}\n\n\n"
    cycles = []
    for one in (add, "step(memory)"):
        text = law(f"{one}\n{SUM.format(CALL_CYCLES // 5)}").replace("@kernel\n", f"{helper}@kernel\n", 1)
        with pytest.raises(LabError, match=r": control_law takes at least \d+ cycles") as beyond:
            own_config(tmp_path, text)
        found = re.search(r"at least (\d+)", str(beyond.value))
        assert found
        cycles.append(int(found[1]))
    assert cycles[1] - cycles[0] == 4


def test_loops_that_fit_alone_but_not_together_are_refused_where_the_function_begins(tmp_path: Path) -> None:
    text = law("\n".join([SUM.format("100000"), SUM.format("100000").replace(" i ", " k ")]))
    with pytest.raises(LabError, match=rf"py:{line_of(text, 'def control_law')}: control_law takes at least"):
        own_config(tmp_path, text)


SLOW = dict.fromkeys(("c", "cortex-m4"), pytest.mark.long)  # all but python, which compiles nothing
EVERY = [pytest.param(board, marks=SLOW.get(board, ())) for board in BOARDS]
# Forms of loops: the law's lines, and a value of `after` with which they do not exceed the budget.
FORMS = [
    (SUM.format("own.after"), 3),
    (SUM.format("-5, own.after"), 3),
    (SUM.format("i32(memory.ticks - 2000000000), own.after"), None),
    ("n = i32(own.after + 1000)\nfor k in range(1000):\n" + indent(SUM.format("n"), "    "), None),
    ("memory.hidden = total(own.after)", 100),
    ("fill(memory, own)", 1000),
]
TOTAL = """@kernel
def total(n: i32) -> f32:
    y = ZERO
    for i in range(n):
        y = y + DT
    return y


"""
FILL = """@kernel
def fill(  # of several lines
    memory: Memory,
    own: Gains,
) -> None:
    for i in range(
        own.after  # in all
    ):
        memory.hidden = sqrt(memory.hidden + DT)


"""


@pytest.fixture(scope="module")
def forms(tmp_path_factory: pytest.TempPathFactory) -> LabConfig:
    """A law with every form, of which `memory.ticks` chooses one."""
    parts = [
        f"{'el' if row else ''}if memory.ticks == {row}:\n{indent(form, '    ')}"
        for row, (form, _) in enumerate(FORMS)
    ]
    text = law("\n".join(parts), TOTAL + FILL).replace("high=1000000)", "high=2000000000)")
    return own_config(tmp_path_factory.mktemp("forms"), text)


@pytest.mark.parametrize("board", EVERY)
@pytest.mark.parametrize(("form", "harmless"), FORMS, ids=[form.split("\n")[0] for form, _ in FORMS])
def test_a_data_dependent_loop_stops_equally_on_every_target(
    forms: LabConfig, board: str, form: str, harmless: int | None
) -> None:
    blocks = CoreBlocks(parameters_of(forms), runner_of(board, forms.logic), load_logic(forms.logic))
    blocks.data.fields.mode = MODE_FLY
    own: Any = blocks.named["controller_own"].fields
    memory: Any = blocks.named["controller_memory"].fields
    budget: Any = blocks.named["controller_loop_budget"].fields
    guard = blocks.named["guard"].fields
    row = FORMS.index((form, harmless))

    def call(after: int) -> None:
        own.after, memory.ticks = after, row - 1  # the law counts first
        blocks.run.call("control")

    if harmless is not None:
        call(harmless)
        assert (guard.controller_faults, overrun(blocks)) == (0, "")
    call(2000000000)
    assert guard.controller_faults == 1
    hover = float(blocks.parameters.fields.hover_angle)
    assert blocks.control.fields.flap.tolist() == pytest.approx([hover, -hover, hover, -hover])
    assert blocks.control.fields.u.tolist() == [0.0] * 4
    assert 0 < budget.cycles <= CALL_CYCLES
    text = Path(forms.logic.controller).read_text(encoding="utf-8")
    kernel = re.search(r"\b(total|fill)\(", form)
    start = text.index(f"def {kernel[0]}" if kernel else f"if memory.ticks == {row}:")
    line = text.count("\n", 0, text.index("for i in range", start)) + 1
    where = f"controller.py:{line}: the loop up to {budget.end} exceeds the 672000 cycles of a call"
    assert overrun(blocks).endswith(where)
    if harmless is not None:
        call(harmless)
        assert (guard.controller_faults, overrun(blocks)[-len(where) :]) == (1, where)


@pytest.mark.parametrize("start", [0, 3, -3, -9, -(2**31)])
def test_a_loop_fits_to_the_last_cycle_and_the_first_that_does_not_is_named(start: int) -> None:
    budget = LoopBudget.allocate().fields
    begin_call(budget, i32(CALL_CYCLES - 70))
    assert charged_end(budget, i32(start), i32(start + 7), i32(10), i32(11)) == start + 7
    assert (budget.cycles, budget.exceeded, budget.line) == (CALL_CYCLES, 0, 0)
    for line, cycles in ((12, 69), (13, 0)):
        begin_call(budget, i32(CALL_CYCLES - cycles))
        assert charged_end(budget, i32(start), i32(start + line - 5), i32(10), i32(line)) == start
        assert (budget.exceeded, budget.line, budget.end) == (1, 12, start + 7)


@pytest.mark.long
@pytest.mark.parametrize("board", EVERY)
def test_an_estimator_that_exceeds_its_budget_has_no_estimate(blocks_of: Make, board: str) -> None:
    old = "    memory.ticks = i32(memory.ticks + 1)\n"
    text = ESTIMATOR.replace(
        old, f"{old}    for i in range(memory.ticks * 20000):\n        memory.nothing = f32(0.0)\n"
    )
    blocks = blocks_of(LAW, board, text)
    guard = blocks.named["guard"].fields
    blocks.run.call("reset")
    while not guard.estimator_faults:
        blocks.run.call("estimate")
    place = f"estimator.py:{line_of(text, '    for i in')}"
    budget: Any = blocks.named["estimator_loop_budget"].fields
    assert 60000 <= budget.end <= 140000
    assert overrun(blocks).endswith(
        f"{place}: the loop up to {budget.end} exceeds the 672000 cycles of a call"
    )
    assert guard.estimator_faults == 1
    assert blocks.estimator.fields.now[0] == 0.0


def test_a_call_with_a_loop_in_an_expression_is_refused(tmp_path: Path) -> None:
    text = law("memory.hidden = ZERO + total(own.after)", TOTAL)
    with pytest.raises(
        LabError, match=r"total has a loop whose length depends on data: write x = total\(\.\.\) on a line"
    ):
        own_config(tmp_path, text)


@pytest.mark.long
def test_logic_without_such_loops_flies_as_it_is_written(blocks_of: Make) -> None:
    blocks = blocks_of(law(SUM.format("100000")), estimator=ESTIMATOR)
    assert blocks.logic is not None
    assert "charged" not in blocks.logic.loaded.translation.source
    assert not any("budget" in name for name in blocks.named)


@pytest.mark.long
@pytest.mark.parametrize(("form", "before"), [(FORMS[0][0], ""), (FORMS[5][0], FILL)])
def test_the_cycles_counted_are_at_most_those_of_the_machine_code(
    blocks_of: Make, form: str, before: str
) -> None:
    blocks = blocks_of(law(form, before), "cortex-m4")
    own: Any = blocks.named["controller_own"].fields
    budget: Any = blocks.named["controller_loop_budget"].fields
    assert isinstance(blocks.run, CortexM4Runner)
    taken = []
    for steps in (10, 10010):
        own.after = steps
        blocks.run.call("control")
        taken.append((int(budget.cycles), blocks.run.load["control"].worst_cycles))
    counted, measured = (taken[1][index] - taken[0][index] for index in (0, 1))
    assert counted <= measured <= 5 * counted
