"""The folder of robots that fly together: a run folder for each, which no flight of another request replaces."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path

from hil.errors import LabError, writing
from hil.laboratory.files.folder import RUNS, other_in, reserved
from hil.laboratory.swarms.request import SwarmRequest
from hil.laboratory.swarms.result import SWARM, folder_name


def swarm_folder(request: SwarmRequest, parent: Path = RUNS) -> Path:
    """Return parent/EXPERIMENT-SEED-xROBOTS or, if that is taken, the first of -2, -3, … that is not."""
    first = request.robots[0]
    name = f"{first.experiment.name}-{first.seed}-x{len(request.robots)}"
    names = (name if number == 1 else f"{name}-{number}" for number in count(1))
    return next(parent / name for name in names if not other_swarm_in(parent / name, request))


def other_swarm_in(folder: Path, request: SwarmRequest) -> str:
    """Name the contents that a flight must not replace; empty for none, or a flight of the same request."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return ""
    if not (folder / folder_name(1)).is_dir():
        return "something else"
    held = sum((folder / folder_name(number)).is_dir() for number in range(1, 100))
    if (folder / SWARM).exists() and held != len(request.robots):
        return f"another flight (of {held} robots)"
    for number, one in enumerate(request.robots, 1):
        if other := other_in(folder / folder_name(number), one):
            return other
    return ""


@contextmanager
def swarm_reserved(request: SwarmRequest, folder: Path, replace: bool = False) -> Iterator[None]:
    """Make the folders of all robots, and lock out other flights until the last file is written.

    Raises `LabError` when one is written there or, without `replace`, when another request's run is there.
    """
    if not replace and (other := other_swarm_in(folder, request)):
        raise LabError(f"--out {folder}: holds {other}: choose another folder, or delete this one")
    with writing("--out", folder), ExitStack() as stack:
        folder.mkdir(parents=True, exist_ok=True)
        for number, one in enumerate(request.robots, 1):
            stack.enter_context(reserved(one, folder / folder_name(number), replace))
        yield
