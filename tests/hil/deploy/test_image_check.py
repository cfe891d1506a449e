"""`floaty deploy check --elf`: what is compared of an app around the core, tried on the app and in flights."""

import ctypes
import json
import os
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from firmware_py.core.structs import Input, Parameters
from firmware_py.export.app_toc import AppParameter, app_parameters
from firmware_py.wire.scalars import PARAMETER_SCALARS, Scalar
from firmware_py.wire.supervisor import Cause
from hil.board.board_firmware import PythonBoard
from hil.config import load_config
from hil.deploy import image_check
from hil.deploy.beside import BOUNDS, Bound, Compared, compare_flights, compare_states
from hil.deploy.image_check import (
    TARGET,
    ImageBench,
    check_image,
    check_memory,
    check_parameters,
    check_services,
)
from hil.deploy.service_programs import PROGRAMS
from hil.deploy.services import Answers, ServiceBench, differences, play_in_copies
from hil.emulator.stm32f405.image import MemoryUse
from hil.errors import LabError
from hil.laboratory.files.recorder import EVENTS
from support.crazyflie_app import App

ELF = os.environ.get("FLOATY_CF2_ELF", "")
flies = pytest.mark.skipif(
    not ELF, reason="FLOATY_CF2_ELF names no build of the Crazyflie firmware: no image was checked"
)
TABLE = app_parameters(load_config())


class AppBoard:
    """The exported app on a board of memory, as `ImageBench`."""

    def __init__(self, app: App) -> None:
        self.app = app

    def scalar(self, name: str) -> Scalar | None:
        if name not in self.app.params:
            return None
        return PARAMETER_SCALARS[self.app.c.stub_param_type(self.app.params[name])]

    def value(self, name: str) -> float:
        return self.app.get(name)

    def write(self, name: str, value: float) -> None:
        self.app.set(name, value)

    def field(self, parameter: AppParameter) -> float:
        name, member, index = TARGET.match(parameter.target).groups()
        offsets = {"floaty_parameters": Parameters.dtype.fields, "floaty_input": Input.dtype.fields}
        offset = 0
        if member:
            offset = offsets[name][member][1]
        scalar = parameter.place.scalar
        place = (
            ctypes.addressof(ctypes.c_char.in_dll(self.app.c, name)) + offset + scalar.size * int(index or 0)
        )
        return scalar.unpack(ctypes.string_at(place, scalar.size))


@pytest.fixture
def board(library: Path, tmp_path: Path) -> AppBoard:
    app = App(library, tmp_path / "copy.so")
    app.boot()
    app.set("extPose.absolute", 1)  # as before anybody has connected
    return AppBoard(app)


@pytest.mark.long
def test_every_parameter_of_the_app_is_as_in_the_table_and_is_left_as_it_was(board: AppBoard) -> None:
    before = [board.value(one.name) for one in TABLE]
    done: list[int] = []
    assert list(check_parameters(TABLE, board, done.append)) == []
    assert [board.value(one.name) for one in TABLE] == before
    assert done == list(range(1, len(TABLE) + 1))


def changed(name: str, **fields: object) -> tuple[AppParameter, ...]:
    """The table with one parameter that the app has otherwise."""
    return tuple(replace(one, **fields) if one.name == name else one for one in TABLE)


@pytest.mark.parametrize(
    ("name", "fields", "found"),
    [
        ("extCtrl.z_P", {"initial": 3.1}, "extCtrl.z_P: default 3, in the profile 3.1"),
        ("extCtrl.z_P", {"scale": -1.0}, "extCtrl.z_P: default floaty_parameters.gain_z = 3, in the profile -3"),
        ("extCtrl.z_P", {"target": "floaty_parameters.gain_x"}, "writes floaty_parameters.gain_x = "),
        ("extCtrl.z_P", {"high": 10.0}, "is accepted, outside -20 to 10"),
        ("extCtrl.z_P", {"low": -10.0}, "is accepted, outside -10 to 20"),
        ("motorShifts.m2", {"scalar": Scalar.F32}, "motorShifts.m2: type I16, expected F32"),
        ("delayComp.horizon", {"high": 7}, "delayComp.horizon = 8 is accepted"),
        ("supervisor.poseTimeout", {"scale": 100.0}, "floaty_parameters.pose_timeout_us = 500000, in the profile 50000"),
    ],
)  # fmt: skip
def test_wrong_parameter_is_found(board: AppBoard, name: str, fields: dict[str, object], found: str) -> None:
    assert any(found in line for line in check_parameters(changed(name, **fields), board))


