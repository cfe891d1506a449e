"""What the translators said to random programs with a mistake, they still say: the refusal, or a hash of the C.

Two thirds of the mistakes are statements that users write, the others wrong operators, calls and numbers. If a change is
meant: make approve.
"""

import hashlib
import tempfile
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from textwrap import indent

import numpy as np
import pytest

from firmware_py.core.subset import i32
from firmware_py.export.errors import ExportError
from firmware_py.export.kernels import translate
from firmware_py.logic.loading import LogicError, check_file
from support.approved import approve, judge
from support.random_frames import KERNEL, KERNEL_HEAD, LIVE, OWN, law_of
from support.random_mistakes import mistaken
from support.random_programs import Programs

KNOWN = Path(__file__).with_name("translations.json")
LAWS, KERNELS = 100, 100


def laws() -> list[str]:
    """Return what is said of each law of a user."""
    said = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "law.py"
        for seed in range(LAWS):
            body, mistake = mistaken(Programs(OWN, seed).body() + "\nreturn x", seed)
            path.write_text(law_of([body]), encoding="utf-8")
            try:
                text = hashed(check_file(path).translation.source)
            except (ExportError, LogicError) as error:
                text = str(error).replace(folder, "")
            said.append(f"{mistake}: {text}")
    return said


def kernels() -> list[str]:
    """Return what is said of each kernel of the laboratory."""
    bodies = [mistaken(Programs(LIVE, seed).body(), seed) for seed in range(KERNELS)]
    memory, said = (np.zeros(5), np.zeros(3, i32)), []
    with tempfile.TemporaryDirectory() as folder:
        for seed, (body, mistake) in enumerate(bodies):
            path = Path(folder) / f"kernels_{seed}.py"
            path.write_text(
                KERNEL_HEAD + KERNEL.format(name=seed, body=indent(body, "    ")), encoding="utf-8"
            )
            spec = spec_from_file_location(path.stem, path)
            assert spec is not None
            assert spec.loader is not None
            module = module_from_spec(spec)
            try:
                spec.loader.exec_module(module)
                text = hashed(translate((vars(module)[f"random_{seed}"],), memory))
            except (ExportError, SyntaxError) as error:
                text = str(error).replace(folder, "")
            said.append(f"{mistake}: {text}")
    return said


def hashed(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


FINDERS = {"laws": laws, "kernels": kernels}


@pytest.mark.parametrize("name", FINDERS)
def test_a_program_with_a_mistake_is_told_what_it_was_told(name: str) -> None:
    judge(KNOWN, name, FINDERS[name]())


if __name__ == "__main__":
    approve(KNOWN, FINDERS)
