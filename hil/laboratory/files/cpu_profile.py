"""The files of `--profile-cpu OUT`: `OUT.txt` to read, `OUT.speedscope.json` for speedscope, `OUT.folded` for flame graphs.

The run folder gets `activations.parquet`, which `floaty fly --perfetto` draws beside the schedule: task, begin and end [us],
and own cycles of every activation.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from hil.board.board_firmware import ImageReport
from hil.board.image_firmware import ImageFirmware
from hil.emulator.stm32f405.chip import CYCLES_PER_US
from hil.emulator.stm32f405.cpu_profile import Calls, CpuProfile, Reader, TaskTimes, functions_of
from hil.errors import LabError, made_folder, writing
from hil.laboratory.files.whole_files import replacing, write_whole

OPTION = "--profile-cpu"
ACTIVATIONS = "activations.parquet"
SPEEDSCOPE, FOLDED, TEXT = ".speedscope.json", ".folded", ".txt"
SHOWN_FUNCTIONS, SHOWN_PARTS = 25, 6


@dataclass(frozen=True, slots=True)
class Profiler:
    """`ImageObserver` that charges the cycles of a flight and writes the files of OUT."""

    out: Path

    def begin(self, firmware: ImageFirmware) -> None:
        if not self.out.name or self.out.is_dir():
            raise LabError(f"{OPTION} {self.out}: a folder; expected the beginning of a file's name")
        made_folder(OPTION, self.out.parent)
        functions = functions_of(firmware.image)
        firmware.chip.profile([(one.address, one.address + one.size) for one in functions])

    def report(self, firmware: ImageFirmware, folder: Path) -> None:
        kernel = firmware.kernel
        profile = Reader(firmware.image, firmware.chip, kernel.task_names, kernel.ahead_us).read()
        write_profile(self.out, folder, profile, firmware.report())


def files_of(out: Path) -> tuple[Path, ...]:
    """Return the three files of OUT."""
    return tuple(out.with_name(out.name + ending) for ending in (TEXT, SPEEDSCOPE, FOLDED))


def write_profile(out: Path, folder: Path, profile: CpuProfile, image: ImageReport) -> None:
    """Write the files of OUT, and the activations into the run folder. Raises `LabError`."""
    text, speedscope, folded = files_of(out)
    with writing(OPTION, out):
        write_whole(text, "".join(f"{line}\n" for line in report(profile, image)))
        write_whole(speedscope, json.dumps(speedscope_of(profile, out.name)))
        write_whole(folded, "".join(f"{line}\n" for line in folded_of(profile)))
    columns = {
        "task": [one.name for one in profile.tasks for _ in one.cycles],
        "begin_us": _joined(profile.tasks, "begin_us"),
        "end_us": _joined(profile.tasks, "end_us"),
        "cycles": _joined(profile.tasks, "cycles"),
    }
    with replacing(folder / ACTIVATIONS) as partial:
        pa.parquet.write_table(pa.table(columns), partial, compression="zstd")


def _joined(tasks: tuple[TaskTimes, ...], name: str) -> Any:
    return np.concatenate([getattr(one, name) for one in tasks]) if tasks else np.zeros(0)


def folded_of(profile: CpuProfile) -> Iterator[str]:
    """Yield each stack with its cycles: task;function;function cycles."""
    for root in profile.roots:
        for stack, cycles in root.stacks():
            yield f"{';'.join(stack)} {cycles}"


def speedscope_of(profile: CpuProfile, name: str) -> dict[str, Any]:
    """Return the file of speedscope: a profile for each task and exception, weighed by cycles."""
    numbers: dict[str, int] = {}
    profiles = []
    for root in profile.roots:
        stacks = list(root.stacks())
        weights = [cycles for _, cycles in stacks]
        profiles.append(
            {
                "type": "sampled", "name": root.name, "unit": "none", "startValue": 0, "endValue": sum(weights),
                "samples": [[numbers.setdefault(one, len(numbers)) for one in stack] for stack, _ in stacks],
                "weights": weights,
            }
        )  # fmt: skip
    return {
        "$schema": "https://www.speedscope.app/file-format-schema.json",
        "name": name, "exporter": "floaty", "activeProfileIndex": 0,
        "shared": {"frames": [{"name": one} for one in numbers]}, "profiles": profiles,
    }  # fmt: skip


def report(profile: CpuProfile, image: ImageReport) -> Iterator[str]:
    """Yield the lines of the text."""
    total = profile.cycles
    yield f"{total} cycles of 168 MHz since power-on: {_ms(total)} ms"
    if profile.outside:
        yield f"{profile.outside} of them by an outside load"
    if profile.lost:
        yield f"incomplete: no room for {profile.lost} calls or activations"
    yield "\nTasks and exceptions, share of all cycles"
    for root in profile.roots:
        asleep = sum(cycles for stack, cycles in root.stacks() if stack[-1] == "(asleep)")
        yield f"  {root.name:<36}{_share(root.total, total)}{f'  asleep {_share(asleep, total)}' if asleep else ''}"
    yield "\nFunctions with the most cycles of their own, not asleep"
    own = _own_cycles(profile.roots)
    for name, cycles in sorted(own.items(), key=lambda one: -one[1])[:SHOWN_FUNCTIONS]:
        yield f"  {name:<36}{_share(cycles, total)}"
    yield "\nActivations of tasks, own time [us]; longest from begin to end [us], and when it began [s] (start: below 0)"
    yield f"  {'':<20}{'number':>9}{'50 %':>9}{'95 %':>9}{'99 %':>9}{'most':>9}{'longest':>10}{'at':>10}"
    for task in profile.tasks:
        parts = [*np.percentile(task.cycles, (50, 95, 99)), task.cycles.max()]
        shown = "".join(f"{part / CYCLES_PER_US:>9.1f}" for part in parts)
        yield (
            f"  {task.name:<20}{len(task.cycles):>9}{shown}{task.longest.us:>10.1f}"
            f"{task.longest.begin_us * 1e-6:>10.4f}"
        )
    yield "\nExceptions without those that interrupt them [us], and when the worst began [s]"
    yield f"  {'':<36}{'number':>9}{'50 %':>9}{'95 %':>9}{'99 %':>9}{'most':>9}{'at':>10}"
    for one in sorted(profile.handlers, key=lambda one: -one.cycles):
        shown = "".join(f"{part / CYCLES_PER_US:>9.1f}" for part in (*one.percentiles, one.worst))
        yield f"  {one.name:<36}{one.count:>9}{shown}{one.worst_us * 1e-6:>10.4f}"
    yield "\nLongest time with interrupts masked"
    for mask in profile.masked:
        yield (
            f"  by {mask.by}: {mask.cycles / CYCLES_PER_US:.1f} us at {mask.begin_us * 1e-6:.4f} s, in {mask.context}: "
            f"from {mask.begin} to {mask.end}"
        )
    if not profile.masked:
        yield "  never"
    yield from _memory(image.stack_free_bytes, image)
    for task in profile.tasks:
        yield from _longest(task)


def _own_cycles(roots: tuple[Calls, ...]) -> dict[str, int]:
    """Return the cycles of each function outside the functions that it calls."""
    own: dict[str, int] = {}
    left = list(roots)
    while left:
        one = left.pop()
        own[one.name] = own.get(one.name, 0) + one.cycles - one.asleep
        left.extend(one.children)
    return own


def _memory(stacks: Mapping[str, int], image: ImageReport) -> Iterator[str]:
    if stacks:
        yield "\nStacks, bytes that were never used"
        yield from (f"  {name:<20}{free:>9}" for name, free in sorted(stacks.items(), key=lambda one: one[1]))
    if image.heap_free_bytes is not None:
        yield f"\nHeap: {image.heap_free_bytes} bytes free at the end, {image.heap_least_free_bytes} when it was fullest"


def _longest(task: TaskTimes) -> Iterator[str]:
    one = task.longest
    yield (
        f"\n{task.name}, longest activation: {_ms(one.us * CYCLES_PER_US)} ms from {one.begin_us * 1e-6:.6f} s on, of which "
        f"{_ms(one.cycles)} ms its own"
    )
    for part in one.parts[:SHOWN_PARTS]:
        hottest = f", most at {part.hottest}" if part.hottest else ""
        called = f", called by {part.callers}" if part.callers else ""
        yield f"  {_ms(part.cycles):>9} ms  {part.name}{hottest}{called}"
    for name, cycles in one.others[:SHOWN_PARTS]:
        yield f"  {_ms(cycles):>9} ms  meanwhile {name}"


def _ms(cycles: float) -> str:
    return f"{cycles / CYCLES_PER_US / 1000:.4f}"


def _share(cycles: int, total: int) -> str:
    return f"{100.0 * cycles / total:7.2f} %"
