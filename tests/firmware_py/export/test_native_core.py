"""The exported C gives Python's bits in whole flights and on arbitrary bits, and a changed operator shows."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.core.structs import Control, Report, Sampling, Supervisor
from firmware_py.export.c99 import translate
from firmware_py.export.compilers import Compiler, compilers, find_compiler
from firmware_py.export.errors import ExportError
from firmware_py.export.native import build, texts_of
from support import core_streams
from support.core_streams import Recording, first_difference, record_flight, record_plausible, record_wild
from support.other_machine import CoreElsewhere, OtherMachine
from support.paths import ROOT, TESTS

C = translate()
COMPILERS = [compiler for compiler in compilers() if compiler.name != "cc"]
IDS = [compiler.name for compiler in COMPILERS]
GCC = next((compiler for compiler in COMPILERS if compiler.name == "gcc"), None)
gcc_only = pytest.mark.skipif(GCC is None, reason="no gcc")

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")


@pytest.fixture(scope="module")
def flight() -> Recording:
    return record_flight(3.0)


@pytest.fixture(scope="module")
def wild() -> Recording:
    return record_wild(2026, 500)


@pytest.fixture(scope="module")
def plausible() -> Recording:
    return record_plausible(2027, 250)


@pytest.mark.long
@pytest.mark.parametrize("optimisation", ["-O0", "-O2", "-O3"])
@pytest.mark.parametrize("compiler", COMPILERS, ids=IDS)
def test_c_gives_the_bits_of_python_in_every_call_of_a_flight_and_on_arbitrary_bits(
    compiler: Compiler, optimisation: str, flight: Recording, plausible: Recording, wild: Recording
) -> None:
    library = build(C, compiler, optimisation)
    assert len(flight.steps) > 1500
    assert {step.call for step in flight.steps} >= {
        "reset",
        "file_pose",
        "take_sample",
        "estimate",
        "supervise",
        "control",
    }
    assert first_difference(flight, library) is None
    assert first_difference(plausible, library) is None
    assert first_difference(wild, library) is None


@pytest.mark.long
@pytest.mark.skipif("zig" not in IDS, reason="no ziglang")
def test_another_machine_computes_the_same_bits(
    flight: Recording, plausible: Recording, wild: Recording
) -> None:
    """Of all calls; whole flights are in test_same_bits.py."""
    with OtherMachine(texts_of(C)) as machine:
        for recording in (flight, plausible, wild):
            assert first_difference(recording, partial(CoreElsewhere, machine)) is None


@gcc_only
@pytest.mark.skipif("fma" not in Path("/proc/cpuinfo").read_text(), reason="this processor cannot fuse")
@pytest.mark.long
def test_the_file_itself_forbids_fused_multiplications(flight: Recording) -> None:
    fusing = ("-std=gnu11", "-mfma", "-ffp-contract=fast")
    assert first_difference(flight, build(C, GCC, "-O2", fusing)) is None
    free = C.source.replace('#pragma GCC optimize("fp-contract=off")', "")
    assert free != C.source
    assert first_difference(flight, build(replace(C, source=free), GCC, "-O2", fusing)) is not None


ARITHMETIC = re.compile(r" ([-+*/]) ")
INTEGERS = re.compile(r"tick|turns|int32_t|row|word|LAYOUT|enum|^[#/ ]\*|\+ 1;|COUNT")


def changeable(source: str) -> list[int]:
    """Return where the float operators stand: outside indices, and not in lines of integer arithmetic."""
    places, start = [], 0
    for line in source.splitlines(keepends=True):
        code = line.split("//")[0]
        if code.startswith("    ") and not INTEGERS.search(code):
            operators = (match.start(1) for match in ARITHMETIC.finditer(code))
            places += [start + at for at in operators if code[:at].count("[") == code[:at].count("]")]
        start += len(line)
    return places


@pytest.mark.long
def test_a_changed_operator_is_caught(plausible: Recording, wild: Recording, flight: Recording) -> None:
    places = changeable(C.source)
    assert len(places) > 100
    chosen = np.random.default_rng(7).choice(places, 30, replace=False)
    for place in map(int, chosen):
        other = {"+": "-", "-": "+", "*": "+", "/": "*"}[C.source[place]]
        changed = replace(C, source=C.source[:place] + other + C.source[place + 1 :])
        library = build(changed, optimisation="-O0")
        recordings = (plausible, wild, flight)  # only a flight seeks the gyro's zero to its end
        caught = any(first_difference(recording, library) is not None for recording in recordings)
        line = C.source.count("\n", 0, place) + 1
        assert caught, f"floaty_core.c:{line}: {C.source.splitlines()[line - 1].strip()} with {other}"


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_arbitrary_bits_give_equal_bits_and_counts_inside_the_servo_limits(seed: int) -> None:
    recording = record_wild(seed, 120)
    assert first_difference(recording, build(C)) is None
    behind = sum(struct.dtype.itemsize for struct in (Control, Sampling, Supervisor, Report))
    at = Control.dtype.fields["count"][1] - behind  # from the end
    for step, after in zip(recording.steps, recording.after, strict=True):
        if step.call == "control":
            counts = np.frombuffer(after[at : at + 16], np.int32)
            assert ((counts >= 21_000) & (counts <= 42_000)).all(), counts


def in_a_process(library: Path, seed: int) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "ignore", core_streams.__file__, str(library), str(seed)]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{TESTS}"}
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


@pytest.mark.long
@gcc_only
def test_arbitrary_bits_meet_no_undefined_behaviour_and_an_unclamped_conversion_is_one() -> None:
    flags = ("-fsanitize=undefined,float-cast-overflow,bounds-strict", "-fsanitize-undefined-trap-on-error")
    done = in_a_process(build(C, GCC, "-O0", flags), 3)
    assert done.stdout == "done\n", done.stderr
    start = C.source.index("(int32_t)maths_clamp(")
    end = C.source.index(", 0.0f", start)
    close = C.source.index(");", end)
    free = C.source[:start] + "(int32_t)(" + C.source[start:end].split("maths_clamp(")[1] + C.source[close:]
    broken = replace(C, source=free)
    done = in_a_process(build(broken, GCC, "-O0", (*flags, "-Wno-unused")), 3)
    assert done.returncode < 0
    assert done.stdout == ""


def test_a_missing_compiler_is_one_line_with_the_package() -> None:
    with pytest.raises(ExportError, match=r"no C compiler tcc on this machine: .*pip install .*ziglang"):
        find_compiler("tcc")


@pytest.mark.long
def test_a_library_that_is_there_is_not_compiled_again() -> None:
    library = build(C, optimisation="-O0")
    made = library.stat().st_mtime_ns
    assert build(C, optimisation="-O0").stat().st_mtime_ns == made
    assert build(C, optimisation="-O1") != library
