"""The files of a processor profile and of coverage from values written by hand, and the instants of `floaty debug`."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from hil.emulator.stm32f405.cpu_profile import (
    Calls,
    CpuProfile,
    HandlerTimes,
    Longest,
    Masked,
    Part,
    TaskTimes,
)
from hil.errors import LabError
from hil.laboratory.experiment import unknown
from hil.laboratory.experiments.position import HOVER
from hil.laboratory.files import coverage, cpu_profile, debugging
from hil.laboratory.files.coverage import Executed, add_executed, base_of, check_coverage, read_executed
from hil.laboratory.files.cpu_profile import Profiler, files_of, write_profile
from hil.laboratory.files.debugging import begin_us
from hil.laboratory.request import Bench, Request

US = 168  # cycles
MS = 1000 * US
LEAF = Calls("filter", 30 * MS, 0, 5, ())
IDLE = Calls("IDLE", 0, 0, 0, (Calls("wait", 50 * MS, 40 * MS, 3, ()), Calls("filter", 9 * MS, 0, 1, ())))
TASK = Calls("KALMAN", 11 * MS, 0, 0, (LEAF,))
PARTS = tuple(Part(f"part {n}", (9 - n) * MS, "a.c:7", "main (b.c:1)") for n in range(8))
TIMES = TaskTimes(
    "KALMAN", np.array([-5.0, 2_000.0]), np.array([4.0, 2_040.0]), np.array([1 * US, 9 * US]),
    Longest(2_000.0, 40.0, 9 * US, PARTS, (("SysTick", MS),)),
)  # fmt: skip
PROFILE = CpuProfile(
    100 * MS, 0, 0, (IDLE, TASK), (TIMES,),
    (
        HandlerTimes("rare", 1, 5 * US, 5 * US, 250_000.0, (1 * US, 2 * US, 3 * US)),
        HandlerTimes("often", 9, 90 * US, 20 * US, 1.0, (US,) * 3),
    ),
    (Masked("BASEPRI", 7 * US, 500_000.0, "from.c", "to.c", "KALMAN"),),
)  # fmt: skip
IMAGE: Any = SimpleNamespace(
    stack_free_bytes={"IDLE": 400, "KALMAN": 20}, heap_free_bytes=900, heap_least_free_bytes=300
)


def test_a_profile_names_every_share_once_and_the_greatest_first(tmp_path: Path) -> None:
    write_profile(tmp_path / "out", tmp_path, PROFILE, IMAGE)
    text, speedscope, folded = files_of(tmp_path / "out")
    lines = [" ".join(line.split()) for line in text.read_text().splitlines()]
    after = {lines[n - 1] if line else "": lines[n:] for n, line in enumerate(lines)}
    assert lines[0] == "16800000 cycles of 168 MHz since power-on: 100.0000 ms"
    assert lines[3:5] == ["IDLE 59.00 % asleep 40.00 %", "KALMAN 41.00 %"]
    assert after["Functions with the most cycles of their own, not asleep"][:4] == [
        "filter 39.00 %", "KALMAN 11.00 %", "wait 10.00 %", "IDLE 0.00 %",
    ]  # fmt: skip
    assert "KALMAN 2 5.0 8.6 8.9 9.0 40.0 0.0020" in lines
    assert [line for line in lines if line.startswith(("rare", "often"))] == [
        "often 9 1.0 1.0 1.0 20.0 0.0000", "rare 1 1.0 2.0 3.0 5.0 0.2500",
    ]  # fmt: skip
    assert "by BASEPRI: 7.0 us at 0.5000 s, in KALMAN: from from.c to to.c" in lines
    assert after["Stacks, bytes that were never used"][:2] == ["KALMAN 20", "IDLE 400"]
    assert "Heap: 900 bytes free at the end, 300 when it was fullest" in lines
    assert "KALMAN, longest activation: 0.0400 ms from 0.002000 s on, of which 0.0090 ms its own" in lines
    assert [line for line in lines if "part " in line] == [
        f"{9 - n}.0000 ms part {n}, most at a.c:7, called by main (b.c:1)" for n in range(6)
    ]
    assert lines[-1] == "1.0000 ms meanwhile SysTick"
    assert folded.read_text().splitlines() == [
        f"IDLE;wait {10 * MS}", f"IDLE;wait;(asleep) {40 * MS}", f"IDLE;filter {9 * MS}", f"KALMAN {11 * MS}",
        f"KALMAN;filter {30 * MS}",
    ]  # fmt: skip
    shown = json.loads(speedscope.read_text())
    names = [one["name"] for one in shown["shared"]["frames"]]
    drawn = [
        (one["name"], one["endValue"], [[names[n] for n in stack] for stack in one["samples"]])
        for one in shown["profiles"]
    ]
    assert drawn == [
        ("IDLE", 59 * MS, [["IDLE", "wait"], ["IDLE", "wait", "(asleep)"], ["IDLE", "filter"]]),
        ("KALMAN", 41 * MS, [["KALMAN"], ["KALMAN", "filter"]]),
    ]
    table = pq.read_table(tmp_path / "activations.parquet").to_pydict()
    assert table == {
        "task": ["KALMAN"] * 2, "begin_us": [-5.0, 2_000.0], "end_us": [4.0, 2_040.0], "cycles": [US, 9 * US],
    }  # fmt: skip


def test_a_profile_is_of_every_byte_of_every_function_and_read_at_the_flight_s_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    functions = [SimpleNamespace(address=0x100, size=4), SimpleNamespace(address=0x108, size=0x20)]
    charged: list[tuple[int, int]] = []
    written: list[Any] = []
    monkeypatch.setattr(cpu_profile, "functions_of", {"image": functions}.get)
    monkeypatch.setattr(cpu_profile, "Reader", lambda *given: SimpleNamespace(read=lambda: given))
    monkeypatch.setattr(cpu_profile, "write_profile", lambda *given: written.append(given))
    chip, kernel = SimpleNamespace(profile=charged.extend), SimpleNamespace(task_names="names", ahead_us=7)
    firmware: Any = SimpleNamespace(image="image", chip=chip, kernel=kernel, report=lambda: IMAGE)
    profiler = Profiler(tmp_path / "new" / "out")
    profiler.begin(firmware)
    assert charged == [(0x100, 0x104), (0x108, 0x128)]
    assert profiler.out.parent.is_dir()
    profiler.report(firmware, tmp_path)
    assert written == [(profiler.out, tmp_path, ("image", chip, "names", 7), IMAGE)]
    for folder in (tmp_path, Path()):
        with pytest.raises(LabError, match=f"^--profile-cpu {folder}: a folder; expected the beginning"):
            Profiler(folder).begin(firmware)


def test_the_counts_of_flights_add_up_beyond_32_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "cov.v1"
    (tmp_path / "cov.v1.counts").touch()  # of a process that was killed
    counts = np.zeros((2**19 + 1, 3), np.uint64)
    counts[[0, 7, -1]] = (1, 2, 3), (2**32 - 1, 0, 5), (0, 0, 9)
    for flights, names in ((1, None), (2, Path("names")), (3, None)):
        check_coverage(out, "image")
        add_executed(out, Executed("image", 2, counts, "board", names))
        found = read_executed(out)
        assert (found.board, found.elf) == (str(tmp_path / "board"), names and tmp_path / "names"), (
            "from anywhere"
        )
        assert (found.flights, (found.counts == flights * counts).all()) == (2 * flights, True)
    assert [base_of(tmp_path / name).name for name in ("a", "a.info", "a.v1", "a.v1.info")] == [
        "a",
        "a",
        "a.v1",
        "a.v1",
    ]
    with pytest.raises(LabError, match="has the coverage of another image"):
        check_coverage(out, "other")


def test_a_flight_adds_its_counts_to_the_file_that_is_there_when_it_has_the_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it waits for the lock of the first file, another flight puts a second one in its place."""
    one = Executed("image", 1, np.eye(2**19 + 1, 3, dtype=np.uint64), "board", None)
    out, kept = tmp_path / "cov", tmp_path / "cov.counts"
    add_executed(out, one)
    locked: list[Any] = []

    def lock(file: Any, how: int) -> None:
        locked.append(file)
        if len(locked) == 1:
            shutil.copy(kept, tmp_path / "second")
            (tmp_path / "second").replace(kept)

    monkeypatch.setattr("fcntl.flock", lock)
    monkeypatch.setattr(coverage, "_read", lambda path, file: locked.append(file) or one)
    add_executed(out, one)
    assert len(locked) == 3
    assert locked[2] is locked[1]


