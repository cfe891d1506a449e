"""The tracefile and the page of a coverage, of files whose lines, functions and branches are written by hand."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.emulator.stm32f405.coverage import BranchCoverage, FileCoverage, FunctionCoverage
from hil.pictures.exports.coverage import (
    Share,
    Shares,
    _covered,
    _ranges,
    _shared_folder,
    source_of,
    tracefile,
)

LINES = {1: 0, 3: 2, 8: 0, 9: 0, 12: 0}
FILE = FileCoverage(
    "/build/app/src/a.c",
    LINES,
    [FunctionCoverage("go", 1, 3, 5), FunctionCoverage("idle", 8, 12, 0)],
    [BranchCoverage(3, 0, 0, 4), BranchCoverage(3, 1, 7, 2), BranchCoverage(9, 0, 0, 0)],
)
TEXT = [f"line {number}" for number in range(1, 13)]


def test_a_tracefile_has_every_function_line_and_way_with_its_count() -> None:
    given = {FILE.path: (Path("/here/a.c"), TEXT)}
    assert list(tracefile([FILE], "0123456789abcdef0", given)) == [
        "TN:image_0123456789abcdef", "SF:/here/a.c", "FN:1,go", "FN:8,idle", "FNDA:5,go", "FNDA:0,idle", "FNF:2",
        "FNH:1", "BRDA:3,0,0,0", "BRDA:3,0,1,4", "BRDA:3,1,0,7", "BRDA:3,1,1,2", "BRDA:9,0,0,-", "BRDA:9,0,1,-",
        "BRF:6", "BRH:3", "DA:1,0", "DA:3,2", "DA:8,0", "DA:9,0", "DA:12,0", "LF:5", "LH:1", "end_of_record",
    ]  # fmt: skip
    assert "SF:/build/app/src/a.c" in tracefile([FILE], "0", {FILE.path: None})


def test_the_page_has_the_lines_around_those_that_never_ran() -> None:
    one = _covered(FILE, (Path("/here/a.c"), TEXT), "/build/app/")
    assert one.path == "src/a.c"
    assert [[number for number, _, _ in piece] for piece in one.pieces] == [
        [1, 2, 3],
        [6, 7, 8, 9, 10, 11, 12],
    ]
    assert all(text == f"line {number}" for piece in one.pieces for number, text, _ in piece)
    assert [count for _, _, count in one.pieces[0]] == [0, None, 2]
    assert one.never == "1, 8-9, 12"
    assert _ranges([3, 5, 7, 8, 9, 12]) == "3, 5, 7-9, 12"
    assert [share for _, share in one.functions] == [Share(1, 2), Share(0, 3)]
    assert one.shares == Shares(Share(1, 5), Share(1, 2), Share(3, 6))
    assert _covered(FILE, None, "").pieces == []
    assert (str(Share(0, 0)), Share(0, 0).percent, str(Share(1, 3))) == ("-", 100.0, "33.3 %")
    assert Shares.of([FILE, FILE]).functions == Share(2, 4)


@pytest.mark.long
@given(lines=st.dictionaries(st.integers(1, 40), st.integers(0, 1)))
def test_pieces_are_the_runs_of_lines_beside_one_that_never_ran(lines: dict[int, int]) -> None:
    covered = _covered(replace(FILE, lines=lines), (Path("a.c"), 30 * ["text"]), "")
    pieces = [[number for number, _, _ in piece] for piece in covered.pieces]
    never = [line for line, count in lines.items() if not count]
    near = [number for number in range(1, 31) if any(abs(number - line) <= 2 for line in never)]
    assert [number for piece in pieces for number in piece] == near
    assert all(piece == [*range(piece[0], piece[-1] + 1)] for piece in pieces)
    assert all(later[0] - piece[-1] > 1 for piece, later in pairwise(pieces))


@pytest.mark.parametrize(("paths", "shared"), [
    (["/a/b/c.c", "/a/b/d/e.c", "x.c"], "/a/b/"), (["/a/b/c.c", "/a/bb/c.c"], "/a/"), (["/a/x.c", "/b/y.c"], ""), ([], ""),
])  # fmt: skip
def test_the_shared_folder_is_that_of_all_whole_paths(paths: list[str], shared: str) -> None:
    assert _shared_folder(paths) == shared


def test_a_source_is_found_by_the_end_of_its_path_with_a_folder_and_has_lines_enough(tmp_path: Path) -> None:
    (tmp_path / "a.c").write_text("\n".join(TEXT))
    assert source_of(FILE, [tmp_path]) is None  # a name alone fits many files
    (tmp_path / "src").mkdir()
    place = tmp_path / "src" / "a.c"
    place.write_text("\n".join(TEXT))
    assert source_of(FILE, [tmp_path / "none", tmp_path]) == (place, TEXT)
    place.write_text("\n".join(TEXT[:-1]))
    assert source_of(FILE, [tmp_path]) is None
