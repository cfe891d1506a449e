"""A disk that is full: files cannot become larger."""

import os
import resource
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SMALL_KB = 100


@contextmanager
def small_files(limit: int) -> Iterator[None]:
    """No file may become larger than `limit` bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)


@contextmanager
def small_disk(folder: Path) -> Iterator[tuple[str, ...]]:
    """Make `folder` a file system of 100 kB; yield what to type before a program so that it sees a full disk.

    A user who may not mount gets a limit for each file instead.
    """
    folder.mkdir()
    mount = ("mount", "-t", "tmpfs", "-o", f"size={SMALL_KB}k", "tmpfs", folder)
    if os.geteuid() or subprocess.run(mount, stderr=subprocess.DEVNULL, check=False).returncode:
        yield "prlimit", f"--fsize={SMALL_KB * 1024}"
        return
    try:
        yield ()
    finally:
        subprocess.run(("umount", folder), check=True)
