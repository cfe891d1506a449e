"""Every kernel of the core gives the same bits compiled from the exported C as compiled by numba, each fed alone."""

import ctypes
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core.poses import LONG_US
from firmware_py.core.structs import (
    Control,
    Estimator,
    Input,
    Parameters,
    Report,
    Sampling,
    Struct,
    Supervisor,
)
from firmware_py.core.subset import F32s, Integer
from firmware_py.export.c99 import Translation, translate
from firmware_py.export.compilers import compilers
from firmware_py.export.native import build
from support import core_streams
from support.core_streams import BUILD, one_nan, wild_words

STRUCTS = (Parameters, Input, Estimator, Control, Sampling, Supervisor, Report)

SHAPES = {"x": 16, "dx": 16, "first": 16, "other": 16, "command": (32, 4), "P": (16, 16), "M": (16, 16), "q": 4,
          "attitude": 16, "pose": 16, "place": 3}  # fmt: skip
RANGES = {"flap": (0, 4), "state": (0, 16), "row": (0, 32), "offset": (0, 13), "turns": (-637, 638),
          "quarters": (0, 2), "word": (0, 65536), "ticks": (-(2**31), 2**31), "first": (0, 504), "last": (-1, 500),
          "tick": (0, 2000), "time_us": (-1, 10**9 + 1), "by_us": (0, 10**9 + 1), "cause": (0, 12)}  # fmt: skip
# Kernels whose callers clamp the argument.
INSIDE_1000 = {"maths_quarter_turns", "excitation_line_above", "excitation_chirp"}
SCALARS = {np.float32: ctypes.c_float, np.int32: ctypes.c_int32, Integer: ctypes.c_int32, bool: ctypes.c_bool,
           None: None}  # fmt: skip
C = translate()
PRIVATE = [name for name in C.functions if not name.startswith("floaty_core_")]


def all_public() -> Translation:
    return Translation(C.header, re.sub(r"^static (?=\w+ \w+\()", "", C.source, flags=re.M), C.functions)


def float_bits(rng: np.random.Generator, shape: Any) -> np.ndarray:
    """Random bits, special values and plausible ones, a third each."""
    choice = rng.integers(3, size=shape)
    wild = rng.integers(0, 2**32, shape, np.uint32).view(np.float32)
    values = np.where(choice == 0, wild, rng.choice(core_streams.SPECIAL_FLOATS, shape))
    return np.where(choice == 2, rng.normal(0, 2, shape), values).astype(np.float32)


def struct_block(rng: np.random.Generator, struct: type[Struct]) -> Any:
    """A block of wild floats (or sane ones) with indices and ticks inside their ranges."""
    block = parameters_of(core_streams.CONFIG) if struct is Parameters else struct.allocate()
    if rng.random() < 0.8:
        core_streams.fill(block, wild_words(rng, block))
    if struct is Estimator:
        fields = block.fields
        fields.filtered_tick = rng.integers(1000)
        fields.tick = fields.filtered_tick + rng.integers(13)
        fields.suspect_tick = rng.integers(1000)
        fields.suspect_waiting, fields.started = rng.integers(2, size=2)
        fields.pose_waiting[:] = rng.integers(2, size=32)
        fields.horizon = rng.integers(1, 13)
        for name in ("quiet_ticks", "fused", "refused", "jumps", "too_old", "invalid", "bounded", "resets"):
            setattr(fields, name, rng.integers(1000))
        if rng.random() < 0.7:
            fields.x[:], fields.P[:], fields.now[:] = rng.normal(0, 1, 16), rng.normal(0, 1, (16, 16)), 0.5
    if struct is Input:
        block.fields.gyro_sample[:] = rng.integers(-(2**15), 2**15, 3)
    if struct is Sampling:
        fields = block.fields
        fields.phase, fields.samples = rng.integers(10), rng.choice((0, 1, 510, 511))
        fields.first[:] = rng.integers(-(2**15), 2**15, 3)
        fields.sums[:] = rng.integers(-(2**24), 2**24, 3)
        fields.unchanged, fields.recovering = rng.integers(0, 21), rng.integers(0, 101)
    if struct is Supervisor:
        for name in ("silent_us", "low_us", "down_us", "watchdog_us", "episode_us", "gap_us", "outside_us"):
            setattr(block.fields, name, rng.choice((-1, 0, 1000, 5_000_000, LONG_US)))
    return block


def draws(rng: np.random.Generator, name: str, kind: Any, count: int) -> Iterator[Any]:
    """Yield arguments: numbers, arrays or blocks."""
    if inspect.isclass(kind) and issubclass(kind, Struct):
        return (struct_block(rng, kind) for _ in range(count))
    if kind == F32s:
        return (float_bits(rng, SHAPES[name]) for _ in range(count))
    if kind in (Integer, np.int32):
        return iter(rng.integers(*RANGES[name], count).astype(np.int32))
    return iter(float_bits(rng, count))


def bits(thing: Any) -> bytes:
    if isinstance(thing, np.ndarray | np.float32):
        return one_nan(np.atleast_1d(thing).view(np.uint32))
    return core_streams.block_bits(thing) if hasattr(thing, "memory") else b""


def to_c(argument: Any) -> Any:
    if isinstance(argument, np.ndarray):
        return ctypes.c_void_p(argument.ctypes.data)
    return ctypes.c_void_p(argument.memory.ctypes.data) if hasattr(argument, "memory") else argument.item()


def copied(argument: Any) -> Any:
    if not hasattr(argument, "memory"):
        return argument.copy()
    twin = next(struct for struct in STRUCTS if struct.dtype == argument.memory.dtype).allocate()
    core_streams.fill(twin, argument.bytes())
    return twin


@pytest.mark.skipif(not list(compilers()), reason="no C compiler")
@pytest.mark.parametrize("c_name", PRIVATE)
@pytest.mark.long
def test_every_kernel_gives_the_same_bits_in_c(c_name: str) -> None:
    module, _, name = c_name.partition("_")
    kernel: Any = getattr(import_module(f"firmware_py.core.{module}"), name)
    signature = inspect.signature(getattr(kernel, "py_func", kernel))
    kinds = {name: parameter.annotation for name, parameter in signature.parameters.items()}
    function = getattr(ctypes.CDLL(str(build(all_public(), BUILD))), c_name)
    function.restype = SCALARS[signature.return_annotation]
    scalar = [next((SCALARS[known] for known in SCALARS if kind == known), None) for kind in kinds.values()]
    function.argtypes = [c_type or ctypes.c_void_p for c_type in scalar]
    count = 10_000 if all(scalar) else 150
    rng = np.random.default_rng(len(c_name))
    for ours in zip(*(draws(rng, key, kind, count) for key, kind in kinds.items()), strict=True):
        if c_name in INSIDE_1000 and not abs(ours[0]) <= 1000:
            continue
        theirs = [copied(argument) for argument in ours]
        expected = kernel(*(a.arg[0] if hasattr(a, "memory") else a for a in ours))
        got = function(*map(to_c, theirs))
        if function.restype is ctypes.c_float:
            got, expected = (bits(np.float32(value)) for value in (got, expected))
        assert got == expected, ours
        for key, c_type, mine, other in zip(kinds, scalar, ours, theirs, strict=True):
            assert c_type or bits(mine) == bits(other), key
