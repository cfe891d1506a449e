"""Lines typed into a running server: however they arrive, and to whichever robot they go."""

import io
import os
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.wire.supervisor import Cause, State
from hil.laboratory.fault_kinds import KINDS
from hil.servers.live_faults import HELP, LiveFaults, _status

TOO_LONG = f"{20 * 'x'}…: expected at most 200 characters"


class Typed:
    """A pipe to the faults of robot 1; robot 2 is another process's."""

    def __init__(self) -> None:
        self.readers, self.said, self.to_other = dict[int, Any](), list[str](), list[str]()
        self.end, self.terminal = os.pipe()
        server: Any = SimpleNamespace(
            clock=SimpleNamespace(readers=self.readers), switchboard=SimpleNamespace(act=None), robot=None
        )
        server.served = SimpleNamespace(number=1)
        self.faults = LiveFaults(server, self.said.append, {2: self.to_other.append})
        with os.fdopen(self.end, closefd=False) as stream:
            self.faults.listen(stream)

    def type(self, data: bytes) -> list[str]:
        self.said.clear()
        os.write(self.terminal, data)
        self.readers[self.end](0)
        return self.said


@pytest.fixture
def typed() -> Iterator[Typed]:
    typed = Typed()
    yield typed
    os.close(typed.end)
    os.close(typed.terminal)


def test_lines_arrive_in_pieces_and_several_at_once(typed: Typed) -> None:
    assert typed.type(b"he") == []
    assert typed.type(b"lp\nkin") == HELP.splitlines()
    assert typed.type(b"ds\n\n \n3 status\n") == [" ".join(KINDS), "robot 3: expected 1..2"]
    assert typed.type(b"  2  push.y=2 \n2 status\n") == []
    assert typed.to_other == ["2  push.y=2", "2 status"], "as they were typed"


@pytest.mark.parametrize("pieces", [[201], [200, 1], [150, 150], [1, 200], [1000, 1000, 7]])
def test_a_line_that_is_too_long_is_answered_once(typed: Typed, pieces: list[int]) -> None:
    for piece in pieces:
        assert typed.type(piece * b"x") == []
    assert typed.type(b"\n3 status\n") == [TOO_LONG, "robot 3: expected 1..2"]
    (answer,) = typed.type(200 * b"x" + b"\n")
    assert "unknown kind" in answer


def test_bytes_that_are_no_text_are_answered(typed: Typed) -> None:
    (answer,) = typed.type(b"\xff\n")
    assert r"\xff" in answer


def test_the_end_of_a_stream_is_no_line_and_ends_the_reading(typed: Typed) -> None:
    typed.type(b"3 status")
    os.close(typed.terminal)
    typed.terminal = os.dup(typed.end)
    typed.readers[typed.end](0)
    assert (typed.said, typed.readers) == ([], {})


@pytest.mark.parametrize(("free", "state", "cause", "words"), [
    (False, State.CALIBRATING, Cause.NONE, "held, calibrating"), (True, State.FLYING, Cause.NONE, "free, flying"),
    (True, State.FAILSAFE, Cause.LOW_BATTERY, "free, failsafe, low battery"),
    (False, State.FAILSAFE, Cause.CONTROLLER_NOT_FINITE, "held, failsafe, controller not finite"),
])  # fmt: skip
def test_a_robot_s_state_is_described_in_words(free: bool, state: State, cause: Cause, words: str) -> None:
    supervisor = SimpleNamespace(state=state, cause=cause)
    robot: Any = SimpleNamespace(
        powered=True, free=free, firmware=SimpleNamespace(signals=SimpleNamespace(supervisor=supervisor))
    )
    assert _status(robot) == words
    robot.powered = False
    assert _status(robot) == "without power"


def test_a_stream_without_lines_is_ignored(typed: Typed) -> None:
    typed.readers.clear()
    with open(os.devnull, encoding="utf-8") as nothing:
        for stream in (io.StringIO("help\n"), nothing):
            typed.faults.listen(stream)
    nothing.close()
    typed.faults.listen(nothing)  # closed
    assert typed.readers == {}
