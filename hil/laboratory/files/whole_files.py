"""Writes files that are whole or absent, also when the process is killed or the disk is full."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PARTIAL = ".partial"  # the end of the name of a file that is being written


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file in the same folder, which replaces `path` at the end; an error deletes it."""
    place = path.resolve() if path.is_symlink() else path  # the link stays
    partial = place.with_name(place.name + PARTIAL)
    try:
        yield partial
        partial.replace(place)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text file; until it is whole, the older one stays."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
