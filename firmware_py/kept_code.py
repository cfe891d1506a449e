"""Where compiled code is kept, and the check before it is loaded. No other file chooses such a folder.

Machine code and the bytecode of templates act with all rights of the user who loads them. So
they are in one folder, which only this user may own and write: `floaty` in the cache folder, or in FLOATY_CACHE_DIR; never
beside their sources, in a project, in a run folder or in the current folder. Where that folder cannot be used,
`floaty-UID` in the folder for temporary files serves under the same conditions, and after it a folder that is deleted
with the process.

    kernels/ libraries of flight core and world by their sources                      firmware_py/compiling.py
    c/       what a C compiler made, by its inputs                                    firmware_py/export/compilers.py
    zig/     that compiler's own cache                                                firmware_py/export/compilers.py
    pages/   templates of pages as bytecode                                           hil/pictures/pages.py

`*.pyc` belong to Python.
"""

import atexit
import os
import shutil
import stat
import sys
import tempfile
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Literal

Part = Literal["kernels", "c", "zig", "pages"]
PRIVATE = 0o700
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
UNUSED_S = 90 * 86_400  # then a folder of code is deleted


def kept_folder(part: Part, key: str = "") -> Path:
    """Return the folder of a part, or that of a key in it, which is made if it is missing."""
    name = sha256(key.encode()).hexdigest()[:16] if key else ""
    chosen, home = (os.environ.get(variable, "") for variable in ("FLOATY_CACHE_DIR", "XDG_CACHE_HOME"))
    try:
        return _made(_usable(chosen, home, tempfile.gettempdir()), part, name)
    except OSError:  # a full disk
        return _made(_temporary(), part, name)


def may_load(path: Path) -> bool:
    """Return whether a file is there that may be loaded. One that may not is reported and counts as missing."""
    why = _why_not(path)
    if why:
        report(f"{path}: {why}: it is not loaded")
    return not why and path.is_file()


def keep(path: Path, content: bytes) -> None:
    """Write a file in a kept folder, which may be read meanwhile. Raises `OSError`."""
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    partial.unlink(missing_ok=True)
    with open(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(content)
    partial.replace(path)


@cache
def _usable(chosen: str, home: str, temporary: str) -> Path:
    """Return the first folder that this user alone owns and may write; report each that is refused.

    `chosen` and `home` are the values of FLOATY_CACHE_DIR and XDG_CACHE_HOME; empty: not set.
    """
    for folder in (_in_cache(chosen), Path(temporary, f"floaty-{os.geteuid()}")):
        try:
            if not folder.is_absolute():
                raise OSError("not an absolute path")
            folder.parent.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
            folder.mkdir(mode=PRIVATE, exist_ok=True)
            why = _why_not(folder) or _why_not_in(folder.parent)
            if not why and not os.access(folder, os.W_OK | os.X_OK):
                why = "cannot be written"
        except OSError as error:
            why = f"cannot be used ({error.strerror or error})"
        if not why:
            return folder
        report(f"{folder}: {why}: compiled code is kept elsewhere")
    return _temporary()


def _in_cache(chosen: str) -> Path:
    if chosen:
        return Path(chosen, "floaty")
    from platformdirs import user_cache_path  # reads XDG_CACHE_HOME

    try:
        return user_cache_path("floaty", appauthor=False)
    except RuntimeError:  # of a user without a home folder; older versions return this
        return Path("~/.cache/floaty")


@cache
def _temporary() -> Path:
    """Return a folder that is deleted with the process."""
    folder = Path(tempfile.mkdtemp(prefix="floaty-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def _made(root: Path, part: Part, name: str) -> Path:
    """Return a folder below a usable one. A new one deletes those beside it that no process has used for long."""
    folder = root / part / name
    if not folder.is_dir():
        (root / part).mkdir(mode=PRIVATE, exist_ok=True)
        folder.mkdir(mode=PRIVATE, exist_ok=True)
        unused_since = folder.stat().st_mtime - UNUSED_S
        for other in (root / part).iterdir():
            with suppress(OSError):
                if other.stat().st_mtime < unused_since:
                    shutil.rmtree(other, ignore_errors=True)
    else:
        with suppress(OSError):
            os.utime(folder)
    return folder


def _why_not(path: Path) -> str:
    """Return why a file or folder could have been written by somebody else; empty if not, or if it is missing."""
    try:
        found = path.lstat()
    except OSError:
        return ""
    if stat.S_ISLNK(found.st_mode):
        return "a link"
    if found.st_uid != os.geteuid():
        return "belongs to another user"
    return "others may write it" if found.st_mode & OTHERS_WRITE else ""


def _why_not_in(parent: Path) -> str:
    """Return why somebody else could replace a folder in this one; empty if not."""
    mode = parent.stat().st_mode
    return "in a folder that all may write" if mode & stat.S_IWOTH and not mode & stat.S_ISVTX else ""


def report(line: str) -> None:
    """Print a line about compiled code on standard error."""
    print("floaty:", line.encode("unicode_escape").decode("ascii"), file=sys.stderr)
