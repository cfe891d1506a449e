"""Robots on one time line, without a wall clock: let go, lost, put back, rebooted, faulted; alone and beside others."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.firmware import Firmware
from firmware_py.wire.crtp import PORT_CONSOLE
from ground_station.trajectory import Goal
from hil import fly
from hil.board.board_firmware import PowerOn, PythonBoard
from hil.board.clock import FreeRunning, Paced
from hil.board.uart import VirtualSerial
from hil.config import load_config
from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.nrf51 import Power
from hil.emulator.crazyflie.shockburst import TURN_ROUND_US, air_us, syslink_us
from hil.emulator.events import EventQueue
from hil.errors import LabError
from hil.laboratory.experiments import find_experiment
from hil.laboratory.faults import Fault, parse
from hil.laboratory.laboratory import Laboratory
from hil.laboratory.lockstep import ModelledLine, lockstep_flight
from hil.laboratory.request import Bench as FlightBench
from hil.laboratory.request import Request
from hil.laboratory.robot import Ports, Robot, Site, Streams, nobody_listens
from hil.servers.built_in_station import fly_built_in
from hil.servers.live_faults import LiveFaults
from hil.servers.server import Server, Service

SECOND_US = 1_000_000


class Bench:
    """A served robot that flies with the built-in station, on a free-running clock."""

    def __init__(self, faults: tuple[Fault, ...] = (), number: int = 1, seed: int = 1) -> None:
        self.said: list[str] = []
        self.server = Server(Service(load_config(), number, seed, faults=faults), self.said.append)
        self.server.lab.clock = FreeRunning()
        fly_built_in(self.server.robot)

    def fly(self, duration_s: float) -> list[str]:
        """Go on for a while; returns what was said meanwhile."""
        before = len(self.said)
        lab = self.server.lab
        lab.end_at(lab.now_us + round(duration_s * SECOND_US))
        lab.run()
        return self.said[before:]

    @property
    def robot(self) -> Robot:
        return self.server.robot


@pytest.mark.long
def test_a_robot_flies_in_its_holder_for_a_second_before_each_release() -> None:
    bench = Bench((parse("push.x@0:0.1=5"),))

    def heard_s(words: str) -> float:
        while not any(words in text for text in bench.fly(0.01)):
            assert bench.server.lab.now_us < 10 * SECOND_US
        return bench.server.lab.now_us / SECOND_US

    flying_s, released_s = heard_s("supervisor: flying"), heard_s("released")
    assert released_s - flying_s == pytest.approx(1.0, abs=0.03)
    lost_s = heard_s("it is put back")
    assert not bench.robot.free
    released_s = heard_s("released")
    assert bench.robot.free
    assert released_s - lost_s == pytest.approx(2.0, abs=0.03)
    assert sum("supervisor" in text for text in bench.said) == 1
    assert not any(
        "it is put back" in text for text in bench.fly(1.0)
    )  # the fault was that of the first release


@pytest.mark.long
def test_a_robot_that_is_lost_is_put_back_after_a_second_and_flies_again_among_the_same_faults() -> None:
    bench = Bench((parse("push.x@0.5:0.5=20"), parse("servo.slow.1@0.2=0.9")))
    said = bench.fly(12.0)
    assert sum("it is put back" in text for text in said) == 1
    assert sum(text.endswith("released") for text in said) == 2
    assert bench.robot.free
    assert bench.robot.body.servo_speed[0] == pytest.approx(0.9)  # the servo is as slow as before


@pytest.mark.long
def test_a_robot_of_a_swarm_flies_as_one_alone_with_its_seed() -> None:
    third, alone = Bench(number=3, seed=5), Bench(seed=7)
    for bench in (third, alone):
        bench.fly(3.0)
    ours, theirs = third.robot, alone.robot
    assert ours.body.state.tolist() == theirs.body.state.tolist()
    assert ours.firmware.signals.estimate.tolist() == theirs.firmware.signals.estimate.tolist()
    assert third.server.served.uri == "radio://0/80/2M/E7E7E7E703"


@pytest.mark.long
def test_firmware_that_waits_for_every_instant_flies_as_one_that_runs_ahead() -> None:
    """What a wall clock does to the time line, on one that never sleeps."""

    class Instant(Paced):
        def ahead_us(self, now_us: int) -> int:
            return 0

    ahead, waiting = Bench(), Bench()
    waiting.server.lab.clock = Instant()
    ahead.fly(2.5)
    waiting.fly(2.5)
    assert ahead.robot.body.state.tolist() == waiting.robot.body.state.tolist()
    assert ahead.robot.firmware.signals.estimate.tolist() == waiting.robot.firmware.signals.estimate.tolist()


@pytest.mark.long
def test_power_off_stops_a_board_which_boots_with_its_memories_and_a_new_clock() -> None:
    bench = Bench()
    bench.fly(3.0)
    served, robot = bench.server.served, bench.robot
    robot.board.eeprom[100:103] = b"abc"
    before, counts = robot.firmware, robot.firmware.signals.count.tolist()
    served.nrf51.hear(bench.server.lab.now_us, b"\xff\xfe\x02")  # the power switch: system off
    assert served.nrf51.power is Power.RADIO_ONLY
    bench.fly(0.5)
    assert before.signals.count.tolist() == counts
    served.nrf51.hear(bench.server.lab.now_us, b"\xff\xfe\x03")  # system on
    bench.fly(0.05)
    assert robot.firmware is not before
    assert bytes(robot.board.eeprom[100:103]) == b"abc"
    assert 0 < robot.firmware.kernel.now_us <= 60_000
    assert robot.booted_us > 3 * SECOND_US
    for requests, off in (
        ((b"\xff\xfe\x01",), Power.OFF),
        ((b"\xff\xfe\xff", b"\xff\xfe\xf0\x00"), Power.BOOTLOADER),
    ):
        for request in requests:
            served.nrf51.hear(bench.server.lab.now_us, request)
        for duration_s, power in ((4.95, off), (0.1, Power.RUNNING)):  # until somebody presses the button
            bench.fly(duration_s)
            assert served.nrf51.power is power


@pytest.mark.long
def test_a_processor_that_hangs_is_reset_by_its_watchdog_and_goes_on_under_the_same_load() -> None:
    bench = Bench((parse("cpu.load@0.5:0.4=1"),))
    said = bench.fly(8.0)
    assert sum("watchdog" in text for text in said) == 1
    assert sum("gyro zero found" in text for text in said) == 2  # it booted again
    assert bench.robot.thief.share == 0.0


def test_each_boot_has_the_failures_before_the_same_load_and_a_board_whose_time_begins() -> None:
    begun: list[int] = []
    sent: list[bytes] = []

    class Failing(PythonBoard):
        """An executor whose firmware fails at each boot, as an image can."""

        def boot(self, start: PowerOn) -> Firmware:
            begun.append(start.board.now_us)  # type: ignore[attr-defined]
            assert start.board.radio_send(b"lost: it boots")
            firmware = super().boot(start)
            firmware.flashed = SimpleNamespace(failures=[f"boot {len(begun)}"], resets=0)  # type: ignore[misc]
            return firmware

    site = Site(load_config(), EventQueue(), Streams.of_seed(0), lambda *_: None, Failing())
    robot = Robot(site, Ports(lambda now_us, data: not sent.append(data)))
    robot.thief.share = 0.5
    for boots in (1, 2, 3):
        assert robot.failures == tuple(f"boot {number}" for number in range(1, boots + 1))
        assert begun[-1] == robot.booted_us
        robot.run(robot.booted_us + 20_000)
        scheduler = robot.firmware.scheduler
        times = dict(zip((task.name for task in scheduler.tasks), scheduler.run_times_us(), strict=True))
        assert times["THIEF"] == pytest.approx(10_000, abs=500)
        robot.boot(robot.booted_us + SECOND_US)
    assert sent == []


@pytest.mark.long
def test_a_line_passes_the_pilots_notices_once_and_a_peers_packet_after_its_time() -> None:
    flight = lockstep_flight(Request.of(find_experiment("hover"), duration_s=0.1))
    line, heard = flight.line, []
    assert isinstance(line, ModelledLine)
    line._pilot = SimpleNamespace(notices=["armed"])  # type: ignore[assignment]
    assert [line.new_messages(0).count(("station", "armed")) for _ in range(2)] == [1, 0]
    line.robot.packet_received = lambda *what: heard.append(what)  # type: ignore[method-assign]
    packet = bytes(10)
    line.hear_peer(7_000, packet)
    line.radio.medium.uplink_loss = 1.0
    line.hear_peer(8_000, b"lost")
    flight.run()
    at_us = 7_000 + TURN_ROUND_US + air_us(10, 2_000_000) + syslink_us(packet)
    assert [one for one in heard if one[2:]] == [(at_us, packet, True)]


@pytest.mark.long
def test_the_battery_of_a_served_robot_empties() -> None:
    bench = Bench()
    full = bench.robot.battery.charge
    bench.fly(4.0)
    assert bench.robot.battery.charge < full
    assert bench.robot.board.battery_mv == bench.robot.battery.millivolts


def live(bench: Bench) -> tuple[Callable[[str], None], list[str]]:
    answers: list[str] = []
    faults = LiveFaults(bench.server, answers.append)
    return lambda line: faults.execute_line(line, bench.server.lab.now_us), answers


@pytest.mark.long
def test_a_typed_fault_acts_at_once_and_ends_by_itself() -> None:
    bench = Bench()
    type_line, answers = live(bench)
    bench.fly(3.0)
    type_line("1 push.y:0.2=0.5")
    assert bench.robot.body.pushes.tolist() == [0.0, 0.5, 0.0, 0.0, 0.0, 0.0]
    bench.fly(0.19)
    assert bench.robot.body.pushes.any()
    bench.fly(0.02)
    assert not bench.robot.body.pushes.any()
    type_line("wind.side_y=0.5")
    type_line("wind.side_y=0.25")
    assert bench.robot.body.tunnel.side_wind[1] == pytest.approx(0.75)
    type_line("clear")
    assert bench.robot.body.tunnel.side_wind[1] == 0.0
    assert answers == []
    assert any(text.endswith("fault push.y:0.2=0.5 ends") for text in bench.said)


@pytest.mark.long
def test_a_typed_status_lists_the_faults_and_whether_the_robot_is_held() -> None:
    bench = Bench()
    type_line, answers = live(bench)
    bench.fly(0.5)
    type_line("mocap.dropout:inf")
    assert answers == ["robot 1 is held: what moves it has no effect before it is released"]
    type_line("status")
    assert answers[1].startswith("robot 1: held, ")
    assert answers[1].endswith("; faults: mocap.dropout:inf=1; radio://0/80/2M/E7E7E7E7E7")
    bench.robot.cut_power()
    type_line("status")
    assert answers[2].startswith("robot 1: without power")


@pytest.mark.long
def test_a_radio_that_a_client_has_moved_is_reported_where_it_stays_and_returns_with_a_restart() -> None:
    bench = Bench()
    type_line, answers = live(bench)
    served = bench.server.served
    bench.fly(1.0)
    for channel in (
        3,
        37,
        37,
    ):  # as a program that scans and repeats what it sends before the radio has moved
        served.nrf51.hear(bench.server.lab.now_us, bytes((0xFF, 3, 1, channel)))
        if channel == 3:
            bench.fly(0.1)
    bench.fly(2.0)
    moved = [text for text in bench.said if "moved the radio" in text]
    assert moved == ["board 1: a client moved the radio to radio://0/37/2M/E7E7E7E7E7; restart moves it back"]
    served.nrf51.hear(bench.server.lab.now_us, bytes((0xFF, 3, 1, 80)))
    bench.fly(2.0)
    assert bench.said[-1] == "board 1: a client moved the radio back to radio://0/80/2M/E7E7E7E7E7"
    served.nrf51.hear(bench.server.lab.now_us, bytes((0xFF, 3, 1, 37)))
    bench.fly(0.1)
    type_line("status")
    assert answers[-1].endswith("radio://0/37/2M/E7E7E7E7E7")
    type_line("restart")
    assert served.uri == "radio://0/80/2M/E7E7E7E7E7"
    assert sum("gyro zero found" in text for text in bench.said) == 1
    bench.fly(6.0)  # it booted in flight: lost, put back
    assert sum("gyro zero found" in text for text in bench.said) == 2


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("push.w=2", "unknown kind 'push.w'; did you mean push"),
        ("push.y=200", "size 200: expected -20..20 N"),
        ("push.y=a", "fault 'push.y=a': duration and size are numbers; help lists"),
        ("push.y@3=2", "expected KIND[:DURATION][=SIZE], like mocap.dropout:0.5"),
        ("push.y:-1=2", "fault push.y: duration -1 s: expected more than 0, or inf"),
        ("push.y:nan", "fault push.y: duration nan s"),
        ("statos", "'statos' is unknown; did you mean status?"),
        ("\\xff\\x00", "unknown kind"),
        ("status", "robot 1: held, calibrating; faults: none"),
        ("1 status", "robot 1: held"),
        ("3 push.y", "robot 3: expected 1..1"),
        ("serial.cut", "acts with --link mavlink only; this robot has no serial line"),
        ("marker.swap", "needs --set markers.enabled=true"),
        ("help", "lets a fault act on robot N"),
        ("kinds", "mocap.dropout"),
    ],
)
def test_an_impossible_typed_line_is_answered_and_changes_nothing(line: str, answer: str) -> None:
    bench = Bench()
    type_line, answers = live(bench)
    type_line(line)
    assert answer in " ".join(answers)
    assert bench.server.switchboard.active == []


def test_a_packet_to_a_board_without_power_is_lost() -> None:
    bench = Bench()
    bench.robot.cut_power()
    bench.robot.packet_received(0, bytes((PORT_CONSOLE << 4,)))
    bench.robot.uart_ready(0)
    assert bench.fly(0.1) == []


def test_progress_is_shown_at_most_every_quarter_of_a_second_also_after_a_gap() -> None:
    lab, shown = Laboratory(FreeRunning()), list[int]()
    for ms in (20, 100, 900, 910, 920, 1_149, 1_151):
        lab.events.at(1_000 * ms, lambda _: None)
    lab.end_at(1_160_000)
    lab.run(shown.append)
    assert shown == [100_000, 900_000, 1_151_000]


def test_an_experiment_that_plans_events_at_one_instant_without_end_is_one_clear_line() -> None:
    lab = Laboratory(FreeRunning())

    def push(now_us: int) -> None:
        lab.events.at(now_us, push)

    lab.events.at(SECOND_US, push)
    lab.end_at(2 * SECOND_US)
    with pytest.raises(LabError, match=r"push at 1\.000000 s of simulated time: .* plan the next one later"):
        lab.run()


def site_in(lab: Laboratory) -> Site:
    return Site(load_config(), lab.events, Streams.of_seed(1), lambda source, text: None)


def test_a_rebooted_board_talks_on_its_serial_line_by_the_laboratorys_clock() -> None:
    lab = Laboratory(FreeRunning())
    site = site_in(lab)
    uart = VirtualSerial(site.config.serial, lab.events, site.streams.serial)
    robot = Robot(site, Ports(nobody_listens, uart=uart))
    heard: list[int] = []
    uart.connect(robot.uart_ready, lambda now_us, data: heard.append(now_us))
    lab.add(robot)
    robot.watch(0)
    lab.events.at(2 * SECOND_US, lambda _: robot.cut_power())
    lab.events.at(3 * SECOND_US, robot.boot)
    lab.end_at(5 * SECOND_US)
    lab.run()
    assert sum(now_us < 2 * SECOND_US for now_us in heard) > 20
    assert [now_us for now_us in heard if 2_010_000 < now_us < 3 * SECOND_US] == []
    assert sum(now_us > 3 * SECOND_US for now_us in heard) > 20


@pytest.mark.parametrize(
    ("kind", "powered"),
    [(syslink.SWITCH_OFF, False), (syslink.STM32_OFF, False), (syslink.RADIO_POWER, True)],
)
def test_a_firmware_without_a_client_can_switch_its_board_off(kind: int, powered: bool) -> None:
    lab = Laboratory(FreeRunning())
    robot = Robot(site_in(lab), Ports(nobody_listens))
    lab.add(robot)
    lab.events.at(SECOND_US, lambda _: robot.board.radio_command(kind, b""))
    lab.end_at(2 * SECOND_US)
    lab.run()
    assert robot.powered is powered


def test_a_crazyflie_s_goals_begin_and_end_on_the_floor() -> None:
    request = Request(find_experiment("hover"), "crazyflie", (), 0, 12.0, (), FlightBench(board="cf2.elf"))
    floor, home, times = (
        Goal((0.0, 0.0, pytest.approx(0.0145)), 0.0),
        Goal((0.0, 0.0, 1.0), 0.0),
        request.times,
    )
    assert times is not None
    assert request.trajectory.at(0) == request.trajectory.at(20_000_000) == floor
    assert request.trajectory.at(times.begin_us) == request.trajectory.at(times.land_us) == home


def test_a_flight_whose_experiment_cannot_be_prepared_closes_its_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    closed, close = [], ModelledLine.close
    monkeypatch.setattr(ModelledLine, "close", lambda line: closed.append(close(line)))

    def fail(robot: Any) -> None:
        raise LabError("not ready")

    with pytest.raises(LabError, match="not ready"):
        fly(replace(find_experiment("hover"), prepare=fail), tmp_path / "run", duration_s=0.1)
    assert len(closed) == 1
