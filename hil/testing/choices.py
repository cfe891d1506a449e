"""Seeds, boards, profiles, links and faults of a test, from its mark or the command line, and their availability."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

from firmware_py.config import LogicConfig
from firmware_py.export.errors import ExportError
from hil.board.cores.boards import BOARDS, C, runner_of
from hil.config import DEFAULT_PROFILE
from hil.errors import LabError, hint
from hil.laboratory.faults import parse
from hil.laboratory.request import LOCKSTEP, MAVLINK, RADIO, Options

PACKAGES = {"mavlink": "pymavlink", "radio": "cflib"}  # capabilities that a package provides
LOCKSTEP_ONLY = "lockstep"
CAPABILITIES = (*BOARDS, *PACKAGES, LOCKSTEP_ONLY)
WORDS = ("seeds", "boards", "profiles", "links", "faults", "needs")


@dataclass(frozen=True, slots=True)
class Wanted:
    """The options of the command line; empty: not given."""

    seeds: int = 0
    boards: tuple[str, ...] = ()
    profiles: tuple[str, ...] = ()
    link: str = ""
    usual_profile: str = DEFAULT_PROFILE


@dataclass(frozen=True, slots=True)
class Marked:
    """The arguments of `@pytest.mark.floaty`. Raises `LabError` for invalid ones."""

    seeds: tuple[int, ...] = ()
    boards: tuple[str, ...] = ()
    profiles: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    faults: tuple[tuple[str, ...], ...] = ()  # each of the tuples acts on flights of its own

    @classmethod
    def of(cls, words: Mapping[str, Any]) -> Marked:
        """Check the mark's arguments.

        `seeds` is a number of seeds from 1 on, or the seeds themselves; `faults` a list of faults, each as text, a `Fault`
        or a list of several that act together.
        """
        for word in words:
            if word not in WORDS:
                raise LabError(f"{word}: {hint(word, WORDS)}")
        seeds = words.get("seeds", ())
        if isinstance(seeds, int):
            if seeds < 1:
                raise LabError(f"seeds = {seeds}: expected 1 or more, or a list of seeds")
            seeds = range(1, seeds + 1)
        boards, profiles, links, needs = (
            _listed(words.get(name, ())) for name in ("boards", "profiles", "links", "needs")
        )
        faults = tuple(
            tuple(str(parse(str(fault))) for fault in _listed(together))
            for together in _listed(words.get("faults", ()))
        )
        marked = cls(tuple(seeds), boards, profiles, needs, links, faults)
        _check("boards", marked.boards, BOARDS)
        _check("links", marked.links, LOCKSTEP)
        _check("needs", marked.needs, CAPABILITIES)
        return marked


def choices_of(marked: Marked, wanted: Wanted) -> list[Options]:
    """Return the seeds, boards, profiles, links and faults of a test as the default options of its flights.

    The command line overrides the mark; without either, a board that the test needs is used.
    """
    needed = tuple(board for board in marked.needs if board in BOARDS)
    seeds = tuple(range(1, wanted.seeds + 1)) or marked.seeds or (1,)
    boards = wanted.boards or marked.boards or needed or (C,)
    profiles = wanted.profiles or marked.profiles or (wanted.usual_profile,)
    links = (wanted.link,) if wanted.link else marked.links or (RADIO,)
    chosen: list[Options] = [
        {"seed": seed, "board": board, "profile": profile, "link": link}
        for link, profile, board, seed in product(links, profiles, boards, seeds)
    ]
    if not marked.faults:
        return chosen
    return [{**one, "faults": faults} for faults, one in product(marked.faults, chosen)]


def name_of(choice: Options, choices: Sequence[Options]) -> str:
    """Return the text that distinguishes a choice in a test's name."""
    texts = [_parts(one) for one in choices]
    many = [len(set(part)) > 1 for part in zip(*texts, strict=True)]
    return "-".join(part for part, differs in zip(_parts(choice), many, strict=True) if differs)


def _parts(choice: Options) -> tuple[str, ...]:
    faults = "+".join(map(str, choice.get("faults", ()))) or "no-fault"
    return faults, choice["link"], choice["profile"], choice["board"], f"seed{choice['seed']}"


def why_not(choice: Options, needs: Iterable[str]) -> str:
    """Return why a test cannot fly its choice here, empty when it can."""
    board, link = choice["board"], choice["link"]
    in_lockstep = link in LOCKSTEP
    if not in_lockstep and board != C:
        return f"board {board}: --floaty-link {link}: only {C} flies over a link"
    for need in needs:
        if need in BOARDS and need != board:
            return f"needs {need}: this flies on {board}"
        if need == LOCKSTEP_ONLY and not in_lockstep:
            return f"needs lockstep: this flies over {link}"
        if need in PACKAGES and importlib.util.find_spec(PACKAGES[need]) is None:
            return f"needs {need}: {PACKAGES[need]} is not installed"
    if link.startswith(MAVLINK) and importlib.util.find_spec(PACKAGES["mavlink"]) is None:
        return f"link {link}: {PACKAGES['mavlink']} is not installed"
    return why_no_board(board)


@cache
def why_no_board(board: str) -> str:
    """Return why a board is not available on this machine, empty when it is."""
    try:
        runner_of(board, LogicConfig())
    except ExportError as error:
        return f"board {board} is not available here: {error}"
    return ""


def _listed(value: Any) -> tuple[Any, ...]:
    """Return the elements of a list, or a single value as the only element."""
    return tuple(value) if isinstance(value, list | tuple | set) else (value,)


def _check(word: str, values: tuple[str, ...], allowed: Sequence[str]) -> None:
    for value in values:
        if value not in allowed:
            raise LabError(f"{word} = {value!r}: expected {', '.join(allowed)}")
