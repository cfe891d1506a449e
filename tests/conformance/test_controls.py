"""Laws of an operator's requests on every protocol, each against the firmware in simulated time."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import pytest

from firmware_py import table
from firmware_py.firmware import Firmware
from firmware_py.rtos import TICK_US
from firmware_py.wire import crtp
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.supervisor import Cause, State
from ground_station.config import LinkSettings
from ground_station.controls import PATIENCE_US, REPEAT_US, Answer, ControlAction, ControlRequest
from ground_station.links.crtp_controls import CrtpControls, TocEntry
from ground_station.links.mavlink import MavlinkLink
from ground_station.links.mavlink_controls import MavlinkControls
from hil.config import load_config
from support.crtp_client import CrtpClient
from support.mavlink_client import MavlinkClient

TURN_US = 5_000
GYRO_ZERO_US = 700_000


class Bench(Protocol):
    """A board, and an operator's controls at the other end of a line that may lose what `lossy` says."""

    controls: CrtpControls | MavlinkControls
    firmware: Firmware
    lossy: Callable[[], bool]
    now_us: int
    listed: int  # parameters that the board tells of

    def turn(self) -> None:
        """Let 5 ms pass, as a station's loop does."""
        ...

    def name(self, name: str) -> str:
        """What a parameter is called in answers."""
        ...


class CrtpBench(CrtpClient):
    def __init__(self) -> None:
        self.lossy = lambda: False
        super().__init__()
        self.known = self.entries()
        self.listed = len(self.known)
        self.controls = CrtpControls(self._up, lambda: self.known)
        self.sent.clear()

    def _up(self, data: bytes) -> None:
        if not self.lossy():
            self.firmware.radio_received(data)

    def turn(self) -> None:
        self.run(self.now_us + TURN_US)
        for _, data in self.sent:
            if not self.lossy():
                self.controls.receive(self.now_us, crtp.decode(data))
        self.sent.clear()

    def name(self, name: str) -> str:
        return name


class MavlinkBench(MavlinkClient):
    def __init__(self) -> None:
        self.lossy = lambda: False
        self.down = bytearray()
        super().__init__()
        self.listed = self.ask("param_request_read", 1, 1, b"", 0)[0].param_count
        self.down.clear()
        self.link = MavlinkLink(self._up, LinkSettings(50.0, 0, 921_600))
        self.controls = self.link.controls
        self.run(20_000)

    def _up(self, now_us: int, data: bytes) -> None:
        if not self.lossy():
            self.receive(data)

    def uart_write(self, data: bytes) -> bool:
        if not self.lossy():
            self.down += data
        return super().uart_write(data)

    def turn(self) -> None:
        self.run(self.now_us + TURN_US)
        data = bytes(self.down)
        self.down.clear()
        self.link.receive(self.now_us, data)

    def name(self, name: str) -> str:
        return {"extCtrl.y_P": "EXT_Y_P", "supervisor.poseTimeout": "SUP_POSETIMEOUT"}[name]


BENCHES: dict[str, Callable[[], Any]] = {"crtp": CrtpBench, "mavlink": MavlinkBench}


@pytest.fixture(params=BENCHES)
def bench(request: pytest.FixtureRequest) -> Bench:
    made: Bench = BENCHES[request.param]()
    return made


