"""`floaty deploy check`: equal targets are called equal, a bit that differs is found where and when it differs."""

import re
import shutil
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from firmware_py.core import structs
from firmware_py.core_runner import CoreBlocks, CoreRunner, NativeRunner, RunnerFactory, default_runner
from firmware_py.export.c99 import translate
from firmware_py.logic.plugs import CALLS
from firmware_py.wire.supervisor import Cause, State
from hil.board.board_firmware import PythonBoard
from hil.commands.deploy import _print_flight, _print_sum
from hil.deploy import check
from hil.deploy.check import Checked, check_flight, plan, reached
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request
from support.command import Cli

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose builds the tests share."""
    return tmp_path_factory.mktemp("built")


class Spoilt(NativeRunner):
    """Python with one word that is wrong from one call on."""

    def __init__(self, blocks: CoreBlocks, call: str, tick: int, spoil: Callable[[CoreBlocks], None]) -> None:
        super().__init__(blocks)
        self._spoilt = (call, tick, lambda: spoil(blocks))
        self._tick = 0

    def _done(self, name: str) -> None:
        call, tick, spoil = self._spoilt
        if (call, tick) == (name, self._tick):
            spoil()

    def call(self, name: str) -> int:
        answer = super().call(name)
        self._tick += name == "estimate"
        self._done(name)
        return answer


def fly_beside(factory: RunnerFactory) -> Checked:
    [request] = plan("hover", False, seed=3, duration_s=0.5)
    return check_flight(request, lambda stack: {"spoilt": factory}, lambda now_us, flight: None)


def one_ulp(values: np.ndarray, index: tuple[int, ...]) -> None:
    values[index] = np.nextafter(values[index], np.float32(np.inf))


@pytest.mark.long
@pytest.mark.parametrize(
    ("call", "tick", "spoil", "struct", "field", "bits"),
    [
        ("estimate", 37, lambda blocks: one_ulp(blocks.estimator.fields.P, (3, 4)), "Estimator", "P[3,4]", None),
        ("control", 101, lambda blocks: one_ulp(blocks.control.fields.u, (2,)), "Control", "u[2]", None),
        ("control", 0, lambda blocks: blocks.control.fields.count.__setitem__(1, 0), "Control", "count[1]", None),
        ("estimate", 1, lambda blocks: blocks.estimator.fields.x.__setitem__(5, -0.0), "Estimator", "x[5]", 1),
        ("estimate", 64, lambda blocks: setattr(blocks.estimator.fields, "fused", -1), "Estimator", "fused", None),
        ("control", 9, lambda blocks: setattr(blocks.parameters.fields, "gain_z", 0.0), "Parameters", "gain_z", None),
    ],
)  # fmt: skip
def test_the_first_difference_is_reported_with_its_tick_call_and_word(
    call: str, tick: int, spoil: Callable[[CoreBlocks], None], struct: str, field: str, bits: int | None
) -> None:
    [target] = fly_beside(lambda blocks: Spoilt(blocks, call, tick, spoil)).targets
    found = target.divergence
    assert found is not None
    assert (found.tick, found.call, found.where) == (tick, call, struct)
    assert [one.field for one in found.differences] == [field]
    if bits is not None:
        assert found.differences[0].bits == bits


def test_after_a_flight_the_controller_is_watched_a_second_later_and_the_core_starts_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also of a flight that was interrupted; not of one whose board has ended."""
    called: list[tuple[str, int]] = []
    fields = SimpleNamespace(now_us=0)

    class Beside:
        def __init__(self, blocks: Any, targets: Any) -> None:
            self.blocks, self.targets, self.reached = blocks, targets, ()

        def call(self, name: str) -> None:
            called.append((name, fields.now_us))

    def flight(request: Request, executor: PythonBoard) -> Any:
        executor.runner(SimpleNamespace(data=SimpleNamespace(fields=fields)))  # type: ignore[arg-type]
        return SimpleNamespace(run=lambda progress: ends.pop(), close=lambda: called.append(("close", 0)))

    monkeypatch.setattr(check, "SideBySide", Beside)
    monkeypatch.setattr(check, "lockstep_flight", flight)
    request = Request.of(EXPERIMENTS["hover"])
    ends = [SimpleNamespace(interrupted=False, lost="fell"), SimpleNamespace(interrupted=True, lost=None)]
    for outcome, now_us in (("interrupted", 7), ("lost: fell", 9)):
        called.clear()
        fields.now_us = now_us
        found = check_flight(request, lambda stack: {}, lambda *_: None)
        later_us = now_us + 1_000_000
        assert called == [("watch_control", later_us), ("restart", later_us), ("close", 0)]
        assert found.outcome == outcome