def test_a_parameter_that_is_missing_is_found(board: AppBoard) -> None:
    missing = replace(TABLE[0], name="extCtrl.none")
    assert list(check_parameters((missing,), board)) == ["extCtrl.none: the image has no such parameter"]


def words(bits: int, value: int, pins: tuple[int, ...]) -> int:
    """A register with a value for each pin or channel."""
    return sum(value << bits * pin for pin in pins)


# Reference manual RM0090: 84 MHz / 4 / 52501 = 400 Hz, PWM mode 1 with preload, on PA2, PA3 (TIM5, channels 3 and 4) and
# PB4, PB5 (TIM3, channels 1 and 2) as alternate function 2 with open drain.
REGISTERS = {
    base + offset: value
    for base, channels, ccmr in ((0x4000_0400, (0, 1), 0x18), (0x4000_0C00, (2, 3), 0x1C))
    for offset, value in ((0x00, 0x81), (0x28, 3), (0x2C, 52_500), (ccmr, words(8, 0x68, (0, 1))),
                          (0x20, words(4, 1, channels)))
} | {
    base + offset: words(bits, value, pins)
    for base, pins in ((0x4002_0000, (2, 3)), (0x4002_0400, (4, 5)))
    for offset, bits, value in ((0x00, 2, 2), (0x04, 1, 1), (0x20, 4, 2))
}  # fmt: skip


def test_every_bit_of_timers_and_pins_that_servos_need_is_checked() -> None:
    bench: Any = object.__new__(ImageBench)
    memory = dict(REGISTERS)
    bench.firmware = SimpleNamespace(
        chip=SimpleNamespace(read=lambda place, size: memory[place].to_bytes(size, "little"))
    )
    assert list(bench.check_servo_outputs()) == []
    for place, value in REGISTERS.items():
        for bit in (one for one in range(16) if value >> one & 1):
            memory[place] = value ^ 1 << bit
            [found] = bench.check_servo_outputs()
            assert re.match(r"servo outputs: (TIM|GPIO)\w\.\w+ = 0x", found)
            memory[place] = value
    for place in (one for one in REGISTERS if one & 0xFF in (0x20, 0x04) and one >= 0x4002_0000):
        memory[place] = REGISTERS[place] | 1 << 31  # of a pin that is no servo's
    assert list(bench.check_servo_outputs()) == []


class Switches(ImageBench):
    """A board whose request parameters act at once, but for those named."""

    def __init__(self, *dead: str) -> None:
        self.dead, self.at = (
            dead,
            {"tick": 900, "stopped": 0, "armed": 1, "stale_hovers": 7 * ("hovers" in dead), "cause": 0},
        )
        self.wrote: list[tuple[str, float]] = []
        self.ran: list[int] = []

    def scalar(self, name: str) -> Scalar | None:
        return Scalar.U8

    def value(self, name: str) -> float:
        return 5.0

    def write(self, name: str, value: float) -> None:
        self.wrote.append((name, value))
        name = name.removeprefix("floaty.").removeprefix("stabilizer.")
        if name not in self.dead:
            self.at |= {"tick": 2} if name == "reset" else {{"stop": "stopped"}.get(name, name): int(value)}
            self.at["cause"] = Cause.NO_CONTROL if self.at.get("controller") == 1 else Cause.NONE

    def run(self, duration_us: int) -> None:
        """Let nothing happen."""
        self.ran.append(duration_us)

    def memory(self, target: str, scalar: Scalar) -> float:
        return self.at[target.partition(".")[2]]


