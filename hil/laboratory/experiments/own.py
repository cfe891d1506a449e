"""A user's experiments: in a Python file, as FILE.py:NAME, or in an installed package, as an entry point.

Every error in a file gives one line with file and line number.
"""

import hashlib
import importlib.util
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from hil.errors import LabError, blame, hint
from hil.laboratory.experiment import Experiment, Source
from hil.laboratory.files.own_files import load_file

GROUP = "floaty.experiments"


def in_file(reference: str) -> Experiment:
    """Return the experiment FILE.py:NAME, or the only one of FILE.py. Raises `LabError` without one."""
    text, _, name = reference.rpartition(":") if ".py:" in reference else (reference, "", "")
    found = in_whole_file(Path(text))
    if not name and len(found) == 1:
        return next(iter(found.values()))
    if name in found:
        return found[name]
    there = hint(name, found, f"there {_are(list(found))}")
    what = f"no experiment {name!r} in it" if name else "which one?"
    raise LabError(f"experiment {reference}: {what}; {there}")


def in_whole_file(path: Path) -> dict[str, Experiment]:
    """Return the experiments of a file by variable name. Raises `LabError` when it cannot be executed."""
    module, digest = load_file("experiment", path)
    place = path.resolve()
    return {
        name: replace(value, source=Source(f"{place}:{name}", digest))
        for name, value in vars(module).items()
        if isinstance(value, Experiment)
    }


def entries() -> dict[str, EntryPoint]:
    """Return the experiments of installed packages, not loaded."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def package_of(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.module


def in_package(entry: EntryPoint) -> Experiment:
    """Return the experiment of an entry point. Raises `LabError` when it cannot be loaded or is not an experiment."""
    what = f"experiment {entry.name} of {package_of(entry)}"
    try:
        found = entry.load()
    except Exception as error:
        raise LabError(f"{what}: {blame(error)}") from error
    if not isinstance(found, Experiment):
        raise LabError(f"{what}: {entry.value} is {found!r}: expected an Experiment")
    spec = importlib.util.find_spec(entry.module)
    origin = spec.origin if spec else None
    digest = hashlib.sha256(Path(origin).read_bytes()).hexdigest() if origin else ""
    return replace(found, source=Source(entry.name, digest, package_of(entry)))


def _are(names: list[str]) -> str:
    return f"are {', '.join(names)}" if len(names) > 1 else f"is {names[0]}" if names else "is none"