def test_a_differing_target_is_found() -> None:
    class Late(NativeRunner):
        def call(self, name: str) -> int:
            return super().call(name) + (name == "file_pose")

    found = fly_beside(Late).targets[0].divergence
    assert found is not None
    assert (found.call, found.where) == ("file_pose", "answer")
    assert found.differences[0].values == (0, 1)


@pytest.mark.long
def test_a_target_that_has_differed_does_not_hide_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    def factories(stack: ExitStack) -> dict[str, RunnerFactory]:
        def spoil(blocks: CoreBlocks) -> None:
            blocks.control.fields.count[0] += 1

        def spoilt(blocks: CoreBlocks) -> CoreRunner:
            return Spoilt(blocks, "control", 20, spoil)

        return {"spoilt": spoilt, "python": default_runner}

    [request] = plan("hover", False, seed=3, duration_s=0.5)
    checked = check_flight(request, factories, lambda now_us, flight: None)
    assert [target.ticks for target in checked.targets] == [20, 150]
    assert not checked.equal
    assert checked.targets[1].divergence is None
    assert Cause.NO_CONTROL in {cause for _, cause in checked.reached}, "after the last step"
    _print_sum([checked, checked], True)
    assert capsys.readouterr().out.startswith("40 ticks, c beside spoilt, python: spoilt DIFFERS\n")
    _print_flight(checked)
    calls = checked.targets[1].calls
    assert capsys.readouterr().out.endswith(f"\n  python        150 ticks {calls:>7} calls  equal\n")


def test_states_and_causes_that_flights_reached_are_told_from_those_that_none_did() -> None:
    one = frozenset({(State.CALIBRATING, Cause.NONE), (State.FAILSAFE, Cause.OUT_OF_BOUNDS)})
    other = frozenset({(State.FLYING, Cause.NONE), (State.FAILSAFE, Cause.SILENCE)})
    seen, missed = reached(
        [Checked(plan("hover", False)[0], "completed", (), pairs) for pairs in (one, other)]
    )
    words = {cause.name.lower().replace("_", " ") for cause in Cause} - {"none"}
    assert seen.split(", ")[:3] == ["calibrating", "flying", "failsafe"]
    assert set(seen.split(", ")[3:]) == {"silence", "out of bounds"}
    assert set(missed.split(", ")) == {"waiting", *words} - {"silence", "out of bounds"}


@pytest.mark.long
def test_default_flights_are_ten_thousand_ticks_with_every_fault_in_time() -> None:
    flights: list[Request] = plan(None, False)
    assert [(one.experiment.name, bool(one.faults)) for one in flights] == [
        ("hover", False), ("yaw-step", False), ("hover", True), ("supervisor", True), ("failing-logic", False),
    ]  # fmt: skip
    assert sum(one.duration_s + one.config.flight.release_us * 1e-6 for one in flights) >= 100.0
    for duration_s, faults in ((2.0, ()), (2.01, ("mocap.dropout@2:0.5=1",))):
        short = plan(None, False, duration_s=duration_s)
        assert [one.duration_s for one in short[:3]] == [duration_s] * 3
        assert short[2].faults == faults
    every = plan(None, True)
    assert [one.duration_s for one in every[: len(EXPERIMENTS)]] == [
        min(one.duration_s, 60.0) for one in EXPERIMENTS.values()
    ]


@pytest.mark.long
def test_another_robot_flies_with_the_faults_that_act_on_it() -> None:
    floaty, other = plan(None, False), plan(None, False, overrides=("robot.body=robot.py",))
    assert set(floaty[2].faults) - set(other[2].faults) == {"servo.slow.2@42:4=0.5"}


@pytest.mark.long
def test_the_check_reaches_every_state_and_cause_of_the_core_and_every_entry_point() -> None:
    called: set[str] = set()

    class Noting(NativeRunner):
        def call(self, name: str) -> int:
            called.add(name)
            return super().call(name)

    def flown(request: Request) -> Checked:
        return check_flight(request, lambda stack: {"noting": Noting}, lambda now_us, flight: None)

    checked = [flown(request) for request in plan(None, False)[-2:]]
    values = {
        kind: {value for name, value in vars(structs).items() if name.startswith(kind)}
        for kind in ("STATE_", "CAUSE_")
    }
    pairs = {pair for one in checked for pair in one.reached}
    assert [{int(pair[place]) for pair in pairs} for place in (0, 1)] == [values["STATE_"], values["CAUSE_"]]
    assert reached(checked)[1] == ""
    assert reached(checked[:1])[1] == "controller not finite, estimator not finite"
    assert called == CALLS.keys()


