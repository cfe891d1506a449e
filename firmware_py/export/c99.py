"""The flight core as C99: one header and one source, written from the text of `firmware_py/core`.

    header, source = translate().header, translate().source

The C has the names, structs, docstrings and comments of the Python, static memory only, float32 only, and no library. It
forbids the fusing of multiplications with additions, so that every compiler gives the bits that flew in the emulator.
Kernels and constants that the entry points do not reach are left out.
"""

import ast
import dataclasses
import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from math import prod
from pathlib import Path

from firmware_py import core
from firmware_py.export.errors import ExportError
from firmware_py.export.functions import C_TYPES, FunctionPrinter, block_comment, constant_definition
from firmware_py.export.locals import find_writes
from firmware_py.export.reading import read_modules
from firmware_py.export.syntax import CORE, SHARED, VOID, Constant, Module, Signature, StructType

NO_PATHS: Mapping[str, str] = {}
WORD = 4  # bytes of every number

__all__ = ["ExportError", "Translation", "core_texts", "translate"]

GENERATED = "Written by `floaty deploy` from firmware_py/core; edit that, not this file."
COMPILER = """\
/* The bits of the emulator need IEEE single precision, each operation rounded by itself. */
#if defined(__FAST_MATH__)
#error "floaty_core.c must not be compiled with -ffast-math"
#endif
#if FLT_EVAL_METHOD != 0
#error "floaty_core.c needs arithmetic in float"
#endif
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off")
#endif
"""
CHECK = "#define LAYOUT(name, holds) typedef char layout_##name[(holds) ? 1 : -1]\n"


@dataclass(frozen=True, slots=True)
class Translation:
    """The C of the core; `entries`: how many blocks each entry point takes, and whether it has an answer."""

    header: str
    source: str
    version: str = ""  # hash of the Python sources
    entries: Mapping[str, tuple[int, bool]] = dataclasses.field(default_factory=dict)


def core_texts() -> dict[str, str]:
    """Return the sources of the core by module name, without the subset's own module."""
    folder = Path(core.__file__).parent
    paths = sorted(folder.glob("*.py"))
    return {path.stem: path.read_text("utf-8") for path in paths if path.stem not in ("__init__", "subset")}


def translate(texts: Mapping[str, str] | None = None, own: Mapping[str, str] = NO_PATHS) -> Translation:
    """Return the core as C; `texts` replaces its sources, `own` has the files of the user's modules.

    Raises `ExportError` for anything outside the subset.
    """
    return _default_core() if texts is None else _translated(texts, own)


@cache
def _default_core() -> Translation:
    return _translated(core_texts(), NO_PATHS)


def _translated(texts: Mapping[str, str], own: Mapping[str, str]) -> Translation:
    modules = read_modules(texts, own)
    kernels = [thing for module in modules for thing in module.defined if isinstance(thing, Signature)]
    _rename_equal_constants(modules)
    for kernel in kernels:
        find_writes(kernel)
    public = [kernel for kernel in kernels if kernel.public]
    reached = {kernel.c_name for kernel in public}.union(*(kernel.calls for kernel in public))
    kernels = [kernel for kernel in kernels if kernel.c_name in reached]
    printers, printed = {}, {}
    for kernel in reversed(kernels):  # callers first: they show the shapes of array arguments
        printers[kernel.c_name] = FunctionPrinter(kernel)
        printed[kernel.c_name] = printers[kernel.c_name].text()
    used = {id(constant) for printer in printers.values() for constant in printer.constants}
    version = hashlib.sha256("\0".join(texts[module.name] for module in modules).encode()).hexdigest()[:12]
    header = _header(modules, [printers[kernel.c_name] for kernel in public], version)
    entries = {one.c_name.removeprefix(CORE): (len(one.arguments), one.result != VOID) for one in public}
    return Translation(header, _source(modules, printed, used), version, entries)


def check(modules: list[Module], hooks: Iterable[str]) -> None:
    """Print the kernels that the hooks of the user's module, the last one, reach: its `refusals` have all that cannot."""
    for module in modules:
        for kernel in module.defined:
            if isinstance(kernel, Signature):
                find_writes(kernel)
    kernels = [thing for thing in modules[-1].defined if isinstance(thing, Signature)]
    roots = [kernel for kernel in kernels if kernel.node.name in hooks]
    reached = {kernel.c_name for kernel in roots}.union(*(kernel.calls for kernel in roots))
    for kernel in reversed(kernels):  # callers first: they show the shapes of array arguments
        if kernel.c_name in reached:
            FunctionPrinter(kernel).check()


