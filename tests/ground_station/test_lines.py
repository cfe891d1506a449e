"""Lines on a terminal: what arrives is shown, whatever it is, and controls nothing."""

import os
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ground_station.lines import print_line, visible
from ground_station.terminal import READ_SIZE, Terminal


@pytest.mark.long
@given(st.text(st.characters(exclude_categories=())))
def test_whatever_arrives_is_printable_and_what_was_printable_is_unchanged(text: str) -> None:
    assert visible(text).isprintable()
    if text.isprintable():
        assert visible(text) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b]0;owned\x07", r"\x1b]0;owned\x07"),
        ("\x1b[2J", r"\x1b[2J"),
        ("\x9b2J", r"\x9b2J"),
        ("one\rtwo\nfloaty: three", r"one\rtwo\nfloaty: three"),
        ("\u202eback", r"\u202eback"),
        ("\udcff", r"\udcff"),
        ("ω 1 °/s", "ω 1 °/s"),
    ],
)
def test_control_characters_are_shown(text: str, shown: str) -> None:
    assert visible(text) == shown


def test_lines_of_a_pipe_arrive_whole_however_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    sent = [f"{number}" * (READ_SIZE - 3) for number in range(4)] + ["ü", "no end"]
    read, write = os.pipe()
    with os.fdopen(read) as pipe:
        monkeypatch.setattr("sys.stdin", pipe)
        terminal = Terminal(tuple)
        (thread,) = (thread for thread in threading.enumerate() if thread.name == "terminal")
        os.write(write, "\n".join(sent).encode())
        os.close(write)
        thread.join(60.0)
    assert terminal.lines() == sent
    assert terminal.lines() == []


def test_a_terminal_of_few_characters_shows_the_others_as_escapes(tmp_path: Path) -> None:
    with (tmp_path / "shown").open("w", encoding="ascii") as output:
        print_line("ω 1", output)
    assert (tmp_path / "shown").read_text() == "\\u03c9 1\n"
