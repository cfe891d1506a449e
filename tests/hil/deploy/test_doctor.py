"""`floaty board doctor`: what is connected, in plain words, on the exported app."""

import ctypes
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.core.structs import Control
from firmware_py.export.profile_c import profile_hash
from firmware_py.wire.core_port import (
    _LOOP,
    CHANNEL_LOOP,
    HEAD,
    PORT_CORE,
    READ_MAX,
    WRITE_MAX,
    Health,
    Hil,
    Loop,
    Message,
    read,
)
from firmware_py.wire.crtp import Packet, encode
from ground_station.links import packets
from ground_station.links.core_client import CoreClient
from hil.config import load_config
from hil.deploy import doctor
from support.app_packets import AppPackets
from support.command import Cli
from support.core_streams import MEMORY
from support.crazyflie_app import App, build_app

URI = "udp://127.0.0.1:9"
VERSION = b"\xd1\x012026.08 +2\0\0"  # as the platform service of the stock firmware answers


class Board(AppPackets):
    """An app with a still gyro and a firmware around it."""

    def __init__(self, app: App) -> None:
        super().__init__(app)
        self.noise, self.zero = 3.0, 8.0
        self.services = [VERSION]
        self.deaf = False  # to samples
        self._steps = 0

    def send_any(self, packet: bytes) -> None:
        if not self.deaf:
            super().send_any(packet)

    def received(self, timeout_s: float = 0.0) -> list[bytes]:
        """What came; a millisecond of the board passes when somebody waits."""
        came, self.services = self.services, []
        if timeout_s > 0.0:
            self._steps += 1
            self.app.step(self._steps)
        while packet := self.app.sent():
            came.append(packet)
        return came

    def send(self, data: bytes) -> None:
        if data[0] == Message.CALL:  # each entry point takes another time
            self.app.cycles.value = 1000 * (1 + data[HEAD.struct.size])
        self.app.gyro[:] = [int(count) for count in self._rng.normal(self.zero, self.noise, 3)]
        super().send(data)


