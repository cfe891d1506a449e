"""The exported C on this machine: compiled into a shared library whose methods Python binds to the core's blocks."""

from pathlib import Path

from firmware_py.export.c99 import Translation
from firmware_py.export.compilers import LIBRARY_FLAGS, Compiler, compile_texts, find_compiler
from firmware_py.export.methods import METHOD, PROTOTYPES, method
from firmware_py.export.syntax import CORE

FLAGS = (*LIBRARY_FLAGS, "-nostdlib", "-fno-math-errno")
STRICT = ("-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror")  # for tests: compilers differ


def build(
    translation: Translation,
    compiler: Compiler | None = None,
    optimisation: str = "-O2",
    flags: tuple[str, ...] = (),
) -> Path:
    """Return the shared library of the core; it is compiled unless it is kept."""
    compiler, inputs = compiler or find_compiler(), ("floaty_core.c", "methods.c")
    return compile_texts(
        texts_of(translation), inputs, (optimisation, *FLAGS, *flags), "floaty_core.so", compiler
    )


def texts_of(translation: Translation) -> dict[str, str]:
    """Return the library's sources."""
    methods = "".join(
        method(METHOD + name, CORE + name, arguments, answers)
        for name, (arguments, answers) in translation.entries.items()
    )
    return {
        "floaty_core.h": translation.header,
        "floaty_core.c": translation.source,
        "methods.c": f'#include "floaty_core.h"\n#include <stdint.h>\n\n{PROTOTYPES}{methods}',
    }