def _rename_equal_constants(modules: list[Module]) -> None:
    """Put the module's name before the constants that several modules define."""
    owned = [(module, thing) for module in modules for thing in module.defined if isinstance(thing, Constant)]
    counts = Counter(constant.c_name for _, constant in owned)
    for module, constant in owned:
        if counts[constant.c_name] > 1:
            constant.c_name = f"{module.name.upper()}_{constant.c_name}"


def _header(modules: list[Module], public: list[FunctionPrinter], version: str) -> str:
    shared = next((module for module in modules if module.name == SHARED), None)
    own = shared.defined if shared else []
    parts = [
        block_comment(f"The flight core of Floaty.\n\n{shared.doc if shared else ''}\n\n{GENERATED}"),
        "#ifndef FLOATY_CORE_H\n#define FLOATY_CORE_H\n\n#include <stdint.h>\n\n",
        f'#define FLOATY_CORE_VERSION "{version}"  // hash of the Python sources\n\n',
        "".join(constant_definition(thing) + "\n" for thing in own if isinstance(thing, Constant)),
        *(f"\n{struct_definition(thing)}" for thing in _structs(modules)),
        "\n/* A profile as written by profile_c.py: a hash of its values, and the call that writes them. */\n",
        "extern const char floaty_profile_hash[];\n",
        "void floaty_core_init(FloatyParameters *parameters);\n",
    ]
    for printer in public:
        doc = ast.get_docstring(printer.kernel.node) or ""
        parts.append(f"\n{block_comment(doc)}{printer.signature()};\n")
    parts.append("\n#endif\n")
    return "".join(parts)


def _structs(modules: list[Module]) -> list[StructType]:
    return [thing for module in modules for thing in module.defined if isinstance(thing, StructType)]


def struct_definition(struct: StructType) -> str:
    """Return the definition of a struct with its comments."""
    lines = []
    for member in struct.fields.values():
        if member.above:
            lines.append(f"    // {member.above}")
        sizes = "".join(f"[{size}]" for size in member.kind.shape)
        comment = f"  // {member.comment}" if member.comment else ""
        lines.append(f"    {C_TYPES[member.kind.base]} {member.name}{sizes};{comment}")
    body = "\n".join(lines)
    return f"{block_comment(struct.doc)}typedef struct {{\n{body}\n}} Floaty{struct.name};\n"


def _source(modules: list[Module], printed: Mapping[str, str], used: set[int]) -> str:
    parts = [
        block_comment(f"The flight core of Floaty. {GENERATED}"),
        '#include "floaty_core.h"\n\n#include <float.h>\n#include <stdbool.h>\n#include <stddef.h>\n\n',
        COMPILER,
    ]
    for module in modules:
        own = [
            thing
            for thing in module.defined
            if isinstance(thing, Constant) and not thing.shared and id(thing) in used
        ]
        functions = [
            printed[thing.c_name]
            for thing in module.defined
            if isinstance(thing, Signature) and thing.c_name in printed
        ]
        if own or functions:
            path = Path(module.path).name if module.own else module.path
            parts.append("\n" + block_comment(f"{path}\n\n{module.doc}"))
        if own:
            parts.append("\n" + "".join(f"{constant_definition(thing)}\n" for thing in own))
        parts += [f"\n{function}" for function in functions]
    return "".join((*parts, _layout(modules)))


def _layout(modules: list[Module]) -> str:
    """Return checks that the structs lie in memory as numpy lays them out."""
    lines = ["\n/* The structs lie in memory as the emulator has them. */\n", CHECK]
    for struct in _structs(modules):
        name, place, offsets = f"Floaty{struct.name}", 0, []
        for field in struct.fields.values():
            offsets.append(f"LAYOUT({name}_{field.name}, offsetof({name}, {field.name}) == {place});\n")
            place += WORD * prod(field.kind.shape)
        lines += [f"LAYOUT({name}, sizeof({name}) == {place});\n", *offsets]
    return "".join(lines)
