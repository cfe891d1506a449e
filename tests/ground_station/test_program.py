"""The whole life of a station on a simulated clock: lines and their instants, a lost link, and the end."""

import sys
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any

import pytest

from firmware_py.extras import install_command
from firmware_py.wire import WireError
from firmware_py.wire.supervisor import State
from firmware_py.wire.telemetry import CONTROL, Sample
from ground_station import operator, program
from ground_station.config import GroundConfig, LinkSettings, TrackerConfig
from ground_station.controls import Answer, ControlAction, ControlRequest, ControlsError
from ground_station.errors import LinkError, MocapError
from ground_station.latency import LinkLatency
from ground_station.mocap import MocapFrame
from ground_station.program import LoopHook, Session, StationSession, fly, run_until
from ground_station.sources import replay
from ground_station.sources.replay import ReplaySource, read_frames
from ground_station.terminal import Terminal
from ground_station.trajectory import Goal, Offsets, Step, Trajectory

FRAME_US = 20_000
EPOCH_US = 1_700_000_000_000_000


class Room:
    """Clock, cameras and board: blind and lost between instants [s]; it flies from 2 s on, and `says` what happens when."""

    uri = "room"
    latency = LinkLatency("air", 0, measured=False)
    frame_us = FRAME_US

    def __init__(
        self, blind: tuple[float, float], lost: tuple[float, float], in_failsafe: bool = True
    ) -> None:
        self.now_us, self.blind, self.lost, self.ends_in_failsafe = 0, blind, lost, in_failsafe
        self.says: list[tuple[float, str]] = []
        self.goals: list[tuple[int, Goal]] = []
        self.ages_us: list[int] = []  # of the poses, when the link got them
        self.connects_s = 0.0
        self.sends: tuple[Sample, ...] = ()  # by the board in each turn
        self.settings: LinkSettings | None = None
        self._next_us, self._muted_us = 0, inf

    def say(self, text: str) -> None:
        self.says.append((self.now_us * 1e-6, text))

    def instants(self, begin: str) -> list[float]:
        return [t_s for t_s, text in self.says if text.startswith(begin)]

    def _in(self, span: tuple[float, float]) -> bool:
        return span[0] <= self.now_us * 1e-6 < span[1]

    # Cameras

    def receive(self, timeout_or_us: float, data: bytes | None = None) -> MocapFrame | list[Sample] | None:
        if data is not None:  # of the link
            return list(self.sends)
        end_us = self.now_us + round(1e6 * timeout_or_us)
        if self._in(self.blind):
            self._next_us = max(self._next_us, end_us // FRAME_US * FRAME_US + FRAME_US)
        if self._next_us > end_us:
            self.now_us = end_us
            return None
        self.now_us, exposed_us = max(self.now_us, self._next_us), self._next_us
        self._next_us += self.frame_us
        return MocapFrame(exposed_us, (0.0, 0.0, 1.15), (1.0, 0.0, 0.0, 0.0), True)

    # Link

    def open(self, give_up: Callable[[], bool]) -> None:
        self.say("opened")
        for _ in range(12):
            self.now_us += round(1e6 * self.connects_s) // 12
            assert not give_up()
        if self._in(self.lost):
            raise LinkError("not there")
        self._muted_us = inf

    def check(self) -> None:
        if self._in(self.lost):
            raise LinkError(f"lost at {self.now_us * 1e-6:.0f} s")

    @property
    def supervisor_state(self) -> State | None:
        if self.now_us > self._muted_us + 500_000 and self.ends_in_failsafe:
            return State.FAILSAFE
        if self._muted_us < inf:
            return None
        return State.FLYING if self.now_us > 2_000_000 else State.WAITING

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        self.goals.append((now_us, goal))
        self.ages_us.append(now_us - frame.t_us)

    def mute(self) -> None:
        self._muted_us = self.now_us

    def close(self) -> None:
        self.say("closed")

    def received(self) -> list[tuple[int, bytes]]:
        return [(self.now_us, b"")] if self.sends else []

    def notices(self) -> list[str]:
        return []

    def summary(self) -> str:
        return ""

    def start_telemetry(self, now_us: int) -> None: ...


def flown(
    room: Room,
    monkeypatch: pytest.MonkeyPatch,
    until_s: float,
    hooks: tuple[LoopHook, ...] = (),
    **more: object,
) -> Room:
    in_room(room, monkeypatch)
    stopping = run_until(lambda: False, until_s)
    fly(GroundConfig(), Session("room", None, step, start_s=1.5, **more), room.say, stopping, hooks)  # type: ignore[arg-type]
    return room


def step(home: Goal, start_us: int) -> Trajectory:
    return Offsets(home, start_us, x=Step(0.1))


def in_room(room: Room, monkeypatch: pytest.MonkeyPatch) -> Room:
    """Let stations fly there."""
    monkeypatch.setattr(program, "clock_us", lambda: room.now_us)

    def find_link(uri: str, settings: LinkSettings) -> Room:
        room.settings = settings
        return room

    monkeypatch.setattr(program, "find_link", find_link)
    monkeypatch.setattr(program, "epoch_us", lambda: EPOCH_US)
    monkeypatch.setattr(program, "_open_source", lambda mocap, capture: room)
    return room


def test_every_line_of_a_station_has_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    turns: list[StationSession] = []
    room = Room(blind=(10.0, 21.0), lost=(30.0, 33.2))
    flown(room, monkeypatch, 40.0, (lambda session, now_us: turns.append(session),))
    near = {"abs": 0.05}
    assert room.instants("no poses for 5 s") == pytest.approx([15.0, 20.0], **near)
    again = [33.5, 38.5]
    assert room.instants("poses ") == pytest.approx([5.0, 10.0, 15.0, 20.0, 25.0, again[1]], **near)
    assert room.instants("pose ") == room.instants("poses ")  # the budget's line follows
    assert room.instants("lost at 30 s; connecting again") == pytest.approx([30.0], **near)
    assert room.instants("opened") == pytest.approx([0.0, *(30.0 + 0.5 * n for n in range(8))], **near)
    assert room.instants("connected to room") == pytest.approx([0.0, again[0]], **near)
    assert room.instants("the board is in failsafe") == pytest.approx([40.5], **near)
    assert room.says[-1][1] == "closed"
    start_us = turns[0].plan.start_us  # of the first flying state, not of that after the lost link
    assert start_us == pytest.approx(3_500_000, abs=50_000)
    moved_us = [now_us for now_us, goal in room.goals if goal.p_WG[0] > 0.05]
    assert moved_us[0] == pytest.approx(start_us, abs=FRAME_US)
    assert not [now_us for now_us, goal in room.goals if goal.p_WG[0] < 0.05 and now_us > moved_us[0]]


def test_no_pose_is_sent_that_waited_while_the_board_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    room = Room((inf, inf), (3.0, 3.1))
    room.connects_s = 1.2
    flown(room, monkeypatch, 6.0)
    assert 100 < len(room.ages_us) == sum(age_us < FRAME_US for age_us in room.ages_us)


def test_a_link_that_stays_lost_ends_the_flight_after_half_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    room = Room(blind=(inf, inf), lost=(10.0, inf))
    with pytest.raises(LinkError, match="lost at 10 s"):
        flown(room, monkeypatch, 100.0)
    assert room.instants("opened")[-1] == pytest.approx(40.5, abs=0.6)


def test_a_board_that_reports_no_failsafe_is_left_after_two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    room = flown(Room((inf, inf), (inf, inf), in_failsafe=False), monkeypatch, 5.0)
    assert room.instants("closed")[0] == pytest.approx(7.0, abs=0.05)
    assert not room.instants("the board is in failsafe")


def test_what_happened_to_the_files_of_a_flight_is_said_while_it_flies(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    room = Room((inf, inf), (inf, inf))

    def fails(session: StationSession, now_us: int) -> None:
        if now_us > 1_000_000:
            records.write("some file", broken)

    def broken() -> None:
        raise OSError(28, "")

    records = program.Records()
    flown(room, monkeypatch, 3.0, (fails,), records=records, record=tmp_path / "frames.csv")
    assert room.instants("some file: No space left") == pytest.approx([1.02], abs=0.05)
    assert (tmp_path / "frames.csv").read_text().count("\n") == pytest.approx(
        177, abs=2
    )  # 3.5 s with the title


def test_telemetry_and_frames_of_mavlink_are_in_their_files_whole(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    room = Room((inf, inf), (inf, inf))
    names = [variable.name for variable in CONTROL.variables]

    def talks(session: StationSession, now_us: int) -> None:
        room.sends = (Sample(CONTROL, now_us // 1000, tuple(range(len(names)))),)
        assert room.settings is not None
        assert room.settings.note_frame is not None
        room.settings.note_frame(now_us, b"frame")

    log, tlog = tmp_path / "telemetry.csv", tmp_path / "link.tlog"
    flown(room, monkeypatch, 6.0, (talks,), log=log, tlog=tlog)
    header, *rows = (row.split(",") for row in log.read_text().splitlines())
    columns = {title.partition(" ")[0]: index for index, title in enumerate(header)}
    assert [float(rows[0][columns[name]]) for name in names] == [*range(len(names))]
    stamps_ms = [int(row[0]) for row in rows]
    assert stamps_ms == sorted(set(stamps_ms))
    assert (stamps_ms[0], stamps_ms[-1]) == (20, 6020)
    frames = tlog.read_bytes()
    assert [frames[at + 8 : at + 13] for at in range(0, len(frames), 13)] == [b"frame"] * (len(frames) // 13)
    times_us = [int.from_bytes(frames[at : at + 8], "big") - EPOCH_US for at in range(0, len(frames), 13)]
    assert [time_us // 1000 for time_us in times_us] == stamps_ms
    (state,) = [text for _, text in room.says if text.startswith("poses ")]
    assert state.endswith(f"telemetry {sum(stamp_ms < 5000 for stamp_ms in stamps_ms)}")


FILES = ("log", "record", "tlog")


@pytest.mark.parametrize("names", [FILES, *((name,) for name in FILES)])
@pytest.mark.parametrize("until_s", [1.0, 6.0])  # full when it is closed or before
def test_full_files_end_by_themselves_and_not_the_flight(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, names: tuple[str, ...], until_s: float
) -> None:
    room = Room((inf, inf), (inf, inf))
    paths = {name: tmp_path / name for name in FILES}
    full = {name: paths[name] for name in names}
    for path in full.values():
        path.symlink_to("/dev/full")

    def talks(session: StationSession, now_us: int) -> None:
        room.sends = (Sample(CONTROL, now_us // 1000, (0,) * len(CONTROL.variables)),)
        assert room.settings is not None
        assert room.settings.note_frame is not None
        room.settings.note_frame(now_us, bytes(1000))

    records = program.Records()
    flown(room, monkeypatch, until_s, (talks,), records=records, **paths)
    ended = [text for _, text in room.says if "No space left" in text] + records.notices()
    assert sorted(ended) == sorted(
        f"{path}: No space left on device; no more is written to it" for path in full.values()
    )
    assert records.incomplete
    assert len(room.ages_us) == pytest.approx(50 * until_s, abs=5)


@pytest.mark.parametrize(("enabled", "frame_us", "effect"), [
    (True, 500_000, "no corrections leave, see tracker.reacquire_us = 400000"),
    (False, 500_000, "2, not 50 corrections leave per second"),
    (True, 300_000, "3, not 50 corrections leave per second"),
])  # fmt: skip
def test_cameras_too_slow_for_a_track_are_named_where_there_is_a_tracker(
    monkeypatch: pytest.MonkeyPatch, enabled: bool, frame_us: int, effect: str
) -> None:
    room = in_room(Room((inf, inf), (inf, inf)), monkeypatch)
    room.frame_us = frame_us
    settings = GroundConfig(tracker=TrackerConfig(enabled=enabled), frame_period_us=20_000)
    fly(settings, Session("room", None, step), room.say, run_until(lambda: False, 6.0))
    (line,) = [text for _, text in room.says if "a frame every" in text]
    assert line.endswith(f": {effect}")


@pytest.mark.parametrize("again", [False, True])
def test_a_flight_ends_with_its_replay_even_if_that_is_recorded_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, again: bool
) -> None:
    room = in_room(Room((inf, inf), (inf, inf)), monkeypatch)
    first, second = tmp_path / "first", tmp_path / "second"
    flown(room, monkeypatch, 2.0, record=first)
    monkeypatch.undo()
    in_room(room, monkeypatch)
    for name, replaced in (("clock_us", lambda: room.now_us), ("wait", room.receive)):
        monkeypatch.setattr(replay, name, replaced)
    monkeypatch.setattr(program, "_open_source", lambda mocap, capture: opened(ReplaySource(first)))
    room.frame_us, room.now_us = 1_000, 0
    fly(
        GroundConfig(), Session("room", None, step, record=second if again else None), room.say, lambda: False
    )
    assert room.instants("the recording is over")
    if again:
        assert len(read_frames(second)) == len(read_frames(first)) > 90


def opened(source: ReplaySource) -> ReplaySource:
    source.open()
    return source


class Read(Terminal):
    """The terminal, once all of its input was read."""

    def __init__(self, words: Callable[[], Sequence[str]]) -> None:
        super().__init__(words)
        self._thread.join()


def test_every_line_of_the_terminal_is_executed_and_what_ended_the_flight_is_returned(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    room = in_room(Room((inf, inf), (inf, inf)), monkeypatch)
    (tmp_path / "typed").write_text("mark one\n mark two \nfly nowhere\nhelp\nmark three")
    said, notes, stops = list[str](), list[str](), list[int]()

    def find(name: str) -> Callable[[Goal, int], Trajectory]:
        raise ControlsError(f"no {name}")

    def fly(until_s: float, session: Session, *hooks: LoopHook) -> tuple[str, bool]:
        person = operator.Operator(find, said.append, notes.append)
        return operator.fly_with(person, GroundConfig(), session, room.say, until_s, hooks)

    monkeypatch.setattr(operator, "Terminal", Read)
    monkeypatch.setattr(operator, "stop_signals", lambda: stops)
    with (tmp_path / "typed").open() as typed:
        monkeypatch.setattr(sys, "stdin", typed)
        assert fly(3.0, Session("room", None, step)) == ("", False)
        assert notes == ["mark one", "mark two", "mark three"]
        assert said == [
            "mark one",
            "mark two",
            "fly nowhere: no nowhere",
            *operator.HELP.splitlines(),
            "mark three",
        ]
        room.lost = (room.now_us * 1e-6, inf)
        assert fly(3.0, Session("room", None, step)) == ("--link not there", False)
        gone = Session("room", None, step, log=tmp_path / "no" / "log.csv")
        assert fly(3.0, gone) == (f"{tmp_path / 'no' / 'log.csv'}: No such file or directory", False)
        room.lost = (inf, inf)
        assert fly(3.0, Session("room", None, step), lambda live, now_us: stops.append(2)) == ("", True)


def test_a_request_is_repeated_until_its_answer_or_the_loss_of_the_link(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    request, answer = ControlRequest(ControlAction.SAVE), Answer((("gain", 1.0),))
    now_us, turns, heard = 7_000_000, iter(range(9)), list[tuple[int, bytes]]()

    def wait(duration_s: float) -> None:
        nonlocal now_us
        now_us += round(1e6 * duration_s)

    class Line:
        uri = "line"

        def ask(self, t_us: int, asked: ControlRequest) -> None:
            assert (t_us, asked) == (7_000_000, request)

        def answer(self, t_us: int) -> Answer | None:
            assert t_us == now_us
            return answer if t_us == 7_006_000 else None

        def received(self) -> list[tuple[int, bytes]]:
            return [(now_us - 700, b"bad"), (now_us - 300, b"good")]

        def receive(self, t_us: int, data: bytes) -> None:
            if data == b"bad":
                raise WireError("bad")
            heard.append((t_us, data))

        def check(self) -> None:
            if next(turns) > 2:
                raise LinkError("line: lost")

    monkeypatch.setattr(program, "clock_us", lambda: now_us)
    monkeypatch.setattr(program, "wait", wait)
    line: Any = Line()
    assert program.ask(line, request) is answer
    assert heard == [(6_999_700 + 2000 * turn, b"good") for turn in range(3)]
    now_us = 7_000_000
    with pytest.raises(LinkError, match="line: lost"):
        program.ask(line, request)


@pytest.mark.parametrize(("error", "line"), [
    (LinkError("udp://1: lost"), "--link udp://1: lost"), (MocapError("--mocap vrpn:a: lost"), "--mocap vrpn:a: lost"),
    (PermissionError(13, "Permission denied", "a/log.csv"), "a/log.csv: Permission denied"),
    (OSError(28, "No space left on device"), "No space left on device"), (OSError("odd"), "odd"),
    (ImportError("no serial"), f"--link mavlink:COM3: no serial: {install_command('mavlink')}"),
])  # fmt: skip
def test_why_a_flight_ended_is_one_line(error: Exception, line: str) -> None:
    assert program.why(error, "mavlink:COM3") == line


def test_a_source_that_is_not_there_is_named_as_it_was_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone:
        def open(self) -> None:
            raise MocapError("cave: no answer")

    monkeypatch.setattr(program, "find_source", lambda mocap, capture: Gone())
    for mocap, begin in (
        ("vrpn:cave", "--mocap vrpn:cave"), ("", "--mocap "), (None, "capture.system = optitrack"),
    ):  # fmt: skip
        with pytest.raises(MocapError) as caught:
            program._open_source(mocap, GroundConfig().capture)
        assert str(caught.value) == f"{begin}: cave: no answer"