def bench_of(chip: Any, **more: Any) -> Any:
    """A bench whose memory is read by `chip`, with symbols at places of their own."""
    bench: Any = object.__new__(ImageBench)
    places = {"floaty_parameters": 0x100, "floaty_stop": 0x200}
    debug = SimpleNamespace(variable=lambda name, at: {"trim": SimpleNamespace(offset=8 * (at == 7))})
    image = SimpleNamespace(
        symbol=lambda name: SimpleNamespace(address=places[name]), debug=debug, path="cf2.elf"
    )
    bench.firmware = SimpleNamespace(chip=chip, image=image)
    bench._of_parameters = 7
    for name, value in more.items():
        setattr(bench, name, value)
    return bench


def test_a_number_in_memory_is_found_by_its_expression_in_c() -> None:
    memory = SimpleNamespace(read=lambda place, size: bytes((place % 256, place >> 8))[:size])
    bench = bench_of(memory)
    for target, scalar, place in (
        ("floaty_stop", Scalar.U8, 0x200), ("floaty_parameters.trim", Scalar.U16, 0x108),
        ("floaty_parameters.trim[3]", Scalar.U16, 0x10E), ("floaty_stop[1]", Scalar.U16, 0x202),
    ):  # fmt: skip
        assert bench.memory(target, scalar) == (place % 256 if scalar is Scalar.U8 else place)


@pytest.mark.parametrize(("answers_after", "answered"), [(1, True), (200, True), (201, False)])
def test_a_written_parameter_is_answered_within_a_fifth_of_a_second(
    answers_after: int, answered: bool
) -> None:
    posted: list[Any] = []
    bench = bench_of(None, received=["an old answer"], _table={"a.b": SimpleNamespace(number=513, scalar=Scalar.U16,
        read=lambda: 4.0)}, ran=0, post=lambda *what: posted.append(what))  # fmt: skip

    def packet(port: int, channel: int, data: bytes) -> Any:
        return SimpleNamespace(port=port, channel=channel, data=data)

    def run(duration_us: int) -> None:
        bench.ran += duration_us // 1000
        own = bench.ran >= answers_after
        bench.received += [packet(2, 1, b"\1\2\0\7\0"), packet(2, 2, b"\2\2\7\0"), packet(5, 2, b"\1\2\7\0"),
            *[packet(2, 2, b"\1\2\7\0")] * own]  # fmt: skip

    bench.run = run
    late = r"^cf2\.elf: does not answer to a\.b = 7 within 200 ms$"
    with nullcontext() if answered else pytest.raises(LabError, match=late):
        bench.write("a.b", 7.0)
    assert posted == [(2, 2, b"\1\2\7\0")]
    assert "an old answer" not in bench.received
    assert bench.ran == min(answers_after, 200)
    assert (bench.scalar("a.b"), bench.scalar("c.d"), bench.value("a.b")) == (Scalar.U16, None, 4.0)
    bench.field = bench_of(SimpleNamespace(read=lambda place, size: bytes((place % 256, 0)))).field
    assert (
        bench.field(
            replace(TABLE[0], target="floaty_parameters.trim[1]", place=SimpleNamespace(scalar=Scalar.U16))
        )
        == 10
    )
    requested: list[Any] = []
    bench.write, bench.run = lambda *what: requested.append(what), requested.append
    for known in (None, Scalar.U8):
        bench.scalar = lambda name, known=known: known
        bench._request("stop", 1)
    assert requested == [("floaty.stop", 1), image_check.ACT_US]


