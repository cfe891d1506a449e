"""The structs' memory: what the world's and the core's kernels are given."""

from typing import Annotated

from firmware_py.core.subset import F32s, F64s, I32s, Struct, f32, f64, i32


class Mixed(Struct):
    small: f32
    place: Annotated[F64s, 3]
    turn: Annotated[F64s, 2, 2]
    count: i32
    speeds: Annotated[F32s, 2]
    counts: Annotated[I32s, 2]
    time: f64


def test_fields_have_the_types_and_places_of_a_c_struct() -> None:
    places = {name: (kind.base.str, place) for name, (kind, place) in (Mixed.dtype.fields or {}).items()}
    assert places == {
        "small": ("<f4", 0), "place": ("<f8", 8), "turn": ("<f8", 32), "count": ("<i4", 64), "speeds": ("<f4", 68),
        "counts": ("<i4", 76), "time": ("<f8", 88),
    }  # fmt: skip


def test_a_piece_of_a_block_is_the_memory_of_its_fields() -> None:
    block = Mixed.allocate()
    piece = block.piece("place", 7)
    piece[:] = range(7)
    assert block.fields.place.tolist() == [0.0, 1.0, 2.0]
    assert block.fields.turn.tolist() == [[3.0, 4.0], [5.0, 6.0]]
    block.fields.place[1] = 9.0
    assert piece[1] == 9.0


def test_a_copy_of_a_block_has_memory_of_its_own() -> None:
    block = Mixed.allocate()
    block.fields.place[:], block.fields.count = (1.0, 2.0, 3.0), i32(4)
    copy = block.copy()
    assert copy.bytes() == block.bytes()
    copy.fields.place[0], copy.fields.count = 9.0, i32(5)
    assert (block.fields.place[0], block.fields.count) == (1.0, 4)
    assert copy.cell("count")[0] == copy.memory["count"][0] == 5
