"""Lines on a terminal: what arrives is shown, whatever it is, and controls nothing."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ground_station.lines import print_line, visible


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


def test_a_terminal_of_few_characters_shows_the_others_as_escapes(tmp_path: Path) -> None:
    with (tmp_path / "shown").open("w", encoding="ascii") as output:
        print_line("ω 1", output)
    assert (tmp_path / "shown").read_text() == "\\u03c9 1\n"
