"""The laboratory's kernels as C, compiled into a library with a method of CPython for each.

    path = library((begin, move), (body, air, flaps, draws))

A method has the addresses of blocks and arrays in its `self`, as `firmware_py.compiling.bound` uses it. Every operation is
rounded by itself: all compilers and plain Python compute the same bits.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from firmware_py.export.c99 import CHECK, struct_definition
from firmware_py.export.compilers import LIBRARY_FLAGS, Compiler, by_first_that_works, compile_texts
from firmware_py.export.coroutines import printer_of
from firmware_py.export.errors import ExportError
from firmware_py.export.functions import block_comment, constant_definition
from firmware_py.export.live_printing import HELPERS
from firmware_py.export.live_reading import CALL, Arrays, Kernels, LiveModule, read_kernels
from firmware_py.export.methods import METHOD, PROTOTYPES, method
from firmware_py.export.syntax import BOOL, I64, VOID, Constant

FLAGS = ("-O2", *LIBRARY_FLAGS, "-ffp-contract=off", "-fno-math-errno")
HEAD = """\
#include <float.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if FLT_EVAL_METHOD != 0
#error "the world needs arithmetic in double"
#endif

"""


def translate(functions: Sequence[Callable[..., Any]], arrays: Arrays) -> str:
    """Return the C of kernels on memory of this kind, with all that they call. Raises `ExportError`."""
    found = read_kernels(functions, arrays)
    kernels, roots = found.kernels, found.roots
    for root in roots:
        if root.result not in (VOID, BOOL, I64):
            raise ExportError(f"{root.c_name} returns a float: a method of CPython returns whole numbers")
    reached = {one for root in roots for one in (root.c_name, *root.calls)}
    printed: dict[str, str] = {}
    used: dict[str, Constant] = {}
    for kernel in reversed(kernels):  # callers first: they show the shapes of array arguments
        if kernel.c_name in reached:
            assert isinstance(kernel.scope, LiveModule)
            printer = printer_of(kernel)
            printed[kernel.c_name] = printer.text()
            used |= {one.c_name: one for one in printer.constants}
    return "".join(
        (
            block_comment("Kernels, written from Python by firmware_py/export/kernels.py"),
            f"{HEAD}{PROTOTYPES}\n",
            *(f"{struct_definition(struct)}\n" for struct, _ in found.structs),
            _layout(found),
            f"\n{HELPERS}\n",
            *(f"{constant_definition(one)}\n" for one in used.values()),
            *(f"\n{text}" for text in reversed(printed.values())),
            *(
                method(
                    METHOD + function.__name__,
                    root.c_name,
                    len(arrays),
                    root.result != VOID,
                    len(root.arguments) - len(arrays),
                    CALL in root.calls,
                )
                for function, root in zip(functions, roots, strict=True)
            ),
        )
    )


def library(functions: Sequence[Callable[..., Any]], arrays: Arrays) -> Path:
    """Return the library of kernels by the first compiler that works. Raises `ExportError` without any."""
    return by_first_that_works(partial(build, translate(functions, arrays)))


def build(text: str, compiler: Compiler, flags: tuple[str, ...] = ()) -> Path:
    """Return the library of a kernel in C; it is compiled unless it is kept. Raises `ExportError`."""
    return compile_texts({"kernels.c": text}, ("kernels.c", "-lm"), (*FLAGS, *flags), "kernels.so", compiler)


def _layout(found: Kernels) -> str:
    """Return checks that the structs lie in memory as numpy lays them out."""
    lines = [CHECK]
    for struct, dtype in found.structs:
        name = f"Floaty{struct.name}"
        lines.append(f"LAYOUT({name}, sizeof({name}) == {dtype.itemsize});\n")
        for field, (_, offset, *_rest) in (dtype.fields or {}).items():
            lines.append(f"LAYOUT({name}_{field}, offsetof({name}, {field}) == {offset});\n")
    return "".join(lines)
