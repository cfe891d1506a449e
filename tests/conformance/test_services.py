"""The laws of the services, each once: a client sees the same on the firmware in Python and on the flashed image.

The referee is the exported app in crazyflie-firmware 2a18fc29, and that firmware alone for what is its own. Its answers are
recorded in `tests/vectors/services` (`tools/record_services.py`); with FLOATY_CF2_ELF and FLOATY_STOCK_ELF the images
themselves are asked.
"""

import json
import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from hil.board.board_firmware import PythonBoard
from hil.deploy.service_programs import PROGRAMS, STOCK
from hil.deploy.services import Answers, ServiceBench, differences, play_in_copies
from support.paths import TESTS

ELF, STOCK_ELF = (os.environ.get(name, "") for name in ("FLOATY_CF2_ELF", "FLOATY_STOCK_ELF"))


# Of each kind the programs that differ most; the others are long.
@cache
def recorded(name: str) -> dict[str, Answers]:
    """The referee's answers by program; a program that has changed since has none."""
    entries = json.loads((TESTS / "vectors" / "services" / f"{name}.json").read_text())
    return {
        program: Answers(entry["answers"], [tuple(1e-3 * part for part in place) for place in entry["path"]])
        for program, entry in entries.items()
        if entry["program"] == PROGRAMS.get(program)
    }


def booted(elf: str) -> ServiceBench:
    pytest.importorskip("unicorn")
    pytest.importorskip("cffi")
    from hil.board.image_firmware import ChipImage

    return ServiceBench(ChipImage.load(Path(elf), None))


def played(bench: ServiceBench, program: str) -> Answers:
    [answers] = play_in_copies(bench, [program])
    return answers


@pytest.fixture(scope="module")
def python() -> ServiceBench:
    return ServiceBench(PythonBoard())


@pytest.fixture(scope="module")
def app() -> ServiceBench:
    if not ELF:
        pytest.skip("FLOATY_CF2_ELF names no build of the Crazyflie firmware with the exported app")
    return booted(ELF)


@pytest.fixture(scope="module")
def stock() -> ServiceBench:
    if not STOCK_ELF:
        pytest.skip("FLOATY_STOCK_ELF names no build of the Crazyflie firmware")
    return booted(STOCK_ELF)


def test_every_program_has_the_answers_of_its_referee() -> None:
    assert set(recorded("app")) == set(PROGRAMS)
    assert set(recorded("stock")) == STOCK


@pytest.mark.long
@pytest.mark.parametrize("name", PROGRAMS)
def test_the_python_board_answers_as_the_image(python: ServiceBench, name: str) -> None:
    assert list(differences(recorded("app")[name], played(python, PROGRAMS[name]))) == []


@pytest.mark.parametrize("name", sorted(STOCK))
def test_where_the_law_is_the_firmware_s_own_the_app_changes_nothing(name: str) -> None:
    """But for what the supervisor sees: Floaty flies where it is, the stock board rests."""
    ours, theirs = (
        [line for line in recorded(board)[name].lines if not line.startswith(("look", "end"))]
        for board in ("app", "stock")
    )
    assert ours == theirs


@pytest.mark.long
@pytest.mark.parametrize("name", PROGRAMS)
def test_the_image_answers_as_recorded(app: ServiceBench, name: str) -> None:
    assert list(differences(recorded("app")[name], played(app, PROGRAMS[name]))) == []


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(STOCK))
def test_the_stock_image_answers_as_recorded(stock: ServiceBench, name: str) -> None:
    assert list(differences(recorded("stock")[name], played(stock, PROGRAMS[name]))) == []


# Generated programs

COORDINATES = st.sampled_from((-0.1, -0.05, 0.0, 0.05, 0.1))
HEIGHTS = st.sampled_from((0.9, 1.0, 1.1, 1.2))
# Not near the supervisor's limits of 0.5, 2 and 3 s: it looks every 40 ms.
PAUSES = st.sampled_from((0.2, 0.3, 0.8, 1.2, 2.4))


def line(form: str, *numbers: st.SearchStrategy[float]) -> st.SearchStrategy[str]:
    return st.tuples(*numbers).map(lambda values: form.format(*values))


REQUESTS = st.one_of(
    line("takeoff {} 0.8", HEIGHTS),
    line("goto {} {} {} 0 0.8", COORDINATES, COORDINATES, HEIGHTS),
    line("goto {} {} 0 0 0.8 relative", COORDINATES, COORDINATES),
    line("stream position {} {} {} 0 0.3", COORDINATES, COORDINATES, HEIGHTS),
    line("land {} 0.8", HEIGHTS),
    line("wait {}", PAUSES),
    st.sampled_from(
        ("notify", "stop", "disarm", "arm", "recover", "disconnect", "setpoint hover 0 0 0 1.1", "look")
    ),
)
GENERATED = st.lists(REQUESTS, min_size=10, max_size=25).map("\n".join)


def bits_of(answer: str) -> tuple[int, Sequence[str]]:
    words = answer.split()
    return int(words[words.index("bits") + 1], 16), words


@pytest.mark.long
@settings(max_examples=5, deadline=None, suppress_health_check=list(HealthCheck))
@given(GENERATED)
def test_bits_and_states_fit_together_whatever_a_client_does(python: ServiceBench, program: str) -> None:
    answers = played(python, program)
    was_locked = False
    for answer in (line for line in answers.lines if "bits" in line):
        bits, words = bits_of(answer)
        armed, can_fly, flies, locked = (bool(bits >> bit & 1) for bit in (1, 3, 4, 6))
        assert can_fly >= flies
        assert locked or not was_locked
        assert ("failsafe" in words) >= (locked or not armed)
        was_locked = locked


@pytest.mark.long
@settings(max_examples=10, deadline=None, phases=(Phase.generate,), suppress_health_check=list(HealthCheck))
@given(GENERATED)
def test_both_boards_end_in_the_same_state_on_the_same_path(
    app: ServiceBench, python: ServiceBench, program: str
) -> None:
    program = program.replace("look", "wait 0.1") + "\nwait 3"  # until a lock that is due has come on both
    assert list(differences(played(app, program), played(python, program))) == []
