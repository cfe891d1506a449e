"""The folder of a flight: no other flight is replaced there, and one flight at a time writes there."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from hil.errors import LabError, writing
from hil.laboratory.result import read_result
from hil.laboratory.run import OLDER, Request, prepare

RUNS = Path("runs")


def folder_of(request: Request, parent: Path = RUNS) -> Path:
    """Return parent/EXPERIMENT-SEED, or, while that holds something else, the first of -2, -3, … that does not."""
    name = f"{request.experiment.name}-{request.seed}"
    names = (name if number == 1 else f"{name}-{number}" for number in count(1))
    return next(parent / name for name in names if not other_in(parent / name, request))


def moved(request: Request, folder: Path) -> str:
    """Return the line that says why a flight is not in its usual folder; empty when it is."""
    usual = folder.with_name(f"{request.experiment.name}-{request.seed}")
    return f"{usual} holds {other_in(usual, request)}; this flight is in {folder}" if folder != usual else ""


def other_in(folder: Path, request: Request) -> str:
    """Return what a folder holds that a flight must not replace; empty for nothing, or a flight of the same request."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return ""
    older = folder / OLDER
    try:
        flown, asked = (
            read_result(older if older.exists() else folder).requested(),
            request.origin().requested(),
        )
    except LabError:
        return "something else"
    differing = [f"{name} {flown[name] or 'none'}".strip() for name in flown if flown[name] != asked[name]]
    return f"another flight ({'; '.join(differing)})" if differing else ""


@contextmanager
def reserved(request: Request, folder: Path, replace: bool = False) -> Iterator[None]:
    """Prepare a folder for a flight, and keep other flights out until its last file is written.

    Raises `LabError` when another flight is writing there or, unless it may `replace` that, when another request was flown.
    The lock is the kernel's, on the folder: it ends with the process, however that ends.
    """
    made = not folder.exists()
    with writing("--out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder, os.O_RDONLY)
    try:
        _lock(lock, folder)
        if not replace and (other := other_in(folder, request)):
            raise LabError(f"--out {folder}: holds {other}: choose another folder, or delete this one")
        prepare(folder)
        yield
    finally:
        os.close(lock)
        if made:
            with suppress(OSError):  # a flight that began has left its files
                folder.rmdir()


def _lock(opened: int, folder: Path) -> None:
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise LabError(
            f"--out {folder}: another flight is writing there: wait for its end, or choose another folder"
        ) from None
    except OSError:
        return  # a file system without locks
