"""The folder of a flight: its name, an older run in it, and the lock that admits one flight at a time.

No flight replaces one of another request. An older run of the same request is set aside until the flight begins, and
restored when no board or link is available, or when the process was killed before. What a flight leaves that was killed
before it recorded anything may be replaced by every flight.
"""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from ground_station.links.frame_log import FRAME_LOG
from ground_station.telemetry_log import TELEMETRY
from hil.errors import LabError, writing
from hil.laboratory.files.recorder import PARQUET, STREAM, log_pieces
from hil.laboratory.files.result import RESULT, read_result
from hil.laboratory.request import Request

RUNS = Path("runs")
OLDER = "older-run"  # in a run folder, until the next flight begins
OBSOLETE = "older-run.obsolete"  # its name while it is deleted
DECIDING = (RESULT, PARQUET, STREAM)  # each describes its run
EARLY = (TELEMETRY, FRAME_LOG)  # files that a flight opens before its log; empty until then


@contextmanager
def replacing_older(folder: Path) -> Iterator[None]:
    """Make a folder ready for a run; the older one in it is deleted at the end, or restored after an error.

    Raises `LabError` when the folder holds something else.
    """
    with writing("--out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        _bring_back(folder)  # from an attempt that never began
        if older := list(folder.iterdir()):
            if not (any((folder / name).exists() for name in DECIDING) or _is_blank(folder)):
                raise LabError(
                    f"--out {folder}: the folder is not empty and holds no run; choose another one"
                )
            (folder / OLDER).mkdir()
            # The first file to arrive describes the run.
            for path in sorted(older, key=lambda path: path.name not in DECIDING):
                path.rename(folder / OLDER / path.name)
    try:
        yield
    except BaseException:
        _bring_back(folder)
        raise
    if (folder / OLDER).exists():
        (folder / OLDER).rename(folder / OBSOLETE)  # at once: a half deleted run is not restored
        shutil.rmtree(folder / OBSOLETE, ignore_errors=True)


def _bring_back(folder: Path) -> None:
    """Restore the older run, and delete the files of a failed attempt."""
    shutil.rmtree(folder / OBSOLETE, ignore_errors=True)
    if (folder / OLDER).exists():
        for path in folder.iterdir():
            if _is_new(path):
                path.unlink()
        for path in (folder / OLDER).iterdir():
            path.rename(folder / path.name)
        (folder / OLDER).rmdir()


def _is_new(file: Path) -> bool:
    return file.name in EARLY and file.stat().st_size == 0


def _is_blank(folder: Path) -> bool:
    """Whether a folder has at most the files of a flight that recorded nothing, as after an early kill or a full disk."""
    for path in folder.iterdir():
        if not (_is_new(path) or path.name in (STREAM, OLDER, OBSOLETE)):
            return False
    try:
        next(log_pieces(folder))
    except LabError:
        return True
    return False


def folder_of(request: Request, parent: Path = RUNS) -> Path:
    """Return parent/EXPERIMENT-SEED or, if that is taken, the first of -2, -3, … that is not."""
    name = f"{request.experiment.name}-{request.seed}"
    names = (name if number == 1 else f"{name}-{number}" for number in count(1))
    return next(parent / name for name in names if not other_in(parent / name, request))


def moved(request: Request, folder: Path) -> str:
    """Return one line on why a flight is not in its usual folder; empty when it is."""
    usual = folder.with_name(f"{request.experiment.name}-{request.seed}")
    return f"{usual} holds {other_in(usual, request)}; this flight is in {folder}" if folder != usual else ""


def other_in(folder: Path, request: Request) -> str:
    """Name the contents that a flight must not replace; empty for none, or a flight of the same request."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return ""
    older = folder / OLDER
    held = older if older.is_dir() and any(older.iterdir()) else folder
    try:
        flown = read_result(held).request.parts()
    except LabError:
        return "" if held.is_dir() and _is_blank(held) else "something else"
    asked = request.parts()
    differing = [f"{name} {flown[name] or 'none'}".strip() for name in flown if flown[name] != asked[name]]
    return f"another flight ({'; '.join(differing)})" if differing else ""


@contextmanager
def reserved(request: Request, folder: Path, replace: bool = False) -> Iterator[None]:
    """Make a folder for a flight, and lock out other flights until its last file is written.

    Raises `LabError` when another flight is writing there or, without `replace`, when it holds another request's run. The
    kernel locks the folder until the process ends, also if it is killed.
    """
    made = not folder.exists()
    with writing("--out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder, os.O_RDONLY)
    try:
        _lock(lock, folder)
        if not replace and (other := other_in(folder, request)):
            raise LabError(f"--out {folder}: holds {other}: choose another folder, or delete this one")
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