@pytest.mark.parametrize(
    ("own_logic", "profile"),
    [(False, "floaty"), (True, "lqr")],
    ids=["targets without it", "a profile with it"],
)
def test_logic_that_fails_is_flown_where_targets_are_built_for_it(own_logic: bool, profile: str) -> None:
    assert plan(None, False, own_logic, profile=profile)[-1].experiment.name == "supervisor"


SOMETHING_OF_EACH = ("--duration", "0.8", "--fault", "mocap.latency@0.2:0.4=150", "--fault", "push.y@0.4=2")


@pytest.mark.long
def test_ten_thousand_ticks_are_bit_identical(cli: Cli, monkeypatch: pytest.MonkeyPatch, built: Path) -> None:
    monkeypatch.chdir(built)
    assert cli("deploy", "check", "--targets", "c-O2") == 0
    sums = re.search(r"^(\d+) ticks, .*: no bit differs$", cli.out, re.MULTILINE)
    assert int(sums[1]) >= 10_000
    assert "supervisor: reached calibrating, waiting, flying, failsafe, silence, " in cli.out
    assert "; not" not in cli.out


class Watch(NativeRunner):
    """Python that notes the tick in which the counter of late poses first moves."""

    first: ClassVar[list[int]] = []

    def __init__(self, blocks: CoreBlocks) -> None:
        super().__init__(blocks)
        self._fields = blocks.estimator.fields

    def call(self, name: str) -> int:
        answer = super().call(name)
        if self._fields.too_old == 1 and not self.first:
            self.first.append(int(self._fields.tick))
        return answer


@pytest.mark.long
@pytest.mark.parametrize("target", ["c-O2", "cortex-m4"])
def test_changed_operator_is_found(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, built: Path, target: str
) -> None:
    monkeypatch.chdir(built)
    text = translate().source
    right, wrong = (
        "estimator->too_old = estimator->too_old + 1;",
        "estimator->too_old = estimator->too_old - 1;",
    )
    assert text.count(right) == 1
    Path("changed.c").write_text(text.replace(right, wrong), encoding="utf-8")
    options = ("--targets", target, "--source", "changed.c")
    assert cli("deploy", "check", "hover", *SOMETHING_OF_EACH, *options) == 1
    shown = cli.out
    [request] = plan("hover", False, duration_s=0.8, faults=SOMETHING_OF_EACH[3::2])
    Watch.first.clear()
    flight = lockstep_flight(request, executor=PythonBoard(Watch))
    flight.run()
    [tick] = Watch.first
    assert tick > 100
    assert f"tick {tick}, after file_pose: Estimator.too_old: 1 00000001 | -1 ffffffff (31 bits)" in shown
    assert f"{target} DIFFERS" in shown
    assert "only a core with own logic has the guard" in shown


@pytest.mark.long
def test_code_outside_its_memory_is_exit_1(cli: Cli, monkeypatch: pytest.MonkeyPatch, built: Path) -> None:
    monkeypatch.chdir(built)
    text, right = translate().source, "const int32_t row = estimator->tick % FLOATY_HISTORY;"
    assert text.count(right) == 1
    wild = "const int32_t row = estimator->tick == 23 ? 0x8000000 : estimator->tick % FLOATY_HISTORY;"
    Path("wild.c").write_text(text.replace(right, wild), encoding="utf-8")
    options = ("--duration", "0.1", "--targets", "cortex-m4", "--source", "wild.c")
    assert cli("deploy", "check", "hover", *options) == 1
    assert "tick 23, in estimate: " in cli.out
    assert ": access to where there is no memory at 0x" in cli.out


