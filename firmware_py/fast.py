"""Compiled modules: imports use what `make fast` has built instead of the sources, until a source changes.

`tools/fast.py` compiles the modules of the lockstep loop with mypyc. The results are in `firmware_py/compiled/`, where
Python itself does not look, beside a record of their sources. A finder ahead of all others returns them
while the record matches the present sources; otherwise all modules are pure Python and `STALE` is the reason.
FLOATY_PURE in the environment does the same: under a debugger, and in tests that replace parts of a class.
"""

import hashlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parent.parent
FOLDER = Path(__file__).parent / "compiled"
RECORD = "record.json"  # {"sources": {path from ROOT: digest}, "modules": {name: file}}
SWITCH = "FLOATY_PURE"


class CompiledModules(MetaPathFinder):
    """Finds compiled modules by their full names."""

    def __init__(self, files: Mapping[str, Path]) -> None:
        self._files = files

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where a compiled module is, None for all others."""
        file = self._files.get(fullname)
        if file is None:
            return None
        return spec_from_file_location(fullname, file, loader=ExtensionFileLoader(fullname, str(file)))


def digest(source: Path) -> str:
    """Return a hash of a file's content; empty when there is no file."""
    return hashlib.sha256(source.read_bytes()).hexdigest() if source.is_file() else ""


def usable(folder: Path = FOLDER, root: Path = ROOT) -> tuple[dict[str, Path], str]:
    """Return the compiled modules by name, and why they cannot be used, if they cannot."""
    if SWITCH in os.environ or not (folder / RECORD).is_file():
        return {}, ""
    record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    files = {name: folder / file for name, file in record["modules"].items()}
    for path, made_of in record["sources"].items():
        if digest(root / path) != made_of:
            return {}, f"{path} has changed since"
    for file in files.values():
        if not file.is_file() or not file.name.endswith(EXTENSION_SUFFIXES[0]):
            return {}, f"{file.name} is none of this Python's modules, {EXTENSION_SUFFIXES[0]}"
    return files, ""


MODULES, STALE = usable()
STATE = "compiled by mypyc" if MODULES else "pure Python"
if MODULES:
    sys.meta_path.insert(0, CompiledModules(MODULES))
