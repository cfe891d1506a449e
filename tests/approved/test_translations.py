"""What the translators said to random programs with a mistake, they still say: the refusal, or a hash of the C.

Two thirds of the mistakes are statements that users write, the others wrong operators, calls and numbers. Modules of
random structs and hooks are read as they were. If a change is meant: make approve.
"""

import hashlib
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from textwrap import indent

import numpy as np
import pytest

from firmware_py.core.subset import i32
from firmware_py.export.c99 import core_texts
from firmware_py.export.errors import ExportError
from firmware_py.export.kernels import translate
from firmware_py.export.live_reading import Arrays
from firmware_py.export.reading import read_modules
from firmware_py.logic.loading import LogicError, check_file
from firmware_py.logic.plugs import POINTS, read_plug
from support.approved import approve, judge, tiers
from support.random_frames import KERNEL, KERNEL_HEAD, LIVE, OWN, law_of, names_in
from support.random_mistakes import mistaken
from support.random_modules import random_module
from support.random_programs import Programs

KNOWN = Path(__file__).with_name("translations.json")
LAWS, KERNELS = 100, 100


def laws() -> list[str]:
    """Return the translator's answer to each control law of a user."""
    said = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "law.py"
        for seed in range(LAWS):
            body, mistake = mistaken(Programs(OWN, seed).body() + "\nreturn x", seed)
            path.write_text(law_of([body]), encoding="utf-8")
            said.append(f"{mistake}: {answer(folder, lambda: check_file(path).translation.source)}")
    return said


def kernels() -> list[str]:
    """Return the translator's answer to each kernel of the laboratory."""
    memory, said = (np.zeros(5), np.zeros(3, i32)), []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(KERNELS):
            body, mistake = mistaken(Programs(LIVE, seed).body(), seed)
            path, name = Path(folder) / f"kernels_{seed}.py", f"random_{seed}"
            path.write_text(
                KERNEL_HEAD + KERNEL.format(name=seed, body=indent(body, "    ")), encoding="utf-8"
            )
            said.append(f"{mistake}: {answer(folder, partial(kernel_in_c, path, name, memory))}")
    return said


def kernel_in_c(path: Path, name: str, memory: Arrays) -> str:
    """Return the C of a kernel in a file."""
    return translate((names_in(path)[name],), memory)


def answer(folder: str, translated: Callable[[], str]) -> str:
    """Return the hash of a translation, or why there is none."""
    try:
        return hashlib.sha256(translated().encode()).hexdigest()[:12]
    except (ExportError, LogicError, SyntaxError) as error:
        return str(error).replace(folder, "")


def modules() -> list[list[str]]:
    """Return what modules provide at each plug point, and their refusals."""
    core, said = core_texts(), []
    for point in POINTS:
        for seed in range(6):
            text = random_module(point.name, seed)
            module = read_modules(core | {"own": text}, {"own": point.name}, "own")[-1]
            plug = read_plug(point, module)
            hooks = [f"{hook} {arguments}" for hook, arguments in plug.hooks.items()]
            bounds = [f"{one.name} {one.low:g} {one.high:g} {one.default:g}" for one in plug.parameters]
            named = [
                f"{one.name} {one.scalar.name} {one.unit} in {one.place.block}.{one.place.field} {one.place.index}"
                for one in (*plug.parameters, *plug.variables)
            ]
            said.append([*plug.structs, *hooks, *bounds, *named, *module.refusals.lines()])
    return said


FINDERS = {"laws": laws, "kernels": kernels, "modules": modules}


@pytest.mark.parametrize("name", tiers(FINDERS, ("laws",)))
def test_a_program_with_a_mistake_is_told_what_it_was_told(name: str) -> None:
    judge(KNOWN, name, FINDERS[name]())


if __name__ == "__main__":
    approve(KNOWN, FINDERS)
