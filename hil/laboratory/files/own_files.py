"""Loads users' Python files: each is executed once per content, and can import modules beside it."""

import hashlib
import sys
from pathlib import Path
from types import ModuleType

from hil.errors import LabError, blame, refusing

_LOADED: dict[Path, tuple[str, ModuleType]] = {}  # with the hash of the executed text


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
    if str(place.parent) not in sys.path:
        sys.path.append(str(place.parent))
    sys.modules[name] = module  # pickled objects refer to it
    try:
        exec(compile(content, place, "exec"), vars(module))
    except (Exception, SystemExit) as error:  # its exit code would be taken for the command's
        raise LabError(f"{what} {path}: {blame(error)}") from error
    _LOADED[place] = digest, module
    return module, digest
