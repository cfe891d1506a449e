"""Memories of the core's structs, compared word by word: numpy's own equality and struct's patterns are the oracle."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.core.structs import Control, Estimator, Input, Parameters
from firmware_py.export.compare import differing_bits

STRUCTS = (Parameters, Input, Estimator, Control)
WORD = st.integers(0, 2**32 - 1)


def words(kind: type, word: int) -> bytes:
    return struct.pack("<I", word) * (kind.dtype.itemsize // 4)


@given(kind=st.sampled_from(STRUCTS), data=st.data(), word=WORD, flip=st.integers(1, 2**32 - 1))
def test_one_changed_word_is_found_and_named(kind: type, data: st.DataObject, word: int, flip: int) -> None:
    memory = bytearray(words(kind, word))
    index = data.draw(st.integers(0, len(memory) // 4 - 1))
    struct.pack_into("<I", memory, 4 * index, word ^ flip)
    found = differing_bits(words(kind, word), bytes(memory), kind.dtype)
    first, second = (np.frombuffer(m, kind.dtype)[0] for m in (words(kind, word), bytes(memory)))
    # the field that lies there, from numpy's offsets
    name = max(
        (n for n in kind.dtype.names if kind.dtype.fields[n][1] <= 4 * index),
        key=lambda n: kind.dtype.fields[n][1],
    )
    offset = (4 * index - kind.dtype.fields[name][1]) // 4
    values = tuple(np.ravel(record[name])[offset] for record in (first, second))
    if values[0].dtype == np.float32 and all(np.isnan(value) for value in values):
        assert found == ()
        return
    [one] = found
    element = np.unravel_index(offset, kind.dtype[name].shape) if kind.dtype[name].shape else ()
    assert one.field == name + (f"[{','.join(str(int(i)) for i in element)}]" if element else "")
    assert one.patterns == (word, word ^ flip)
    assert one.bits == flip.bit_count()
    for shown, value in zip(one.values, values, strict=True):
        assert np.array_equal(values[0].dtype.type(shown), value, equal_nan=value.dtype == np.float32)


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        (0x7FC00000, 0xFFC00000, True),  # quiet NaN of ARM, of x86
        (0x7F800001, 0x7FC12345, True),  # signalling, quiet with payload
        (0x7F800000, 0x7FC00000, False),  # infinity, NaN
        (0x00000000, 0x80000000, False),  # zeros of both signs
        (0x00000001, 0x00000000, False),  # the least denormal, zero
    ],
)
def test_only_nan_payloads_are_forgiven_and_only_in_floats(first: int, second: int, same: bool) -> None:
    found = differing_bits(words(Control, first), words(Control, second), Control.dtype)
    differing = []
    for name, (kind, _) in (Control.dtype.fields or {}).items():
        if kind.base == np.int32 or not same:
            differing += [f"{name}[{i}]" for i in range(kind.shape[0])] if kind.shape else [name]
    assert sorted(one.field for one in found) == sorted(differing)


def test_memory_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=f"expected twice {Control.dtype.itemsize}"):
        differing_bits(bytes(Control.dtype.itemsize), bytes(80), Control.dtype)


def test_a_difference_reads_as_field_values_patterns_and_bits() -> None:
    one = np.zeros(1, Estimator.dtype)
    other = one.copy()
    other["P"][0, 3, 4] = -0.5
    [difference] = differing_bits(one.tobytes(), other.tobytes(), Estimator.dtype)
    assert str(difference) == "P[3,4]: 0.0 00000000 | -0.5 bf000000 (7 bits)"
