"""Judges what came out now by what was approved, where the libraries that shape it are those of then."""

import json
from collections.abc import Callable, Collection, Iterable, Mapping
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pytest


def versions(*packages: str) -> str:
    """Return the versions of packages, a dash for one that is missing."""
    found = []
    for name in packages:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} -")
    return ", ".join(found)


def skip_unless(made_with: str, here: str) -> None:
    """Skip the test, whose outputs differ, if they were approved with other versions."""
    if made_with != here:
        pytest.skip(f"differs, but was approved with {made_with}; here are {here}")


def tiers(names: Iterable[str], long: Collection[str]) -> list[Any]:
    """Return the parameters of a test, of which some are for the long tier."""
    return [pytest.param(name, marks=pytest.mark.long if name in long else ()) for name in names]


def judge(path: Path, name: str, found: Any, *packages: str) -> None:
    """Fail where something differs from what a file has under its name."""
    known = json.loads(path.read_text(encoding="utf-8"))
    if found != known[name]:
        skip_unless(known["versions"], versions(*packages))
    assert found == known[name]


def approve(path: Path, finders: Mapping[str, Callable[[], Any]], *packages: str) -> None:
    """Write what all finders find, under their names."""
    content = {"versions": versions(*packages)} | {name: find() for name, find in finders.items()}
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


class Log:
    """Keeps notes by kind. `told` returns how many there are of each kind, a hash of them, and the last one."""

    def __init__(self) -> None:
        self._rows: dict[str, list[str]] = {}

    def note(self, kind: str, *what: object) -> None:
        """Note what happened."""
        self._rows.setdefault(kind, []).append(" ".join(map(str, what)))

    def told(self) -> dict[str, str]:
        """Return a line for each kind."""
        hashes = {
            kind: sha256("\n".join(rows).encode()).hexdigest()[:12] for kind, rows in self._rows.items()
        }
        return {
            kind: f"{len(rows)} {hashes[kind]} {rows[-1][:100]}" for kind, rows in sorted(self._rows.items())
        }
