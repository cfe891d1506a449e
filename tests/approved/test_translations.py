"""What the translators said to random programs with a mistake, they still say: the refusal, or a hash of the C.

Two thirds of the mistakes are statements that users write, the others wrong operators, calls and numbers. If a change is
meant: make approve.
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
from firmware_py.export.errors import ExportError
from firmware_py.export.kernels import translate
from firmware_py.export.live_reading import Arrays
from firmware_py.logic.loading import LogicError, check_file
from support.approved import approve, judge
from support.random_frames import KERNEL, KERNEL_HEAD, LIVE, OWN, law_of, names_in
from support.random_mistakes import mistaken
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


FINDERS = {"laws": laws, "kernels": kernels}


@pytest.mark.parametrize("name", FINDERS)
def test_a_program_with_a_mistake_is_told_what_it_was_told(name: str) -> None:
    judge(KNOWN, name, FINDERS[name]())


if __name__ == "__main__":
    approve(KNOWN, FINDERS)
