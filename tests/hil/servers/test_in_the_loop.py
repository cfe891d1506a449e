"""A board flies with the host's gyro samples: the exported app and the laboratory on one time line, with a bad link."""

import ctypes
from pathlib import Path

import pytest

from firmware_py.core.structs import Estimator
from firmware_py.wire.core_port import (
    CHANNEL_LOOP,
    HIL_HOLD,
    HIL_WAITING,
    PORT_CORE,
    SAMPLES_MAX,
    Hil,
    Loop,
    decode_loop,
    encode_samples,
    loop,
)
from firmware_py.wire.crtp import encode_ext_pose
from firmware_py.wire.supervisor import Cause, State
from ground_station.errors import LinkError
from ground_station.links import packets
from ground_station.links.core_client import CoreClient
from hil.board.clock import FreeRunning, Paced
from hil.board.real_firmware import RealBoard
from hil.board.sample_window import WINDOW
from hil.laboratory.experiments import find_experiment
from hil.laboratory.faults import parse
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import Result
from hil.laboratory.flight import Flight
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures.report import write_report
from hil.servers.in_the_loop import flight_in_the_loop
from support.app_air import AppAir
from support.command import Cli
from support.crazyflie_app import App, build_app

URI = "udp://127.0.0.1:9"
POSE = encode_ext_pose((0.01, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 40_000)[1:]


@pytest.fixture
def app(library: Path, tmp_path: Path) -> App:
    app = App(library, tmp_path / "copy.so")
    app.boot()
    return app


# The board's end


class Host:
    """Sends samples to an app and steps it, a millisecond each."""

    def __init__(self, app: App, mode: Hil = Hil.STILL) -> None:
        self.app = app
        self.step = 0
        self.count = 0
        self.looped: list[Loop] = []
        self.client = CoreClient(AppAir(app), "app")
        self.client.begin()
        self.client.execute([loop(mode)])

    def send(
        self, sample: tuple[int, int, int] = (3, -2, 1), number: int | None = None, count: int = 1
    ) -> None:
        data, _ = encode_samples(self.count if number is None else number, [sample] * count)
        self.app.radio(data, PORT_CORE, CHANNEL_LOOP)
        self.count += count if number is None else 0

    def run(self, steps: int, *, sending: bool = True, poses: bool = False) -> None:
        for _ in range(steps):
            if sending:
                self.send((3, -2, self.step % 2))
            self.step += 1
            if poses and self.step % 20 == 0:
                self.app.radio(POSE)
            self.app.step(self.step)
            while packet := self.app.sent():
                assert packet[0] == PORT_CORE << 4 | CHANNEL_LOOP
                self.looped.append(decode_loop(packet[1:]))


@pytest.fixture
def host(app: App) -> Host:
    return Host(app)


def test_a_board_reports_state_and_counts_at_100_hz(host: Host) -> None:
    host.run(1000, poses=True)
    assert len(host.looped) == 99
    told = host.looped[-1]
    assert (told.state, told.cause) == (State.FLYING, Cause.NONE)
    assert told.counts == tuple(int(host.app.log(f"floaty.m{i}")) for i in (1, 2, 3, 4))
    assert (told.late, told.lost, told.doubled) == (0, 0, 0)
    assert (told.fused, 100 * told.age) == (
        host.app.log("kalman.fused"),
        1000 * host.app.log("locSrv.age") // 10,
    )
    assert told.fused > 0


def test_samples_are_taken_one_a_step_when_enough_wait(host: Host) -> None:
    host.run(100)
    told = host.looped[-1]
    assert told.received in range(host.count - 10, host.count + 1)
    assert told.waiting in (HIL_WAITING - 1, HIL_WAITING)
    assert told.held == HIL_WAITING


def test_the_gyro_is_the_hosts_with_a_new_zero(host: Host) -> None:
    host.app.gyro[:] = (1000, 1000, 1000)
    assert not host.app.sampling.calibrated
    host.run(560, poses=True)
    assert host.app.sampling.calibrated
    assert host.looped[-1].state == State.FLYING
    assert max(rates(host.app)) < 0.01


def rates(app: App) -> list[float]:
    return [abs(app.log(f"stateEstimate.{axis}_rate")) for axis in ("roll", "pitch", "yaw")]


def test_the_zero_of_the_boards_own_gyro_does_not_act_in_the_loop(app: App) -> None:
    app.gyro[:] = (1000, 1000, 1000)
    for step in range(1, 601):
        app.step(step)
    assert app.supervisor.state == State.WAITING
    host = Host(app)
    host.step = 600
    host.run(200, poses=True)
    assert not app.sampling.calibrated
    assert max(rates(app)) < 0.01


def test_a_board_that_leaves_the_loop_waits_for_a_pose_of_its_own(host: Host) -> None:
    estimate = Estimator.dtype.fields["pose"][1]  # so many bytes; measurements and counters follow
    fresh = host.app.estimator()[:estimate]
    host.run(1004, poses=True)  # near a tick: a pose would count
    assert host.app.supervisor.state == State.FLYING
    assert host.app.estimator()[:estimate] != fresh
    host.client.execute([loop(Hil.OFF)])
    host.app.radio(
        encode_ext_pose((0.01, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)[1:]
    )  # the host's last, which waits
    host.run(1, sending=False)
    assert host.app.estimator()[:estimate] == fresh, "nothing of that flight is left"
    host.run(599, sending=False)
    assert (host.app.supervisor.state, host.app.supervisor.cause) == (State.WAITING, Cause.NONE)


def test_a_host_sends_corrections_whatever_the_board_s_poses_are(library: Path, tmp_path: Path) -> None:
    flown = []
    for absolute in (False, True):
        app = App(library, tmp_path / f"{absolute}.so")
        app.boot(absolute=absolute)
        for size in ("radius", "below", "above"):
            app.set(f"box.{size}", 5.0)
        host = Host(app)
        host.run(1200, poses=True)
        assert app.supervisor.state == State.FLYING
        flown.append((host.looped, app.estimator()))
    assert flown[0] == flown[1]


@pytest.mark.long
def test_a_mode_that_begins_while_a_sample_is_filed_begins_without_it(tmp_path: Path) -> None:
    """The stabilizer task preempts the receiving task between its reading `received` and its writing it."""
    preempted = (
        "{ const uint16_t before = received; extern int stub_locked; if (stub_locked) { stub_locked = 0; "
        "floaty_hil_switched(); } received = (uint16_t)(before + 1); }"
    )
    library = build_app(tmp_path / "app", plant=("floaty_hil.c", "received += 1;", preempted))
    app = App(library, tmp_path / "copy.so")
    app.boot()
    host = Host(app)
    host.run(100)
    app.c.floaty_hil_request(int(Hil.MOVING))
    app.locked.value = 1
    host.send()
    host.looped.clear()
    host.run(30, sending=False)
    assert [(told.used, told.waiting) for told in host.looped] == [(0, 0)] * 3


def test_servos_stay_at_hover_unless_they_are_to_move(library: Path, tmp_path: Path) -> None:
    for mode in (Hil.STILL, Hil.MOVING):
        app = App(library, tmp_path / f"{mode}.so")
        app.boot()
        hover = app.counts()
        host = Host(app, mode)
        host.run(1000, poses=True)
        assert list(host.looped[-1].counts) != hover
        assert app.counts() == (hover if mode == Hil.STILL else list(host.looped[-1].counts))
        host.client.execute([loop(Hil.OFF)])
        host.run(1, sending=False)
        assert app.counts() == hover


def test_a_board_that_flies_is_not_taken_into_the_loop(app: App) -> None:
    for step in range(1, 1001):
        if step % 20 == 0:
            app.radio(POSE)
        app.step(step)
    assert app.supervisor.state == State.FLYING
    with pytest.raises(LinkError, match=r"^app: it may be in the air: disarm it"):
        Host(app)
    assert app.sent() == b""


def gyro_sums(app: App) -> tuple[int, int, int]:
    """Return what the core has summed since the estimator's last tick."""
    x, y, z = app.data.gyro_sum.tolist()
    return x, y, z


def test_without_a_sample_the_flight_pauses_and_is_counted(host: Host) -> None:
    host.run(1000, poses=True)
    before = host.looped[-1]
    state = host.app.estimator()
    host.run(HIL_HOLD - 20, sending=False)
    told = host.looped[-1]
    assert told.held - before.held in range(HIL_HOLD - 20 - HIL_WAITING - 10, HIL_HOLD - 20)
    assert (told.state, told.late, told.fresh) == (State.FLYING, 0, 0)
    assert told.used == host.count
    host.app.c.stub_run_app(1)
    assert host.app.log("floaty.staleHovers") == 0
    stood = host.app.estimator()
    host.run(HIL_WAITING - 1, sending=False)
    assert host.app.estimator() == stood != state
    host.run(100, poses=True)
    assert (host.looped[-1].state, host.looped[-1].late, host.looped[-1].fresh) == (State.FLYING, 0, 1)
    for _ in range(10):  # each step of the tick is the last one before a pause
        host.run(41)
        host.run(HIL_WAITING, sending=False)
        host.looped.clear()
        host.run(20, sending=False)
        assert [told.fresh for told in host.looped] == [0, 0]


def test_a_loop_with_gaps_and_pauses_that_begins_again_is_like_the_first(host: Host) -> None:
    held = ctypes.c_uint32.in_dll(host.app.c, "floaty_hil_held")

    def leave() -> None:
        """Leave the loop until a step at which the core is in the same phase of its tick."""
        host.client.execute([loop(Hil.OFF)])
        host.run(10 + -(host.step - held.value) % 10, sending=False)

    def played() -> list[Loop]:
        begun = host.count
        host.looped.clear()
        host.client.execute([loop(Hil.STILL)])
        host.run(30, sending=False)  # reports from before the first sample
        host.run(100)
        host.run(HIL_HOLD + 100, sending=False)
        host.run(50)
        missing = host.count
        host.count += 4
        host.run(60)
        told = host.looped[-1]
        assert (told.lost, told.waiting, told.received) == (4, 0, missing), "what comes behind a gap waits"
        host.send(number=missing - 2, count=6)
        host.count = missing + 4
        host.run(60)
        leave()
        return [told._replace(used=max(0, told.used - begun), state=0, cause=0) for told in host.looped]

    leave()
    first = played()
    last = first[-1]
    assert min(last.used, last.held, last.late) > 0
    assert (last.lost, last.doubled) == (4, 2), "repeated ones are dropped"
    assert played() == first


def test_poses_do_not_age_in_a_pause(host: Host) -> None:
    host.run(1000, poses=True)
    host.run(HIL_WAITING + 2, sending=False)
    host.app.radio(POSE)
    host.run(100, sending=False)
    host.run(30)
    assert host.looped[-1].age in range(400, 600)


def test_a_second_step_in_a_paused_tick_is_not_silence(host: Host) -> None:
    host.run(1000, poses=True)
    host.run(HIL_WAITING + 5, sending=False)
    host.app.step(host.step)
    host.run(40)
    assert {told.state for told in host.looped[-5:]} == {State.FLYING}


def test_a_pause_ends_after_a_time_with_the_last_sample(host: Host) -> None:
    host.run(100)
    host.run(HIL_HOLD + 100, sending=False)
    told = host.looped[-1]
    assert told.held == HIL_WAITING + HIL_HOLD
    assert told.late in range(80, 101)
    assert told.used == host.count
    host.run(50)
    assert host.looped[-1].late in range(told.late, 101)


def test_64_samples_wait_and_none_beyond_them(host: Host) -> None:
    host.run(100)
    host.looped.clear()
    while not host.looped:
        host.run(1)
    used = host.looped[-1].used
    for _ in range(30):
        host.send(count=4)
    host.run(10, sending=False)
    told = host.looped[-1]
    assert (told.used, told.waiting, told.received, told.lost) == (used + 10, 64 - 10, used + 64, 0)


@pytest.mark.parametrize(
    "samples",
    [
        [(0, 0, 0), (511, -512, 1), (0, -1, -300), (-512, 500, 211), (-1, -1, -1), (7, 8, 9)],
        [(32767, -32768, 0), (-32768, 32767, 1), (32767, 0, 2), (0, 5, 3)],
        [(100, 100, 100), (101, 612, 100)],
        [(-5, 6, -7)],
    ],
    ids=["narrow", "wide", "one too wide", "one"],
)
def test_the_board_unpacks_the_samples_sent(host: Host, samples: list[tuple[int, int, int]]) -> None:
    data, count = encode_samples(0, samples)
    assert (count, len(data) <= 30) == (len(samples), True)
    host.run(3, sending=False)
    host.app.radio(data, PORT_CORE, CHANNEL_LOOP)
    for number in range(count, count + HIL_WAITING, 4):
        host.app.radio(encode_samples(number, [(0, 0, 0)] * 4)[0], PORT_CORE, CHANNEL_LOOP)
    sums = (0, 0, 0)
    for sample in samples:  # fewer than the nine before the estimator's first step
        host.run(1, sending=False)
        sums = tuple(a + b for a, b in zip(sums, sample, strict=True))
        assert gyro_sums(host.app) == sums


def test_a_packet_holds_as_many_samples_as_fit(host: Host) -> None:
    steady = [(100 * i, -100 * i, 0) for i in range(8)]
    assert encode_samples(0, steady)[1] == SAMPLES_MAX == 6
    wild = [(1000 * i, 0, 0) for i in range(8)]
    assert encode_samples(0, wild)[1] == 4
    assert encode_samples(0, [*steady[:5], (9000, 0, 0)])[1] == 5
    assert encode_samples(0, [*steady[:2], (9000, 0, 0), *wild])[1] == 4


def test_without_the_host_the_board_flies_on_for_a_time_then_enters_failsafe(host: Host) -> None:
    host.run(1000, poses=True)
    host.run(600, sending=False)
    assert host.looped[-1].state == State.FLYING
    assert host.looped[-1].late in range(600 - HIL_HOLD - 20, 600 - HIL_HOLD)
    host.run(170, sending=False)
    assert (host.looped[-1].state, host.looped[-1].cause) == (State.FAILSAFE, Cause.SILENCE)
    host.run(100, poses=True)
    assert host.looped[-1].state == State.FLYING


def test_a_host_that_is_gone_for_a_second_gives_the_board_its_own_gyro_back(host: Host) -> None:
    host.run(1000, poses=True)
    hover = host.app.counts()
    host.run(990 + HIL_WAITING, sending=False)
    told = len(host.looped)
    host.run(30, sending=False)
    assert len(host.looped) <= told + 2
    assert host.app.supervisor.state == State.CALIBRATING
    assert host.app.counts() == hover
    host.run(600, sending=False, poses=True)
    assert host.app.supervisor.state == State.FLYING


@pytest.mark.parametrize("again", [Hil.OFF, Hil.MOVING])
def test_a_board_without_samples_leaves_the_loop_after_a_second_unless_it_is_asked_again(
    host: Host, again: Hil
) -> None:
    mode = ctypes.c_uint8.in_dll(host.app.c, "floaty_hil_mode")
    host.run(1000, sending=False)
    assert mode.value == Hil.STILL
    assert [(told.held, told.late) for told in host.looped] == [(held, 0) for held in range(10, 1001, 10)]
    if again:
        host.client.execute([loop(again)])
    host.run(1, sending=False)
    assert mode.value == again


# Flights


def board_on(air: AppAir) -> RealBoard:
    return RealBoard(CoreClient(air, "app"), False, air)


def flown(
    folder: Path, app: App, duration_s: float, faults: tuple[str, ...] = (), **link: float
) -> tuple[Result, AppAir]:
    air = AppAir(app, **link)

    def flight_of(request: Request, telemetry: Path, *_: object) -> Flight:
        flight = flight_in_the_loop(request, board_on(air), FreeRunning(), telemetry)
        air.join(flight.events)
        return flight

    request = Request.of(
        find_experiment("hover"), duration_s=duration_s, board=URI, faults=tuple(map(parse, faults))
    )
    return fly(request, folder, flight_of=flight_of), air


@pytest.mark.long
def test_a_flight_in_the_loop_holds_all_limits_and_tells_the_loops_delay(app: App, tmp_path: Path) -> None:
    result, _ = flown(tmp_path / "run", app, 2.0, delay_us=3000)
    assert result.passed
    metrics = result.metrics
    assert metrics["failsafe"] == metrics["samples_late"] == metrics["samples_lost"] == 0
    assert metrics["samples_doubled"] == metrics["loop_stood"] == 0
    assert metrics["samples_held"] < 2 * HIL_WAITING
    assert metrics["loop_delay"] == pytest.approx((HIL_WAITING + 2 * 3 + 2) * 1e-3, abs=2e-3)
    assert metrics["loop_added"] == pytest.approx(3e-3, abs=1e-3)
    # A pose waits for the board's next step of the estimator, up to ten milliseconds.
    assert metrics["age_mean"] == pytest.approx(41e-3 + metrics["loop_added"], abs=6e-3)
    log = load_log(tmp_path / "run")
    assert max(log["motor.m1"].to_pylist()) > 34_000
    assert not {"rtos.measurements_dropped", "late.KALMAN"} & set(log.column_names)
    page = write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert "loop_delay" in page


@pytest.mark.long
@pytest.mark.parametrize(
    ("link", "stood_s"),
    [
        ({"delay_us": 3000}, 0.1),
        ({"delay_us": 8000}, 0.1),
        ({"delay_us": 3000, "transfer_us": 5000}, 4.0),
        ({"delay_us": 3000, "jitter_us": 5000, "loss": 0.1}, 15.0),
        ({"delay_us": 3000, "loss": 0.2}, 25.0),
        ({"delay_us": 60_000}, 120.0),
    ],
    ids=["radio", "slow", "narrow", "10 %", "20 %", "very slow"],
)
def test_hover_holds_over_any_link(app: App, tmp_path: Path, link: dict[str, float], stood_s: float) -> None:
    result, _ = flown(tmp_path / "run", app, 20.0, **link)
    assert result.passed, result.verdicts
    metrics = result.metrics
    assert metrics["failsafe"] == metrics["samples_late"] == 0
    assert metrics["loop_delay"] < 0.027
    assert stood_s / 4 - 0.1 <= metrics["loop_stood"] < stood_s
    assert (metrics["samples_lost"] > 500) == (link.get("loss", 0.0) > 0)


@pytest.mark.long
def test_a_loop_that_loses_a_third_of_all_packets_stays_in_the_box(app: App, tmp_path: Path) -> None:
    result, _ = flown(tmp_path / "run", app, 20.0, delay_us=3000, jitter_us=5000, loss=0.3)
    metrics = result.metrics
    assert (result.outcome, metrics["failsafe"]) == ("completed", 0)
    assert metrics["samples_lost"] > 5000
    assert metrics["in_box"] == 1.0
    assert metrics["loop_delay"] < 0.027


@pytest.mark.long
def test_a_link_that_queues_delays_the_flight_and_not_the_loop(app: App, tmp_path: Path) -> None:
    result, air = flown(tmp_path / "run", app, 1.0, delay_us=15_000, transfer_us=8_000)
    metrics = result.metrics
    assert metrics["loop_delay"] < WINDOW * 1e-3
    assert metrics["loop_stood"] > 2.0
    assert air.wall_us() * 1e-6 == pytest.approx(3.0 + metrics["loop_stood"], abs=0.1)


@pytest.mark.long
def test_only_lost_samples_are_sent_again(app: App, tmp_path: Path) -> None:
    result, _ = flown(tmp_path / "run", app, 1.0, loss=0.1)
    metrics = result.metrics
    assert metrics["samples_late"] == metrics["failsafe"] == 0
    assert metrics["samples_lost"] > 50
    assert metrics["samples_doubled"] < 0.2 * metrics["samples_lost"]


@pytest.mark.long
def test_faults_of_plant_and_cameras_act_in_the_loop(app: App, tmp_path: Path) -> None:
    result, _ = flown(tmp_path / "run", app, 2.0, ("mocap.dropout@0.5:0.8", "push.y@0.2=0.5"))
    assert result.metrics["failsafe"] == pytest.approx(0.3, abs=0.1)
    assert result.metrics["max_y"] > 0.01


def test_a_board_that_dies_in_the_loop_ends_the_flight_in_one_line(app: App, tmp_path: Path) -> None:
    air = AppAir(app)

    def flight_of(request: Request, telemetry: Path, *_: object) -> Flight:
        flight = flight_in_the_loop(request, board_on(air), FreeRunning())
        air.join(flight.events)
        flight.events.at(2_500_000, lambda now_us: setattr(air, "dead", True))
        return flight

    request = Request.of(find_experiment("hover"), duration_s=10.0, board=URI)
    result = fly(request, tmp_path / "run", flight_of=flight_of)
    assert (result.outcome, result.cause) == ("error", "board app: silent for 1 s")
    assert load_log(tmp_path / "run").num_rows in range(248, 256)


@pytest.mark.long
@pytest.mark.parametrize(("drift", "slower"), [(2e-3, True), (-2e-3, False)])
def test_the_plants_clock_follows_the_boards(app: App, tmp_path: Path, drift: float, slower: bool) -> None:
    air = AppAir(app, drift=drift)
    request = Request.of(find_experiment("hover"), duration_s=4.0, board=URI)
    flight = flight_in_the_loop(request, board_on(air), FreeRunning())
    air.join(flight.events)
    flight.run()
    assert (sum(air.slewed[-100:]) > 0) == slower
    assert max(map(abs, air.slewed)) <= 1000


def test_a_paced_clock_can_be_moved() -> None:
    clock = Paced()
    clock.shift(1000)
    clock.start(0)
    ahead_us = clock.ahead_us(500_000)
    clock.shift(300_000)
    assert clock.ahead_us(500_000) > ahead_us + 200_000


def test_processor_time_of_a_real_board_cannot_be_taken(app: App) -> None:
    request = Request.of(find_experiment("overload"), duration_s=1.0, board=URI)
    air = AppAir(app)
    with pytest.raises(Exception, match="the processor time of a real board cannot be taken"):
        flight_in_the_loop(request, board_on(air), FreeRunning())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--hil",), "--hil: --board c --link radio: expected the link to a real board as --board"),
        (("--hil", "--board", URI, "--link", "mavlink"), "expected the link to a real board as --board"),
        (("--hil", "shaking", "--board", URI), "'shaking' is not one of 'still', 'moving'"),
        (("--hil", "--board", URI, "--seeds", "2"), "--seeds 2: a real board is in one flight at a time"),
        (("--hil", "--board", URI), f"--board {URI}: silent for 3 s"),
    ],
)  # fmt: skip
def test_impossible_loops_are_refused_in_one_line(
    cli: Cli, app: App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    air = AppAir(app)
    air.silent = True
    monkeypatch.setattr(packets, "CflibPackets", lambda uri: air)
    assert cli("fly", "hover", *arguments) == 2
    assert said in cli.err