@pytest.mark.parametrize("name", ["extCtrl.z_P", "motorShifts.m2", "delayComp.horizon"])
def test_values_that_are_tried_are_inside_but_not_the_default_and_just_outside(name: str) -> None:
    (one,) = [one for one in TABLE if one.name == name]
    inside, *outside = image_check._values(one, one.scalar)
    assert one.low <= inside <= one.high
    assert inside != one.scalar.cast(one.initial)
    low, high = (np.float32(limit) for limit in (one.low, one.high))
    beside = [np.nextafter(low, -np.float32(np.inf)), np.nextafter(high, np.float32(np.inf))]
    edges = [float(edge) for edge in beside] if one.scalar.is_float else [low - 1.0, high + 1.0]
    assert outside == [edge for edge in edges if one.scalar.cast(edge) == edge]
    for initial in image_check._values(replace(one, initial=one.low), one.scalar)[
        :1
    ]:  # the default is that value
        assert image_check._values(replace(one, initial=initial), one.scalar)[0] not in (initial, *outside)
    assert image_check._behind(replace(one, scale=0.1), 3.0) == one.place.scalar.cast(
        float(np.float32(0.1) * np.float32(3.0))
    )


@pytest.mark.parametrize(
    ("dead", "switches", "watch"),
    [
        ((), [], []),
        (("stop",), ["floaty.stop = 1: floaty_supervisor.stopped = 0, expected 1"], []),
        (("armed",), ["floaty.armed = 0: floaty_supervisor.armed = 1, expected 0"], []),
        (("reset",), ["floaty.reset = 1: floaty_estimator.tick = 900 goes on, expected from 0 again"], []),
        (
            ("hovers",),
            [],
            ["servos put to hover 7 times for a controller that stands still, expected 0: none does"],
        ),
        (("controller",), [], ["stabilizer.controller = 1: cause NONE, expected NO_CONTROL"]),
    ],
)
def test_switches_and_watch_of_the_controller_are_tried(
    dead: tuple[str, ...], switches: list[str], watch: list[str]
) -> None:
    board = Switches(*dead)
    assert list(board.check_switches()) == switches
    assert list(board.check_watch()) == watch
    assert board.wrote[:5] == [(f"floaty.{name}", value) for name, value in
        (("stop", 1), ("stop", 0), ("armed", 0), ("armed", 1), ("reset", 1))]  # fmt: skip
    assert board.wrote[-2:] == [("stabilizer.controller", 1), ("stabilizer.controller", 5.0)], "as before"
    assert board.ran == [20_000] * 5 + [150_000] * 2, (
        "until a request is served, and the app sees a controller that stands"
    )