def answer(bench: Bench) -> Answer:
    for _ in range(30 * PATIENCE_US // TURN_US):
        bench.turn()
        if (answer := bench.controls.answer(bench.now_us)) is not None:
            return answer
    raise AssertionError("no answer")


def ask(bench: Bench, action: ControlAction, name: str = "", value: float = 0.0) -> Answer:
    bench.controls.ask(bench.now_us, ControlRequest(action, name, value))
    return answer(bench)


def on_board(bench: Bench, name: str) -> float:
    return next(item for item in bench.firmware.parameters if item.name == name).read()


def test_a_written_value_is_in_force_and_is_read_back(bench: Bench) -> None:
    before = on_board(bench, "extCtrl.y_P")
    name = bench.name("extCtrl.y_P")
    assert ask(bench, ControlAction.READ, "extCtrl.y_P") == Answer(((name, before),))
    assert ask(bench, ControlAction.WRITE, "extCtrl.y_P", -1.25) == Answer(((name, -1.25),))
    assert on_board(bench, "extCtrl.y_P") == -1.25
    assert ask(bench, ControlAction.READ, "extCtrl.y_P") == Answer(((name, -1.25),))
    assert ask(bench, ControlAction.WRITE, "extCtrl.y_P", 0.1 - 1).error == ""  # as float32


def test_controls_that_were_asked_nothing_have_no_answer_and_take_no_message(bench: Bench) -> None:
    bench.firmware.radio_received(crtp.encode(crtp.Packet(crtp.PORT_PARAMETERS, 1, bytes(2))))
    for _ in range(5):
        bench.turn()
        assert not bench.controls.busy
        assert bench.controls.answer(bench.now_us) is None


def test_a_value_that_is_not_allowed_changes_nothing_and_is_one_line(bench: Bench) -> None:
    before = on_board(bench, "extCtrl.y_P")
    told = ask(bench, ControlAction.WRITE, "extCtrl.y_P", 1e9)
    assert told.values == ()
    assert "refused, it stays" in told.error
    assert f"{before:g}" in told.error
    assert on_board(bench, "extCtrl.y_P") == before
    assert ask(bench, ControlAction.WRITE, "supervisor.poseTimeout", 300.5).error
    assert ask(bench, ControlAction.WRITE, "supervisor.poseTimeout", -1.0).error
    assert on_board(bench, "supervisor.poseTimeout") == 500


def test_an_unknown_name_is_refused_with_the_nearest_one(bench: Bench) -> None:
    near = bench.name("extCtrl.y_P")
    for action in (ControlAction.READ, ControlAction.WRITE):
        told = ask(bench, action, near[:-1] + "Q", 1.0)
        assert told.values == ()
        assert f"{near[:-1]}Q" in told.error
        assert "did you mean" in told.error


@pytest.mark.long
def test_all_that_can_be_set_is_listed_with_the_value_that_is_in_force(bench: Bench) -> None:
    ask(bench, ControlAction.WRITE, "extCtrl.y_P", -0.75)
    values = dict(ask(bench, ControlAction.LIST).values)
    assert len(values) == bench.listed
    assert values[bench.name("extCtrl.y_P")] == -0.75
    assert values[bench.name("supervisor.poseTimeout")] == 500


@pytest.mark.long
def test_a_group_is_listed_whole(bench: Bench) -> None:
    group = bench.name("extCtrl.y_P")[:3].upper()
    told = [
        name for name, _ in ask(bench, ControlAction.LIST, group).values if name.upper().startswith(group)
    ]
    assert bench.name("extCtrl.y_P") in told
    everything = [name for name, _ in ask(bench, ControlAction.LIST).values]
    assert told == [name for name in everything if name.upper().startswith(group)]


@pytest.mark.long
def test_saved_values_survive_a_boot(bench: Bench) -> None:
    ask(bench, ControlAction.WRITE, "extCtrl.y_P", -1.75)
    assert ask(bench, ControlAction.SAVE) == Answer(())
    booted = Firmware(load_config(), bench)  # type: ignore[arg-type]
    assert next(item for item in booted.parameters if item.name == "extCtrl.y_P").read() == -1.75


def test_a_stop_lasts_until_a_reboot(bench: Bench) -> None:
    bench.run(GYRO_ZERO_US)  # type: ignore[attr-defined]
    supervisor = bench.firmware.signals.supervisor
    assert ask(bench, ControlAction.STOP) == Answer(())
    bench.turn()
    bench.turn()
    assert (supervisor.state, supervisor.cause) == (State.FAILSAFE, Cause.EMERGENCY_STOP)
    assert "refuses" in ask(bench, ControlAction.ARM).error
    bench.turn()
    assert (supervisor.state, supervisor.cause) == (State.FAILSAFE, Cause.EMERGENCY_STOP)


@pytest.mark.long
def test_arming_leaves_what_can_be_left(bench: Bench) -> None:
    bench.run(GYRO_ZERO_US)  # type: ignore[attr-defined]
    supervisor = bench.firmware.signals.supervisor
    supervisor.arm(False)
    supervisor.stop()
    bench.run(
        bench.now_us + 200_000
    )  # a Crazyflie's supervisor needs some of its steps of 40 ms between two armings
    assert ask(bench, ControlAction.ARM) == Answer(())
    for _ in range(4):
        bench.turn()
    assert supervisor.state is State.WAITING


def test_a_stop_of_which_only_the_question_arrives_is_sent_again(bench: Bench) -> None:
    losses = iter([True])
    bench.lossy = lambda: next(losses, False)
    assert ask(bench, ControlAction.STOP) == Answer(())
    assert bench.firmware.signals.supervisor.stopped


@pytest.mark.long
def test_an_impossible_request_is_refused_in_one_line(bench: Bench) -> None:
    assert ask(bench, ControlAction.STOP) == Answer(())
    bench.run(GYRO_ZERO_US)  # type: ignore[attr-defined]
    told = ask(bench, ControlAction.ARM)
    assert "refuses" in told.error
    assert "\n" not in told.error


def test_over_mavlink_a_refusal_and_its_reason_are_one_line() -> None:
    bench = MavlinkBench()
    assert ask(bench, ControlAction.STOP) == Answer(())
    bench.run(GYRO_ZERO_US)
    bench.turn()
    bench.link.texts.clear()
    assert ask(bench, ControlAction.ARM).error == (
        "the board refuses COMPONENT_ARM_DISARM: temporarily rejected: not armed: emergency stop; reboot first"
    )
    assert list(bench.link.texts) == []


@pytest.mark.long
def test_a_line_that_loses_much_delays_and_spoils_nothing(bench: Bench) -> None:
    rng = np.random.default_rng(1)
    bench.lossy = lambda: bool(rng.random() < 0.15)
    assert ask(bench, ControlAction.WRITE, "extCtrl.y_P", -1.5).error == ""
    assert on_board(bench, "extCtrl.y_P") == -1.5
    values = dict(ask(bench, ControlAction.LIST).values)
    assert values[bench.name("extCtrl.y_P")] == -1.5
    assert len(values) == bench.listed
    assert ask(bench, ControlAction.STOP).error == ""


@pytest.mark.long
def test_a_board_that_is_not_there_is_an_error_after_two_seconds(bench: Bench) -> None:
    bench.lossy = lambda: True
    begin_us = bench.now_us
    for action in ControlAction:
        begin_us = bench.now_us
        assert ask(bench, action, "extCtrl.y_P", 1.0).error == "no answer within 2 s"
        assert PATIENCE_US <= bench.now_us - begin_us <= PATIENCE_US + REPEAT_US + 2 * TURN_US


@pytest.mark.long
def test_a_new_request_replaces_the_one_before(bench: Bench) -> None:
    """A stop does not wait until a long list is there."""
    bench.controls.ask(bench.now_us, ControlRequest(ControlAction.READ, "extCtrl.y_P"))
    while bench.controls.busy:  # its answer is there, but nobody takes it
        bench.turn()
    bench.controls.ask(bench.now_us, ControlRequest(ControlAction.LIST))
    bench.turn()
    assert ask(bench, ControlAction.STOP) == Answer(())
    assert bench.firmware.signals.supervisor.stopped
    for _ in range(100):
        bench.turn()
        assert bench.controls.answer(bench.now_us) is None


@pytest.mark.long
def test_every_value_of_a_profile_is_the_board_s_times_the_factor() -> None:
    """A board that boots with the values has the same parameters as one to which they are written."""
    bench, values = CrtpBench(), {}
    for row, key in enumerate(table.OF_PROFILE):
        section, _, field = key.partition(".")
        field, _, element = field.rstrip("]").partition("[")
        before = getattr(getattr(load_config(), section), field)
        before = before[int(element)] if element else before
        value = type(before)(float(f"{(0.75 + 0.003 * row) * before or 0.01:.3g}"))  # trims are whole
        values[key] = (not before) if isinstance(before, bool) else value
    flashed = Firmware(
        load_config("floaty", [f"{key}={str(value).lower()}" for key, value in values.items()]), bench
    )
    read = {one.name: one.read for one in flashed.parameters}
    for key, value in values.items():
        name, factor = table.on_board(key)
        before = on_board(bench, name)
        assert ask(bench, ControlAction.WRITE, name, factor * value).error == ""
        assert on_board(bench, name) == pytest.approx(read[name](), rel=1e-6)
        assert on_board(bench, name) != before


def test_a_parameter_that_can_only_be_read_is_not_written() -> None:
    bench = CrtpBench()
    assert ask(bench, ControlAction.WRITE, "cpu.flash", 1.0).error == "cpu.flash: can only be read"
    assert dict(ask(bench, ControlAction.READ, "cpu.flash").values) == {"cpu.flash": 1024}
    bench.known["cpu.id1"] = replace(bench.known["cpu.id1"], number=9999)
    assert "does not report it" in ask(bench, ControlAction.READ, "cpu.id1").error


@pytest.mark.parametrize("link", BENCHES)
def test_a_full_link_is_offered_its_frame_at_each_tick_and_then_gets_it_once(link: str) -> None:
    bench: Any = BENCHES[link]()
    offered, leaves = list[tuple[int, bytes, bool]](), {"crtp": "radio_send", "mavlink": "uart_write"}[link]
    leave = getattr(bench, leaves)

    def offer(data: bytes) -> bool:
        taken = leave(data)
        offered.append((bench.now_us, bytes(data), taken))
        return bool(taken)

    setattr(bench, leaves, offer)
    bench.run(500_000)
    for _ in range(2):
        bench.radio_open, bench.uart_room = False, 0
        bench.firmware.radio_received(b"\xfcecho")
        offered.clear()
        while not offered:
            bench.run(bench.now_us + 10_000)
        bench.run(bench.now_us + 50_000)
        waiting = [one for one in offered if one[1] == offered[-1][1]]
        assert len(waiting) > 20
        ticks = [at_us // TICK_US for at_us, *_ in waiting]
        assert ticks == [*range(ticks[0], ticks[0] + len(ticks))]
        bench.radio_open, bench.uart_room = True, 1 << 30
        bench.run(bench.now_us + 5_000)
        assert [one[2] for one in offered if one[1] == waiting[0][1]] == [False] * len(waiting) + [True]


@pytest.mark.parametrize("action", [ControlAction.READ, ControlAction.WRITE])
@pytest.mark.parametrize("scalar", [Scalar.U8, Scalar.F32])
def test_a_reply_cut_anywhere_is_none_and_an_error_needs_no_value(
    action: ControlAction, scalar: Scalar
) -> None:
    controls = CrtpControls(lambda data: None, lambda: {"a.b": TocEntry(258, scalar, True, False)})
    reads = action is ControlAction.READ
    status = bytes(1) if reads else b""
    whole = crtp.Packet(crtp.PORT_PARAMETERS, 1 if reads else 2, b"\2\1" + status + scalar.pack(3))
    for _ in range(2):
        controls.ask(0, ControlRequest(action, "a.b", 3.0))
        for size in range(len(whole.data)):
            assert not controls.receive(0, replace(whole, data=whole.data[:size]))
        assert controls.answer(0) is None
        assert controls.receive(0, whole)
        assert controls.answer(0) == Answer((("a.b", 3),))
    if reads:
        controls.ask(0, ControlRequest(action, "a.b"))
        assert controls.receive(0, replace(whole, data=b"\2\1\2"))
        assert controls.answer(0) == Answer((), "a.b: the board does not report it: error 2")