FIRMWARE = """
#include "floaty_core.h"
int main(void);
__attribute__((section(".vectors"), used)) const void *vectors[] = {(void *)0x20020000, (void *)main};
static FloatyParameters parameters;
static FloatyInput data;
static FloatyEstimator estimator;
static FloatyControl control;
static FloatySampling sampling;
static FloatySupervisor supervisor;
static FloatyReport report;
int calls = 7;
int main(void) {
    floaty_core_reset(&parameters, &estimator);
    for (;;) {
        calls += floaty_core_file_pose(&parameters, &data, &estimator, &sampling, &supervisor);
        floaty_core_estimate(&parameters, &data, &estimator, &control, &sampling, &report);
        calls += floaty_core_begin_step(&data, &sampling) + floaty_core_take_sample(&data, &sampling);
        calls += floaty_core_supervise(&parameters, &data, &estimator, &sampling, &supervisor);
        calls += floaty_core_request(&parameters, &data, &sampling, &supervisor);
        calls += floaty_core_admits(&parameters, &data) + floaty_core_follow(&parameters, &data);
        calls += floaty_core_watch_control(&data, &supervisor);
        floaty_core_restart(&data, &sampling, &supervisor);
        floaty_core_control(&parameters, &data, &estimator, &control);
    }
}
"""
MAP = """
ENTRY(main)
SECTIONS {
    . = 0x08004000;
    .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) }
    . = 0x20000000;
    .data : { *(.data*) *(.bss*) *(COMMON) }
    /DISCARD/ : { *(.ARM.exidx*) *(.ARM.attributes) *(.comment) }
}
"""
# Those of the Crazyflie's firmware; they would let gcc fuse multiplications with additions.
CRAZYFLIE_FLAGS = (
    "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-std=gnu11", "-Os", "-g", "-Wall", "-Werror",
    "-Wdouble-promotion", "-fno-math-errno", "-fno-strict-aliasing", "-ffunction-sections", "-fdata-sections",
)  # fmt: skip


@pytest.mark.skipif(shutil.which("arm-none-eabi-gcc") is None, reason="needs Debian's gcc-arm-none-eabi")
@pytest.mark.parametrize(
    ("right", "wrong", "code"), [("", "", 0), ("word * COUNT_1MS", "word + COUNT_1MS", 1)]
)
@pytest.mark.long
def test_the_core_inside_a_linked_firmware_is_checked(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, built: Path, right: str, wrong: str, code: int
) -> None:
    monkeypatch.chdir(built)
    core = translate()
    assert right in core.source
    texts = {"main.c": FIRMWARE, "map.ld": MAP, "floaty_core.h": core.header}
    texts["floaty_core.c"] = core.source.replace(right, wrong) if right else core.source
    for name, text in texts.items():
        Path(name).write_text(text, encoding="utf-8")
    link = ("-nostartfiles", "-Wl,--gc-sections", "-T", "map.ld", "-o", "cf2.elf", "main.c", "floaty_core.c")
    subprocess.run(["arm-none-eabi-gcc", *CRAZYFLIE_FLAGS, *link], check=True, timeout=60)
    options = ("--duration", "0.5", "--targets", "cortex-m4", "--elf", "cf2.elf")
    assert cli("deploy", "check", "yaw-step", *options) == code
    shown = cli.out
    if code:
        assert "tick 0, after control: Control.count[0]" in shown
    else:
        assert "150 ticks, c beside cortex-m4: no bit differs" in shown


@pytest.mark.long
def test_c_that_does_not_compile_is_one_line_and_exit_code_two(cli: Cli) -> None:
    Path("broken.c").write_text("int x = ;\n", encoding="utf-8")
    cli.refusal("deploy", "check", "hover", "--targets", "c-O2", "--source", "broken.c")


@pytest.mark.long
def test_the_exported_app_holds_the_c_that_is_checked(cli: Cli) -> None:
    assert cli("deploy", "write", "app", "--profile", "as-flown") == 0
    shown = [Path(line) for line in cli.out.splitlines()]
    assert {path for path in Path("app").rglob("*") if path.is_file()} == set(shown)
    assert Path("app/src/floaty_core.c").read_text(encoding="utf-8") == translate().source
    assert Path("app/Makefile") in shown


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["app", "--profile", "flaoty"], "did you mean floaty?"),
        (["app", "--set", "controller.gain_z=nan"], "controller.gain_z = nan"),
        (["other"], "other: "),
        ([], "Missing argument"),
    ],
)
def test_bad_input_of_export_is_one_line_and_exit_two(cli: Cli, arguments: list[str], message: str) -> None:
    Path("other").mkdir()
    Path("other/thesis.tex").write_text("mine", encoding="utf-8")
    assert message in cli.refusal("deploy", "write", *arguments)
    assert [path.name for path in Path("other").iterdir()] == ["thesis.tex"]
    assert not Path("app").exists()