def test_a_flight_is_debugged_from_before_its_crash_or_a_time(tmp_path: Path) -> None:
    texts = [
        (1_000_000, "board", "lost: no"),
        (4_000_000, "lab", "lost: floor"),
        (6_000_000, "image", "hard fault"),
    ]
    events = [json.dumps({"t_us": t_us, "source": source, "text": text}) for t_us, source, text in texts]
    (tmp_path / "events.jsonl").write_text("\n".join(events) + "\n")
    crashed: Any = SimpleNamespace(folder=tmp_path, failures=("hard fault",))
    lost: Any = SimpleNamespace(folder=tmp_path, failures=())
    assert [begin_us(one, "crash", 0.25) for one in (crashed, lost)] == [5_750_000, 3_750_000]
    assert [begin_us(lost, at, 0.5) for at in ("0", "2.5", "999999")] == [
        -500_000,
        2_000_000,
        999_998_500_000,
    ]
    for at in ("-0.1", "1e6", "nan", "soon"):
        with pytest.raises(LabError, match=f"--at {at}: expected crash, or a time"):
            begin_us(lost, at, 0.5)
    (tmp_path / "events.jsonl").unlink()
    with pytest.raises(LabError, match="has no crash"):
        begin_us(crashed, "crash", 0.5)


def test_only_a_flight_of_the_same_image_in_lockstep_is_flown_again_and_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(debugging, "read_image", lambda path, elf: [SimpleNamespace(sha256="same")])
    bench = Bench(board=str(tmp_path / "cf2.bin"))
    request = Request(HOVER, "crazyflie", (), 3, 8.0, (), bench)

    def asked(image: str | None, **options: Any) -> Request:
        found = image and SimpleNamespace(sha256=image)
        flown: Any = SimpleNamespace(
            request=replace(request, bench=replace(bench, **options)), folder=tmp_path, image=found
        )
        return debugging.debugged_request(flown)

    again = replace(request, bench=replace(bench, gdb=0))
    assert asked("same") == asked(None) == again  # None: the process was killed
    with pytest.raises(LabError, match=r"another image than the one that flew in .*: fly it again"):
        asked("other")
    foreign: Any = SimpleNamespace(
        request=replace(request, experiment=unknown("mine", None)), folder=tmp_path, image=None
    )
    with pytest.raises(LabError, match="experiment mine: its code was not executed"):
        debugging.debugged_request(foreign)
    for option in ({"board": "c"}, {"link": "mavlink:udp"}, {"realtime": True}):
        with pytest.raises(LabError, match="only flights of an image in lockstep are debugged"):
            asked("same", **option)
    monkeypatch.setattr(debugging, "in_lockstep", lambda *given: given)
    flight_of = debugging.waiting_flight(3333, 7_000_000)
    assert flight_of(again, tmp_path, None) == (  # type: ignore[arg-type, comparison-overlap]
        replace(request, bench=replace(bench, gdb=3333)), tmp_path, None, 7_000_000,
    )  # fmt: skip
