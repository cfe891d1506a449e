"""Compiles the modules of the lockstep loop with mypyc into `firmware_py/compiled/`: same sources, same hashes, faster.

    python tools/fast.py    (`make fast`; needs a C compiler and Python's headers, takes a minute or two)

`firmware_py/fast.py` uses them until one of their sources changes. Modules with pydantic models, kernels or
protocols checked at run time cannot be compiled, nor classes that others inherit or copy, or that pydantic reads; code that
runs once per flight need not be. Compiled code converts an int to a float where the type is `float`: values that may be
ints have another type.
"""

import ast
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import setuptools  # mypyc checks that it is installed
from mypyc.build import mypycify

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
os.environ["FLOATY_PURE"] = "1"  # ignore older compiled modules

from firmware_py.fast import FOLDER, RECORD, digest  # noqa: E402 - from this tree, and pure

PACKAGES = ("firmware_py", "ground_station", "hil")
MODULES = {
    "firmware_py": "firmware geometry pilot supervisor",
    "firmware_py/crazyflie": "commander planner stabilizer supervisor",
    "firmware_py/links": "crtp_stack localisation log",
    "firmware_py/wire": "crtp log telemetry",
    "ground_station": "corrections mocap pose_filter station telemetry_log tracker",
    "ground_station/links": "log_blocks loopback",
    "hil": "events",
    "hil/crazyflie": "shockburst",
    "hil/devices": "board cameras radio",
    "hil/laboratory": "channels flight laboratory lockstep recorder robot",
    "hil/world": "battery servos",
}
FILES = [f"{folder}/{name}.py" for folder, names in MODULES.items() for name in names.split()]


def sources_of(modules: Iterable[str], root: Path = ROOT) -> list[Path]:
    """Return our files on which modules depend, including themselves: mypyc takes types and constants from them."""
    found: set[Path] = set()
    waiting = [root / module for module in modules]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imported(path, root)
    return sorted(found)


def _imported(path: Path, root: Path) -> Iterator[Path]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            if name.partition(".")[0] in PACKAGES:
                for file in (
                    root / f"{name.replace('.', '/')}.py",
                    root / name.replace(".", "/") / "__init__.py",
                ):
                    if file.is_file():
                        yield file


def build(modules: Iterable[str] = FILES) -> None:
    """Compile the modules of this tree; delete the older compiled ones first."""
    modules = list(modules)
    shutil.rmtree(FOLDER, ignore_errors=True)
    sources = {str(path.relative_to(ROOT)): digest(path) for path in sources_of(modules)}
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory() as work:
        extensions = mypycify(modules, opt_level="2", debug_level="0", multi_file=True, target_dir=work)
        distribution = setuptools.Distribution({"name": "floaty-compiled", "ext_modules": extensions})
        command = distribution.get_command_obj("build_ext")
        command.build_lib, command.build_temp = f"{work}/lib", f"{work}/temp"
        command.parallel = os.cpu_count()
        command.ensure_finalized()
        command.run()
        FOLDER.mkdir()
        files = {}
        for extension in extensions:
            built = Path(command.get_ext_fullpath(extension.name))
            files[extension.name] = extension.name + "".join(built.suffixes)
            shutil.move(built, FOLDER / files[extension.name])
    record = {"sources": sources, "modules": files}
    (FOLDER / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    build()
    print(f"{len(FILES)} modules compiled; floaty --version says whether they are in use")
