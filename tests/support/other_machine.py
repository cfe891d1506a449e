"""Exported C on another machine: AArch64 with glibc under qemu-user.

A program reads calls with their memory and answers with what they left there. Its stubs stand for what a method of
CPython needs of Python; the `self` of a method is the table of addresses itself.
"""

import re
import shutil
import struct
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_py.core_runner import CoreBlocks
from firmware_py.export.compilers import compile_texts, zig
from firmware_py.export.kernels import FLAGS
from firmware_py.export.methods import METHOD

PROGRAM = """
#include <stdint.h>
#include <stdio.h>

typedef void *Method(void *self, void *const *given, intptr_t count);
{declared}
static Method *const methods[] = {{ {names} }};
static long long answered;
char *PyBytes_AsString(void *object) {{ return object; }}
void *PyLong_FromLongLong(long long value) {{ answered = value; return &answered; }}
long long PyLong_AsLongLong(void *object) {{ return *(long long *)object; }}
void *PyErr_Occurred(void) {{ return 0; }}
int PyErr_BadArgument(void) {{ return 0; }}
void *PyObject_CallNoArgs(void *callable) {{ return callable; }}
void Py_DecRef(void *object) {{ (void)object; }}
char _Py_NoneStruct;

int main(void) {{
    static int64_t memory[1 << 19], head[{words}];
    // head: the method, how many numbers and arrays it takes, the numbers, the sizes of the arrays
    while (fread(head, sizeof head, 1, stdin) == 1) {{
        void *given[{words}], *places[{words}];
        const int64_t count = head[1], *sizes = head + 3 + count;
        char *place = (char *)memory;
        for (int i = 0; i < count; i++) given[i] = &head[3 + i];
        for (int i = 0; i < head[2]; place += (sizes[i++] + 63) / 64 * 64) {{
            places[i] = place;
            if (sizes[i] > 0 && fread(place, (size_t)sizes[i], 1, stdin) != 1) return 1;
        }}
        methods[head[0]](places, given, count);
        fwrite(&answered, sizeof answered, 1, stdout);
        for (int i = 0; i < head[2]; i++) fwrite(places[i], (size_t)sizes[i], 1, stdout);
        fflush(stdout);
    }}
}}
"""
WORDS = 64
QEMU, GLIBC = "qemu-aarch64", Path("/usr/aarch64-linux-gnu")


class OtherMachine:
    """A program with methods, which runs on another machine until the end of a `with` block.

    The test is skipped where that machine is missing.
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        if not shutil.which(QEMU):
            pytest.skip(f"no {QEMU} (package qemu-user)")
        if not GLIBC.is_dir():
            pytest.skip(f"no {GLIBC} (package libc6-arm64-cross)")
        found = re.findall(rf"^void \*{METHOD}(\w+)\(.*;$", "\n".join(texts.values()), re.MULTILINE)
        self._numbers = {name: number for number, name in enumerate(found)}
        methods = [METHOD + name for name in found]
        texts = texts | {  # type: ignore[operator]
            "program.c": PROGRAM.format(
                declared="".join(f"Method {name};\n" for name in methods),
                names=", ".join(methods),
                words=WORDS,
            )
        }
        flags = [flag for flag in FLAGS if flag not in ("-shared", "-fPIC")]
        sources = [name for name in texts if name.endswith(".c")]
        program = compile_texts(
            texts, (*sources, "-lm"), (*flags, "-target", "aarch64-linux-gnu"), "program", zig()
        )
        program.chmod(0o700)
        command = (QEMU, "-L", str(GLIBC), program)
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def call(self, name: str, arrays: Iterable[NDArray[np.generic]], *numbers: int) -> int:
        """Run a method on the memory of arrays; return its answer."""
        arrays = tuple(arrays)
        head = (self._numbers[name], len(numbers), len(arrays), *numbers, *(one.nbytes for one in arrays))
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        words = struct.pack(f"={WORDS}q", *head, *(0,) * (WORDS - len(head)))
        self._process.stdin.write(words + b"".join(one.tobytes() for one in arrays))
        self._process.stdin.flush()
        answer = int.from_bytes(self._process.stdout.read(8), "little", signed=True)
        for one in arrays:
            content = self._process.stdout.read(one.nbytes)
            if one.flags.writeable:
                one.reshape(-1).view(np.uint8)[:] = np.frombuffer(content, np.uint8)
        return answer

    def __enter__(self) -> "OtherMachine":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()  # it ends where there are no more calls


class CoreElsewhere:
    """Runs the flight core on another machine."""

    def __init__(self, machine: OtherMachine, core: CoreBlocks) -> None:
        self._machine, self._core = machine, core

    def call(self, name: str) -> int:
        """Execute an entry point."""
        blocks = (self._core.named[block] for block in self._core.calls[name])
        return self._machine.call(name, [block.memory for block in blocks])
