"""The executed blocks of an image, added over flights in one file, `OUT.counts`, also by several processes at a time.

Beside it lie the files made from it: `OUT.info` and `OUT.html`. Counts of another image are never mixed in.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from firmware_py.export.elf import FLASH_SIZE
from hil.board.image_firmware import ImageFirmware
from hil.errors import LabError, made_folder, reading, writing
from hil.laboratory.files.whole_files import replacing

OPTION = "--coverage"
INFO, PAGE, COUNTS = ".info", ".html", ".counts"


@dataclass(frozen=True, slots=True)
class Executed:
    """The sums over flights of one image; `counts` is (FLASH_SIZE / 2 + 1, 3), as of `Chip.passages`."""

    image: str  # SHA-256 of what is in flash
    flights: int
    counts: NDArray[np.uint64]
    board: str  # where the image was found
    elf: Path | None


@dataclass(frozen=True, slots=True)
class Coverage:
    """`ImageObserver` that adds a flight to OUT."""

    out: Path
    board: str  # where the image was found
    elf: Path | None

    def begin(self, firmware: ImageFirmware) -> None:
        check_coverage(self.out, firmware.image.sha256)
        firmware.chip.record()

    def report(self, firmware: ImageFirmware, folder: Path) -> None:
        counts = firmware.chip.passages
        add_executed(self.out, Executed(firmware.image.sha256, 1, counts, self.board, self.elf))


def base_of(out: Path) -> Path:
    """Return OUT without the ending that it may have."""
    return out.with_suffix("") if out.suffix == INFO else out


def file_of(out: Path, ending: str) -> Path:
    base = base_of(out)
    return base.with_name(base.name + ending)


def check_coverage(out: Path, image: str) -> None:
    """Raise `LabError` when OUT cannot take the counts of an image, by its SHA-256."""
    counts, info = file_of(out, COUNTS), file_of(out, INFO)
    if not base_of(out).name or out.is_dir():
        raise LabError(f"{OPTION} {out}: a folder; expected the name of a file, with or without {INFO}")
    if counts.exists() and counts.stat().st_size:  # empty: a process was killed while it made it
        check_image(out, image, read_executed(out))
    elif info.exists():
        raise LabError(f"{OPTION} {out}: {info} exists without its {counts.name}: choose another name")
    made_folder(OPTION, out.parent)


def read_executed(out: Path) -> Executed:
    """Return the sums of OUT. Raises `LabError` where there are none."""
    path = file_of(out, COUNTS)
    try:
        with path.open("rb") as file:
            return _read(path, file)
    except OSError as error:
        raise LabError(f"{OPTION} {out}: {path}: {error.strerror or error}") from None


def add_executed(out: Path, flown: Executed) -> None:
    """Add a flight. Raises `LabError` when OUT has those of another image."""
    path, counts = file_of(out, COUNTS), flown.counts
    with writing(OPTION, out), _locked(path) as file:
        flights = flown.flights
        if file.seek(0, 2):
            file.seek(0)
            before = _read(path, file)
            check_image(out, flown.image, before)
            flights, counts = before.flights + flights, before.counts + counts
        places = np.flatnonzero(counts.any(axis=1)).astype(np.uint32)
        with replacing(path) as partial, partial.open("wb") as written:
            np.savez(
                written, image=flown.image, flights=flights, board=str(Path(flown.board).absolute()),
                elf="" if flown.elf is None else str(flown.elf.absolute()), places=places, counts=counts[places],
            )  # fmt: skip


def _read(path: Path, file: IO[bytes]) -> Executed:
    with reading(path), np.load(file, allow_pickle=False) as kept:
        counts = np.zeros((FLASH_SIZE // 2 + 1, 3), np.uint64)
        counts[kept["places"]] = kept["counts"]
        elf = str(kept["elf"])
        flights, board = int(kept["flights"]), str(kept["board"])
        return Executed(str(kept["image"]), flights, counts, board, Path(elf) if elf else None)


def check_image(out: Path, image: str, before: Executed) -> None:
    """Raise `LabError` when the sums of OUT are those of another image."""
    if before.image != image:
        raise LabError(
            f"{OPTION} {out}: has the coverage of another image ({before.image[:12]}…, this one is {image[:12]}…): "
            "choose another name, or delete its files"
        )


@contextmanager
def _locked(path: Path) -> Iterator[IO[bytes]]:
    """Yield the file, which exists from now on, while no other process adds to it."""
    while True:
        with path.open("a+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            is_current = path.exists() and os.path.samestat(path.stat(), os.fstat(file.fileno()))
            if is_current:  # not replaced by the process that had the lock before
                yield file
                return
