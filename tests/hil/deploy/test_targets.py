"""What the machine code of a check costs: per tick, per entry point and in memory, over all its flights."""

from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest

from firmware_py.config import LogicConfig, parameters_of
from firmware_py.core_runner import CoreBlocks, PlainRunner
from firmware_py.export.usage import EntryLoad
from firmware_py.logic.loading import load_logic
from hil.board.cores.cortex_m4 import CortexM4Runner
from hil.config import load_config
from hil.deploy import targets
from hil.deploy.targets import CORTEX_M4, TARGETS, TICK_HZ, Toolbox, target_names

TICK = ("file_pose", "file_pose", "estimate", "supervise", "control")


def test_every_cycle_after_the_first_tick_belongs_to_one_tick_and_flights_add_up() -> None:
    """The first tick contains the boot. A flight of few calls needs less stack than the one before."""
    config, logic = load_config(), load_logic(LogicConfig())
    box = Toolbox([CORTEX_M4], LogicConfig())
    used = box.machine_code
    assert used is not None
    instructions = cycles = stack = 0
    worst = [0, 0]
    calls: dict[str, int] = {}
    for flight in (
        (("reset", *TICK), TICK, ("estimate", "control"), TICK),
        (("reset", "control"), ("control",)),
    ):
        with ExitStack() as flown:
            runner = CoreBlocks(parameters_of(config), box.factories(flown)[CORTEX_M4], logic).run
            assert isinstance(runner, CortexM4Runner)
            before = 0, 0
            for number, tick in enumerate(flight):
                for name in tick:
                    runner.call(name)
                    calls[name] = calls.get(name, 0) + 1
                now = tuple(
                    sum(getattr(one, unit) for one in runner.load.values())
                    for unit in ("instructions", "cycles")
                )
                spent, before = [end - begin for begin, end in zip(before, now, strict=True)], now
                if number:
                    instructions, cycles = instructions + spent[0], cycles + spent[1]
                    worst = [max(pair) for pair in zip(worst, spent, strict=True)]
            stack = max(stack, runner.stack_bytes)
            ram = runner.ram_bytes
    ticks = used.ticks
    assert (ticks.calls, ticks.instructions, ticks.cycles) == (4, instructions, cycles)
    assert [ticks.worst_instructions, ticks.worst_cycles] == worst
    assert used.loads == pytest.approx((cycles / 4 / 168e6 * TICK_HZ, worst[1] / 168e6 * TICK_HZ))
    assert (used.ram_bytes, used.stack_bytes) == (ram, stack)
    assert stack > runner.stack_bytes
    assert {name: load.calls for name, load in used.entries.items() if load.calls} == calls


def test_targets_are_named_once_each_with_or_without_spaces() -> None:
    assert target_names("plain, c-O2 ,plain,udp://127.0.0.1:9") == ("plain", "c-O2", "udp://127.0.0.1:9")
    assert target_names(None) == TARGETS


@pytest.mark.long
def test_c_is_built_with_the_optimisation_that_its_target_names(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []
    monkeypatch.setattr(
        targets, "build", lambda c, optimisation: built.append(optimisation) or Path(optimisation)
    )
    box = Toolbox(["c-O0", "c-O2", "plain"], LogicConfig())
    assert built == ["-O0", "-O2"]
    with ExitStack() as flown:
        factories = box.factories(flown)
    assert {name: one.keywords["library"].name for name, one in factories.items() if name != "plain"} == {  # type: ignore[attr-defined]
        "c-O0": "-O0", "c-O2": "-O2"}  # fmt: skip
    assert (factories["plain"], box.machine_code) == (PlainRunner, None)


@pytest.mark.long
def test_a_board_behind_a_link_is_opened_for_each_flight_and_its_cycles_add_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened: list[tuple[object, ...]] = []
    monkeypatch.setattr(targets, "open_real_core", lambda *how: opened.append(how) or how[0])
    load = {"control": EntryLoad(2, 100, 300, 70, 200)}
    monkeypatch.setattr(
        targets, "RealCore", lambda blocks, client: SimpleNamespace(to=(blocks, client), load=load)
    )
    uris = ("udp://127.0.0.1:9", "udp://127.0.0.1:10")
    box, blocks = Toolbox((*uris, "plain"), LogicConfig()), object()
    for flights in (1, 2):
        with ExitStack() as flown:
            factories = box.factories(flown)
            assert opened[-2:] == [(uri, "--targets", flown) for uri in uris]
            assert factories[uris[0]](blocks).to == (blocks, uris[0])  # type: ignore[arg-type, attr-defined]
        assert {uri: {name: one.calls for name, one in loads.items()} for uri, loads in box.boards.items()} == {
            uris[0]: {"control": 2 * flights}, uris[1]: {},
        }  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("elf", "flash"), [(None, 5), (Path("cf2.elf"), None)])
def test_a_core_that_is_part_of_a_firmware_has_no_flash_of_its_own(
    monkeypatch: pytest.MonkeyPatch, elf: Path | None, flash: int | None
) -> None:
    monkeypatch.setattr(targets, "build_machine", lambda: Path("machine"))
    monkeypatch.setattr(targets, "read_image", lambda elf, whole: SimpleNamespace(code=b"123"))
    monkeypatch.setattr(targets, "build_image", lambda source, header: SimpleNamespace(code=b"12345"))
    code = Toolbox((CORTEX_M4,), LogicConfig(), elf=elf).machine_code
    assert code is not None
    assert code.flash_bytes == flash
