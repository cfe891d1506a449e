"""Lines typed at a terminal, with prompt_toolkit's own input in place of keys."""

import io
import os
import pty
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType, SimpleNamespace

import pytest
from prompt_toolkit.application import create_app_session
from prompt_toolkit.document import Document
from prompt_toolkit.input import PipeInput, create_pipe_input
from prompt_toolkit.output import DummyOutput

from ground_station.terminal import Terminal

PATIENCE_S = 30.0


class Screen(io.StringIO):
    """A standard output at a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def keys(monkeypatch: pytest.MonkeyPatch) -> Iterator[PipeInput]:
    """What is typed at the terminal of this process."""
    master, slave = pty.openpty()
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(fileno=lambda: slave))
    with create_pipe_input() as keys, create_app_session(input=keys, output=DummyOutput()):
        yield keys
    os.close(master)
    os.close(slave)


def opened(monkeypatch: pytest.MonkeyPatch, words: Callable[[], list[str]] = list) -> Terminal:
    monkeypatch.setattr(sys, "stdout", Screen())
    return Terminal(words)


def next_line(terminal: Terminal) -> str:
    return terminal._lines.get(timeout=PATIENCE_S)


def test_lines_are_edited_and_completed_until_the_terminal_is_closed(
    keys: PipeInput, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["goal", "controller.gain_y"]
    terminal = opened(monkeypatch, lambda: [*words])
    keys.send_text("markk\x7f it\rset a 1\r")
    assert [next_line(terminal) for _ in range(2)] == ["mark it", "set a 1"]
    assert terminal.lines() == []
    assert terminal._session is not None
    completer = terminal._session.completer
    assert completer is not None
    words.append("controller.gain_z")  # learned in flight
    found = completer.get_completions(Document("set controller.g"), None)  # type: ignore[arg-type]
    assert [one.text for one in found] == ["controller.gain_y", "controller.gain_z"]
    terminal.close()
    assert not terminal._thread.is_alive()
    terminal.close()


def test_ctrl_c_is_for_the_program_and_ctrl_d_ends_the_input(
    keys: PipeInput, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted = threading.Event()

    def interrupt(number: int, frame: FrameType | None) -> None:
        interrupted.set()

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        terminal = opened(monkeypatch)
        keys.send_text("\x03")
        while not interrupted.is_set():  # the main thread handles it, once it runs
            terminal._thread.join(0.01)
            assert terminal._thread.is_alive()
        keys.send_text("go on\r")
        assert next_line(terminal) == "go on"
        keys.send_text("\x04")
        terminal._thread.join(PATIENCE_S)
        assert not terminal._thread.is_alive()
        terminal.close()
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_process_in_the_background_leaves_the_terminal_alone(
    keys: PipeInput, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "tcgetpgrp", lambda descriptor: os.getpgrp() + 1)
    started = threading.active_count()
    terminal = opened(monkeypatch)
    assert (threading.active_count(), terminal.lines()) == (started, [])
    terminal.close()
    monkeypatch.setattr(os, "tcgetpgrp", lambda descriptor: os.getpgrp())
    foreground = opened(monkeypatch)
    keys.send_text("here\r")
    assert next_line(foreground) == "here"
    foreground.close()
