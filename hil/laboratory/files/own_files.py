"""Loads users' Python files: each is executed once per content, and can import modules beside it."""

import hashlib
import sys
from pathlib import Path
from types import ModuleType

from hil.errors import LabError, blame, refusing

_LOADED: dict[Path, tuple[str, ModuleType]] = {}  # with the hash of the executed text
_FOLDERS: set[str] = set()  # of such files, last in `sys.path`, the latest of them first


def load_file(what: str, path: Path) -> tuple[ModuleType, str]:
    """Return the module of a file, and the file's SHA-256. Raises a `LabError` that begins with `what` and the path."""
    place = path.resolve()
    with refusing(f"{what} {path}: ", OSError):
        content = place.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    known, module = _LOADED.get(place, ("", None))
    if module is not None and known == digest:
        return module, digest
    name = f"floaty_own_{place.stem}_{hashlib.sha256(str(place).encode()).hexdigest()[:12]}"
    module = ModuleType(name)
    module.__file__ = str(place)
    _prefer(place.parent)
    sys.modules[name] = module  # pickled objects refer to it
    try:
        exec(compile(content, place, "exec"), vars(module))
    except (Exception, SystemExit) as error:  # its exit code would be taken for the command's
        raise LabError(f"{what} {path}: {blame(error)}") from error
    _LOADED[place] = digest, module
    return module, digest


def _prefer(folder: Path) -> None:
    """Let a file of a folder import what is beside it, not modules of the same names beside a file of another folder."""
    for beside in folder.glob("*.py"):
        imported = Path(getattr(sys.modules.get(beside.stem), "__file__", None) or beside)
        if imported != beside and str(imported.parent) in _FOLDERS:
            del sys.modules[beside.stem]
    own = str(folder)
    if own in _FOLDERS:
        sys.path.remove(own)
    elif own in sys.path:
        return
    _FOLDERS.add(own)
    sys.path.insert(next((i for i, path in enumerate(sys.path) if path in _FOLDERS), len(sys.path)), own)