@pytest.fixture
def board(library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Board:
    app = App(library, tmp_path / "copy.so")
    app.boot()
    board = Board(app)
    monkeypatch.setattr(packets, "CflibPackets", lambda uri: board)
    return board


def findings(cli: Cli) -> dict[str, str]:
    lines = cli.out.splitlines()
    return {line[2:12].strip(): line[:2].strip() + line[12:] for line in lines}


@pytest.mark.long
def test_a_board_that_is_well_is_described_and_gets_its_own_gyro_back(
    cli: Cli, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    judge, rates = doctor._link, list[float]()
    monkeypatch.setattr(doctor, "_link", lambda client, hz: rates.append(hz) or judge(client, hz))
    assert cli("board", "doctor", URI, "--set", "mocap.period_us=10_000") == 0
    assert rates == [100.0], "poses per second of the profile"
    found = findings(cli)
    subjects = "firmware core profile state link memory battery RAM gyro servos computes loop"
    assert " ".join(found) == subjects
    assert found["firmware"] == "2026.08 +2"
    assert found["core"].endswith("as here")
    assert found["profile"].endswith("as here")
    assert found["state"] == "calibrating"
    assert "packets/s each way, 0 of 600 repeated" in found["link"]
    assert found["memory"] == f"{MEMORY} B written and read back, 0 of them wrong"
    assert (found["battery"], found["RAM"]) == ("3.90 V", "7000 B free")
    assert found["gyro"].startswith("alive: zero at ")
    assert (
        found["servos"]
        == "pulses of " + " ".join(f"{count / 21:.0f}" for count in board.app.counts()) + " us"
    )
    assert found["computes"] == "the same bits as here; estimate 3000 cycles, control 4000, at 168 MHz"
    assert found["loop"].endswith(" samples/s of 1000: 10 ms held, 0 lost, 0 doubled")
    assert ctypes.c_uint8.in_dll(board.app.c, "floaty_hil_mode").value == Hil.STILL
    board.app.step(1000)
    assert ctypes.c_uint8.in_dll(board.app.c, "floaty_hil_mode").value == Hil.OFF
    assert board.closed == 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("state", "subject", "said"),
    [
        ({"noise": 0.0}, "gyro", "!dead or frozen: 60 times the same counts"),
        ({"services": []}, "firmware", "!does not tell its version"),
    ],
)
def test_a_defect_is_marked_and_is_exit_code_one(
    cli: Cli, board: Board, monkeypatch: pytest.MonkeyPatch, state: dict[str, Any], subject: str, said: str
) -> None:
    vars(board).update(state)
    monkeypatch.setattr("hil.deploy.doctor.VERSION_TIMEOUT_S", 0.02)
    assert cli("board", "doctor", URI) == 1
    found = findings(cli)
    assert found[subject].startswith(said)
    assert [text for text in found.values() if text.startswith("!")] == [found[subject]]


@pytest.mark.long
@pytest.mark.parametrize(
    ("subject", "values", "good"),
    [
        ("gyro", {"zero": 95}, True), ("gyro", {"zero": -95}, True), ("gyro", {"zero": 105}, False),
        ("gyro", {"zero": -105}, False), ("gyro", {"zero": 105, "noise": (3, 150, 3)}, True),
        ("battery", {"volts": 3.01}, True), ("battery", {"volts": 2.99}, False),
        ("battery", {"volts": 4.34}, True), ("battery", {"volts": 4.36}, False),
        ("servos", {"count": 21_000}, True), ("servos", {"count": 20_999}, False),
        ("servos", {"count": 42_000}, True), ("servos", {"count": 42_001}, False),
    ],
)  # fmt: skip
def test_a_reading_is_judged_at_both_of_its_bounds(
    board: Board, subject: str, values: dict[str, Any], good: bool
) -> None:
    board.zero, board.noise = values.get("zero", 0.0), values.get("noise", 3.0)
    board.app.battery.value = values.get("volts", 3.9)
    client = CoreClient(board, "board")
    client.begin()
    board.app._struct(Control).count[2] = int(values.get("count", 30_000))
    assert {one.subject: one.good for one in doctor._health(client)}[subject] == good


def test_the_core_is_reset_and_called_in_the_order_of_a_tick(
    board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[str] = []
    call = doctor.RealCore.call
    monkeypatch.setattr(doctor.RealCore, "call", lambda core, name: called.append(name) or call(core, name))
    client = CoreClient(board, "board")
    assert doctor._core(client, client.begin(), load_config()).good
    assert called == ["reset", *20 * ["estimate", "supervise", "control"]]


@pytest.mark.parametrize("kept", [bytes, lambda size: b"\xff" * size], ids=["zeros", "ones"])
def test_a_memory_that_keeps_nothing_is_found(
    kept: Callable[[int], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "write", lambda at, data: (at, data))
    written: list[tuple[int, bytes]] = []
    client: Any = SimpleNamespace(execute=written.extend, memory=kept)
    found = doctor._memory(client, 1000)
    data = b"".join(piece for _, piece in written)
    wrong = sum(one != other for one, other in zip(data, kept(1000), strict=True))
    assert [at for at, _ in written] == [*range(0, 1000, WRITE_MAX)]
    assert found == doctor.Finding("memory", f"1000 B written and read back, {wrong} of them wrong", False)
    assert wrong > 900


@pytest.mark.parametrize("wrong", [0, 3])
def test_cycles_are_those_of_a_call_of_each_entry_point(wrong: int, monkeypatch: pytest.MonkeyPatch) -> None:
    loads = {name: SimpleNamespace(cycles=20 * n + 7) for n, name in enumerate(("estimate", "control"), 300)}
    core = SimpleNamespace(call=lambda name: None, load=loads, unexpected=wrong)
    monkeypatch.setattr(doctor, "RealCore", lambda blocks, client: core)
    found = doctor._core(SimpleNamespace(name="b"), SimpleNamespace(clock_mhz=168), load_config())  # type: ignore[arg-type]
    verdict = "OTHER bits than here in 3 calls" if wrong else "the same bits as here"
    assert found.text == f"{verdict}; estimate 300 cycles, control 301, at 168 MHz"
    assert found.good is (wrong == 0)


def test_a_board_is_examined_from_its_firmware_to_the_loop_with_the_profile_s_poses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    about, config = SimpleNamespace(size=77), load_config(overrides=["mocap.period_us=5_000"])
    client: Any = SimpleNamespace(begin=lambda: about)
    monkeypatch.setattr(doctor, "_firmware", lambda *given: SimpleNamespace(good=True, given=given))
    for name in ("_link", "_memory", "_core", "_loop"):
        monkeypatch.setattr(doctor, name, lambda *given, name=name: (name, *given[1:]))
    for name in ("_app", "_health"):
        monkeypatch.setattr(doctor, name, lambda *given, name=name: iter([(name, *given)]))
    firmware, *found = doctor.examine(client, config)
    assert firmware.given == (client,)  # type: ignore[attr-defined]
    assert found == [("_app", about, config), ("_link", 200.0), ("_memory", 77), ("_health", client),
        ("_core", about, config), ("_loop",)]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("bit", [None, *range(13)])
def test_a_memory_that_ignores_a_bit_of_an_address_is_found(
    monkeypatch: pytest.MonkeyPatch, bit: int | None
) -> None:
    memory, ignored = bytearray(8192), 0 if bit is None else 1 << bit

    def execute(writes: list[tuple[int, bytes]]) -> None:
        for start, data in writes:
            for at, value in enumerate(data, start):
                memory[at & ~ignored] = value

    client: Any = SimpleNamespace(
        execute=execute, memory=lambda size: bytes(memory[at & ~ignored] for at in range(size))
    )
    monkeypatch.setattr(doctor, "write", lambda at, data: (at, data))
    assert doctor._memory(client, len(memory)).good == (bit is None)


@pytest.mark.parametrize(("full", "timeout_s"), [(False, 0.0), (True, 0.001)])
def test_a_full_window_waits_for_reports_and_the_last_one_counts(full: bool, timeout_s: float) -> None:
    reports = [Loop(n, *range(n + 1, n + len(Loop._fields)))._replace(fresh=True) for n in (1, 2)]
    sent = [encode(Packet(port, channel, _LOOP.pack(*report))) for report in reports
        for port, channel in ((PORT_CORE, CHANNEL_LOOP), (PORT_CORE, CHANNEL_LOOP + 1), (2, CHANNEL_LOOP))]  # fmt: skip
    waited: list[float] = []
    noted: list[Loop] = []
    client: Any = SimpleNamespace(
        packets=SimpleNamespace(received=lambda timeout_s: waited.append(timeout_s) or sent)
    )
    window: Any = SimpleNamespace(full=full, on_report=lambda report, now_us: noted.append(report))
    assert doctor._last_report(client, window) == reports[1]
    assert (waited, noted) == ([timeout_s], reports)
    sent.clear()
    assert doctor._last_report(client, window) is None


def test_a_board_without_samples_is_reported(cli: Cli, board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    board.deaf = True
    monkeypatch.setattr("hil.deploy.doctor.LOOP_TIMEOUT_US", 50_000)
    assert cli("board", "doctor", URI) == 1
    assert findings(cli)["loop"].startswith("!carries 0 samples/s of 1000: ")


@pytest.mark.long
def test_another_profile_on_board_is_reported(cli: Cli, board: Board) -> None:
    assert cli("board", "doctor", URI, "--profile", "as-flown") == 1
    assert findings(cli)["profile"].startswith(f"!{profile_hash(load_config())[:8]}, ")


@pytest.mark.long
def test_a_core_that_computes_differently_is_found(cli: Cli, tmp_path: Path, board: Board) -> None:
    plant = ("floaty_core.c", "control->count[flap] =", "control->count[flap] = 1 ^")
    board.app = App(build_app(tmp_path / "app", plant=plant), tmp_path / "other.so")
    board.app.boot()
    assert cli("board", "doctor", URI) == 1
    assert findings(cli)["computes"].startswith("!OTHER bits than here in 20 calls")


@pytest.mark.long
@pytest.mark.parametrize(
    ("flown", "silent", "said"), [(True, False, "it may be in the air"), (False, True, "silent for 3 s")]
)
def test_a_flying_or_silent_board_is_refused_in_one_line(
    cli: Cli, board: Board, monkeypatch: pytest.MonkeyPatch, flown: bool, silent: bool, said: str
) -> None:
    board.app.supervisor.flown, board.silent = flown, silent
    monkeypatch.setattr("hil.deploy.doctor.VERSION_TIMEOUT_S", 0.02)
    if silent:
        board.services = []
    for step in range(1, 11):
        board.app.step(step)
    assert cli("board", "doctor", URI) == 2
    assert f"floaty: {URI}: {said}" in cli.err


def test_a_cable_without_a_board_is_refused_in_one_line(cli: Cli) -> None:
    assert cli("board", "doctor", "usb://0") == 2
    assert cli.err == "floaty: LINK usb://0: Could not open usb://0\n"


def test_a_firmware_without_the_app_is_distinguished_from_silence(cli: Cli, board: Board) -> None:
    board.silent = True
    assert cli("board", "doctor", URI) == 1
    found = findings(cli)
    assert found["firmware"] == "2026.08 +2"
    assert found["app"].startswith("!missing: the firmware answers, Floaty's app does not")


@pytest.mark.parametrize(
    ("poses_hz", "good", "text"),
    [
        (600.0, True, "poses are lost or late in a flight"),
        (600.1, False, "too slow to fly with 600 poses/s"),
    ],
)
def test_a_link_that_repeats_half_of_all_packets_is_judged_by_its_rate(
    library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, poses_hz: float, good: bool, text: str
) -> None:
    """The clock advances by a second at each look, in which 600 packets go and come."""
    app = App(library, tmp_path / "copy.so")
    app.boot()
    client = CoreClient(AppPackets(app, mess=0.25), "board")
    client.begin()
    monkeypatch.setattr(doctor, "clock_us", count(0, 1_000_000).__next__)
    executed: list[Any] = []
    execute = client.execute
    monkeypatch.setattr(client, "execute", lambda asked: executed.append(asked) or execute(asked))
    found = doctor._link(client, poses_hz)
    assert executed == [[read(0, READ_MAX)]] * doctor.ROUND_TRIPS + [[read(0, READ_MAX)] * 600], (
        "whole packets"
    )
    assert found.good == good
    assert found.text.startswith("round trip 1000.0 ms, the longest 1000.0; 600 packets/s each way, ")
    assert text in found.text


@pytest.mark.parametrize(("repeated", "advice"), [(60, ""), (61, ": poses are lost or late in a flight; move the antenna, "
    "or change the channel")])  # fmt: skip
def test_a_link_that_repeats_more_than_a_tenth_of_the_packets_gets_advice(
    monkeypatch: pytest.MonkeyPatch, repeated: int, advice: str
) -> None:
    client: Any = SimpleNamespace(repeated=5)
    trips_ms = [300, *(1 + 37 * n % 100 for n in range(1, 100))]  # neither in order nor symmetric
    times = iter([*(us for ms in trips_ms for us in (0, 1000 * ms)), 0, 2_000_000])
    monkeypatch.setattr(doctor, "clock_us", lambda: next(times))

    def execute(asked: list[Any]) -> None:
        client.repeated += repeated * (len(asked) > 1)

    client.execute = execute
    expected = (
        f"round trip 51.5 ms, the longest 300.0; 300 packets/s each way, {repeated} of 600 repeated{advice}"
    )
    assert doctor._link(client, 50.0) == doctor.Finding("link", expected)


def test_a_gyro_s_zero_is_that_of_the_last_look_and_a_loop_reports_what_it_held_lost_and_doubled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks = [
        Health(n, 2, -3, n == 60, 3900, 7000, *(21_000 + 21 * m for m in range(4))) for n in range(1, 61)
    ]
    pending = iter(looks)
    client: Any = SimpleNamespace(execute=lambda asked: [SimpleNamespace(health=lambda: next(pending))])
    found = {one.subject: one for one in doctor._health(client)}
    assert found["gyro"].text == "alive: zero at 30 2 -3 counts, noise 17.3"
    assert found["servos"].text == "pulses of 1000 1001 1002 1003 us"
    looks[-1] = looks[-1]._replace(calibrated=False)
    pending = iter(looks)
    assert {one.subject: one for one in doctor._health(client)}["gyro"].text.endswith(
        "noise 17.3, zero not found yet"
    )

    for millivolts, good in ((2999, False), (3000, True), (4350, True), (4351, False)):
        looks[-1] = looks[-1]._replace(battery_mv=millivolts)
        pending = iter(looks)
        assert {one.subject: one.good for one in doctor._health(client)}["battery"] == good

    class Window:
        """A window of which the board takes 250 samples at each look."""

        used, full = 0, True

    asked: list[Any] = []
    client = SimpleNamespace(execute=asked.append, packets=SimpleNamespace(ready=False))
    monkeypatch.setattr(doctor, "SampleWindow", Window)
    monkeypatch.setattr(doctor, "clock_us", count(0, 100_000).__next__)
    report = SimpleNamespace(held=3, lost=5, doubled=7)
    for taken, held in ((250, report), (10, report), (0, None)):

        def last_report(client: Any, window: Any, taken: int = taken, held: Any = held) -> Any:
            window.used += taken
            return held

        monkeypatch.setattr(doctor, "_last_report", last_report)
        loop = doctor._loop(client)
        texts = {250: "carries 1667 samples/s of 1000", 10: "carries 96 samples/s of 1000"}
        assert (loop.text, loop.good) == (f"{texts[taken]}: 3 ms held, 5 lost, 7 doubled" if held else "does not answer",
            taken == 250)  # fmt: skip
    assert asked == [[doctor.loop(Hil.STILL)], [doctor.loop(Hil.OFF)]] * 3