@pytest.mark.parametrize(
    "wrong", [(), ("services", "params", "switches", "watch", "servos", "states", "constants", "flight")]
)
def test_an_image_is_checked_on_the_bench_and_in_flight_and_each_part_has_its_finding(
    wrong: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    def faults(subject: str) -> Any:
        return lambda *_: [f"{subject} 1", f"{subject} 2"] if subject in wrong else []

    bench = SimpleNamespace(firmware=SimpleNamespace(differences=lambda config: "gain" * ("constants" in wrong)),
        check_switches=faults("switches"), check_watch=faults("watch"), check_servo_outputs=faults("servos"))  # fmt: skip
    monkeypatch.setattr(image_check, "image_at", lambda path, elf: "flashed")
    monkeypatch.setattr(image_check, "ImageBench", lambda flashed, config: bench)
    monkeypatch.setattr(image_check, "ServiceBench", lambda board, config: "python")
    for name, subject in (("check_services", "services"), ("check_parameters", "params")):
        monkeypatch.setattr(
            image_check, name, lambda one, other, done, subject=subject: done(3) or faults(subject)()
        )
    rms = next(one for one in BOUNDS if one.name == "position")
    compared = [Compared(rms, "truth.x", 2.1 if "flight" in wrong else 2.0)]

    def flown(elf: Path, profile: str, overrides: tuple[str, ...], progress: Any) -> Any:
        progress("hover", 5, SimpleNamespace(end_us=9))
        return compared, ["ended"] * ("flight" in wrong), faults("states")()

    monkeypatch.setattr(image_check, "fly_beside_python", flown)
    shown: list[Any] = []
    found = list(check_image(Path("a.elf"), "floaty", (), lambda *what: shown.append(what)))
    assert shown == [
        ("boot", 0, 1),
        ("services", 3, len(PROGRAMS)),
        ("parameters", 3, len(TABLE)),
        ("flight, hover", 5, 9),
    ]
    subjects = ["constants", "params", "switches", "watch", "servos", "services", "flight", "states"]
    assert list(dict.fromkeys(one.subject for one in found)) == subjects
    assert {one.subject for one in found if not one.good} == set(wrong)
    texts = [one.text for one in found if one.subject == "watch"]
    assert texts == (
        ["watch 1", "watch 2"] if wrong else ["acts when another controller runs, and only then"]
    )
    assert [one.text for one in found if one.subject == "flight"] == ["ended"] * ("flight" in wrong) + [
        str(compared[0])
    ]


@pytest.mark.long
def test_programs_that_the_boards_answer_differently_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("goals outside the box are refused", "the values of a robot that stands askew")
    monkeypatch.setattr(image_check, "PROGRAMS", {name: PROGRAMS[name] for name in names})
    default, narrow = (
        ServiceBench(PythonBoard(), load_config(overrides=overrides))
        for overrides in ((), ("box.radius=0.05",))
    )
    done: list[int] = []
    assert list(check_services(default, default, done.append)) == []
    assert done == [1, 2]
    [difference] = check_services(narrow, default, done.append)
    assert re.match(f"{names[0]}: goto .*: status 8, expected status 0$", difference)


def test_numbers_of_two_boards_may_be_apart_by_their_tolerance() -> None:
    for found, apart in (("1.95~0.1 7", False), ("2.11~0.1 7", True), ("2~0.1 8", True), ("2~0.1", True)):
        answers = [Answers([f"values: {text}"]) for text in ("2~0.1 7", found)]
        assert bool(list(differences(*answers))) == apart
    place = (0.0, 0.0, 1.0, 3.13)
    for found, apart in (((0.04, 0, 1, -3.13), False), ((0.06, 0, 1, 3.13), True), ((0, 0, 1, 3.0), True)):
        assert bool(list(differences(Answers([], [place]), Answers([], [found])))) == apart


@pytest.mark.long
def test_answers_come_in_the_order_of_the_programs_of_which_as_many_run_as_there_are_processors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hil.deploy.services.os.sched_getaffinity", lambda process: {0, 1})
    bench: Any = SimpleNamespace(play=lambda program: Answers([f"{program}: 1"], [(0.0, 1.0, 2.0, 3.0)]))
    played = [*play_in_copies(bench, "abcde")]
    assert [(one.lines, one.path) for one in played] == [
        ([f"{name}: 1"], [(0.0, 1.0, 2.0, 3.0)]) for name in "abcde"
    ]


def test_a_program_that_breaks_off_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(LabError, match="the board broke off a program of requests"):
        list(play_in_copies(ServiceBench(PythonBoard()), ["no-such-word"]))
    assert "no-such-word" in capfd.readouterr().err


@pytest.mark.parametrize(("used", "good"), [(64_512, True), (64_513, False)])
def test_less_than_a_kilobyte_left_of_a_memory_is_a_warning(used: int, good: bool) -> None:
    finding = check_memory((MemoryUse("flash", 300_000, 1_032_192), MemoryUse("CCM", used, 65_536)))
    assert finding.good == good
    assert f"CCM {used} B of 65536, {65_536 - used} B free" in finding.text
    assert ("CCM has less than 1024 B left" in finding.text) != good


MEMBERS = {
    "servo counts": 4,
    "poses not fused": 4,
    "age of poses": 1,
    "poses fused": 1,
    "supervisor's state": 1,
}
SIZE_OF = {"rms": 14**0.5 / 2, "mean": 1.0, "final": 2.0}  # of the differences 0, -1, 3, 2


def test_flights_of_other_lengths_are_compared_from_the_release_on() -> None:
    rows = np.array([0.0, 5.0, 2.0, 7.0, 1.0])
    names = {"t", "flight.free", *(name for one in BOUNDS for name in one.columns)}
    runs = [
        SimpleNamespace(log=pa.table(dict.fromkeys(names, rows[:count]) | {"flight.free": np.ones(count)}))
        for count in (5, 3)
    ]
    for pair in (runs, runs[::-1]):
        assert {one.found for one in compare_flights(*pair)} == {0.0}  # type: ignore[arg-type]


@pytest.mark.long
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("bound", BOUNDS, ids=lambda bound: f"{bound.name} {bound.size}")
def test_each_bound_is_that_of_its_size_in_every_one_of_its_columns(bound: Bound, sign: int) -> None:
    columns = {"t", "flight.free", *(name for one in BOUNDS for name in one.columns)}

    def found(name: str, difference: list[float]) -> Compared:
        rows = {one: np.zeros(len(difference)) for one in columns} | {"flight.free": np.ones(len(difference))}
        runs = [
            SimpleNamespace(log=pa.table(rows | {name: values}))
            for values in (rows[name], sign * np.array(difference))
        ]
        return {one.bound: one for one in compare_flights(*runs)}[bound]  # type: ignore[arg-type]

    assert len(bound.columns) == MEMBERS.get(bound.name, 3), "x, y, z and others"
    for name in bound.columns:
        for share, held in ((0.999, True), (1.001, False)):
            if bound.size == "share of time":
                assert found(name, [0.0] * 99 + [1.0] * (2 - held)).held == held
                continue
            scale = share * bound.limit / SIZE_OF[bound.size] / bound.factor
            one = found(name, [0.0, -scale, 3 * scale, 2 * scale])
            assert (one.held, one.column) == (held, name)
            if bound.unit == "ms":
                assert str(one).endswith("ms apart (estimator.pose_age_us), at most 1 ms")
        assert not found(name, []).held
        unknown = found(name, [0.0, np.nan, np.nan])
        assert (unknown.held, unknown.column) == (False, name), "what is no number is the largest"


def test_the_first_state_that_one_board_does_not_reach_is_found(tmp_path: Path) -> None:
    folders = tmp_path / "python", tmp_path / "image"
    states = (["waiting", "flying", "failsafe, silence"], ["waiting", "flying"])
    for folder, prefix, texts in zip(folders, ("", "FLOATY: "), states, strict=True):
        folder.mkdir()
        events = ({"t_us": 0, "source": "board", "text": f"{prefix}supervisor: {text}"} for text in texts)
        (folder / EVENTS).write_text("".join(f"{json.dumps(event)}\n" for event in events), encoding="utf-8")
    assert list(compare_states(folders[0], folders[0])) == []
    assert list(compare_states(*folders)) == ["number 3 differs: python failsafe, silence, image the end"]


@pytest.mark.long
@flies
def test_an_image_of_the_profile_passes_and_one_of_another_does_not() -> None:
    shown: list[str] = []
    findings = list(check_image(Path(ELF), "floaty", (), lambda what, done, total: shown.append(what)))
    assert [one for one in findings if not one.good] == []
    assert {"params", "switches", "watch", "servos", "services", "flight", "states"} <= {
        one.subject for one in findings
    }
    expected = {
        "boot",
        "parameters",
        "services",
        *(f"flight, {name}" for name in ("hover, python", "hover, image", "supervisor, image")),
    }
    assert expected <= set(shown)
    other = check_image(Path(ELF), "floaty", ("controller.gain_z=3.1",), lambda *_: None)
    found = {one.subject: one.text for one in other if not one.good}
    assert found["constants"].startswith("gain_z = 3.0, in the profile 3.0999999")
    assert "extCtrl.z_P" in found["params"]
