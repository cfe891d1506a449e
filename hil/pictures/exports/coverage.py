"""The coverage of an image: a tracefile of lcov and a page, from the executed blocks of `hil/laboratory/files/coverage.py`.

In the tracefile branch 0 of a block is the jump and branch 1 the next instruction; the test's name is the image's digest.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from firmware_py.errors import FirmwareError
from hil.board.image_firmware import read_image
from hil.emulator.stm32f405.coverage import FileCoverage, FunctionCoverage, ImageLines
from hil.emulator.stm32f405.image import Image
from hil.errors import refusing, writing
from hil.laboratory.files.coverage import (
    INFO,
    OPTION,
    PAGE,
    check_coverage,
    check_image,
    file_of,
    read_executed,
)
from hil.laboratory.files.whole_files import write_whole
from hil.pictures.pages import write_page

AROUND = 2  # lines shown before and after one that never ran


@dataclass(frozen=True, slots=True)
class Share:
    """How many of some things ran."""

    run: int
    total: int

    @property
    def percent(self) -> float:
        return 100.0 * self.run / self.total if self.total else 100.0

    def __str__(self) -> str:
        return f"{self.percent:.1f} %" if self.total else "-"

    @property
    def text(self) -> str:
        return f"{self.run} of {self.total}"


@dataclass(frozen=True, slots=True)
class Shares:
    """How many lines, functions and ways out of conditional jumps ran."""

    lines: Share
    functions: Share
    branches: Share

    @classmethod
    def of(cls, files: Iterable[FileCoverage]) -> "Shares":
        """Return those of files together."""
        files = list(files)
        functions = [one.count for file in files for one in file.functions]
        ways = [way for file in files for one in file.branches for way in (one.jumped, one.fell)]
        lines = sum(file.lines_run for file in files), sum(len(file.lines) for file in files)
        return cls(
            Share(*lines), *(Share(sum(count > 0 for count in one), len(one)) for one in (functions, ways))
        )

    def __str__(self) -> str:
        return (
            f"{self.lines} of {self.lines.total} lines, {self.functions} of {self.functions.total} functions, "
            f"{self.branches} of {self.branches.total} branches"
        )


@dataclass(frozen=True, slots=True)
class Covered:
    """A file on the page. `pieces` are its lines that never ran with those around them; empty: its source is not here."""

    path: str
    shares: Shares
    functions: list[tuple[FunctionCoverage, Share]]
    pieces: list[list[tuple[int, str, int | None]]]  # number, text, count; None: a line without code
    never: str  # the lines that never ran, as numbers
    file: FileCoverage


def check_image_coverage(out: Path, board: str, elf: Path | None) -> None:
    """Raise `LabError` when the coverage of an image cannot be added to OUT."""
    check_coverage(out, _image(board, elf).sha256)


def _image(board: str, elf: Path | None) -> Image:
    with refusing(f"--board {board}: ", FirmwareError):
        return read_image(Path(board), elf)[0]


def write_coverage(out: Path) -> tuple[Shares, Path, Path]:
    """Write tracefile and page of what was added to OUT; return the totals and both paths. Raises `LabError`."""
    executed = read_executed(out)
    image = _image(executed.board, executed.elf)
    check_image(out, image.sha256, executed)
    roots = [Path.cwd(), *(executed.elf or image.path).parents[:3]]
    files = ImageLines(image).coverage(executed.counts)
    total = Shares.of(files)
    sources = {file.path: source_of(file, roots) for file in files}
    info, page = file_of(out, INFO), file_of(out, PAGE)
    with writing(OPTION, out):
        write_whole(info, "".join(f"{line}\n" for line in tracefile(files, executed.image, sources)))
        shared = _shared_folder([file.path for file in files if sources[file.path]])
        there = sorted(files, key=lambda file: sources[file.path] is None)  # libraries last
        covered = [_covered(file, sources[file.path], shared) for file in there]
        folders: dict[str, list[Covered]] = {}
        for one in covered:
            folders.setdefault(str(Path(one.path).parent), []).append(one)
        write_page(
            page, "coverage.html.j2", image=image.path.name, digest=executed.image, flights=executed.flights,
            total=total, shared=shared,
            folders=[(name, Shares.of(one.file for one in inside), inside) for name, inside in folders.items()],
        )  # fmt: skip
    return total, info, page


def tracefile(
    files: Sequence[FileCoverage], image: str, sources: dict[str, tuple[Path, list[str]] | None]
) -> Iterator[str]:
    """Yield the lines of a tracefile, as lcov's manual describes it (geninfo, FILES)."""
    for file in files:
        source, shares = sources.get(file.path), Shares.of([file])
        yield f"TN:image_{image[:16]}"
        yield f"SF:{source[0] if source else file.path}"
        yield from (f"FN:{one.line},{one.name}" for one in file.functions)
        yield from (f"FNDA:{one.count},{one.name}" for one in file.functions)
        yield from (f"FNF:{shares.functions.total}", f"FNH:{shares.functions.run}")
        for one in file.branches:
            ran = one.jumped + one.fell
            for way, count in enumerate((one.jumped, one.fell)):
                yield f"BRDA:{one.line},{one.number},{way},{count if ran else '-'}"
        yield from (f"BRF:{shares.branches.total}", f"BRH:{shares.branches.run}")
        yield from (f"DA:{line},{file.lines[line]}" for line in sorted(file.lines))
        yield from (f"LF:{shares.lines.total}", f"LH:{shares.lines.run}", "end_of_record")


def source_of(file: FileCoverage, roots: Sequence[Path]) -> tuple[Path, list[str]] | None:
    """Return the place and the lines of a source file; None where it is not here, or has too few lines.

    Where the compiler had it elsewhere, the end of its path is looked for below `roots`, at least a folder and a name.
    """
    given = Path(file.path)
    ends = [Path(*given.parts[begin:]) for begin in range(1, len(given.parts) - 1)]
    for place in (given, *(root / end for end in ends for root in roots)):
        try:
            lines = place.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            continue
        return (place, lines) if len(lines) >= max(file.lines) else None
    return None


def _shared_folder(paths: Sequence[str]) -> str:
    """Return the folder that all absolute paths share, with a slash at its end; empty without one."""
    folders = [Path(path).parent.parts for path in paths if path.startswith("/")]
    shared: list[str] = []
    for parts in zip(*folders, strict=False):
        if len(set(parts)) > 1:
            break
        shared.append(parts[0])
    return f"{Path(*shared)}/" if len(shared) > 1 else ""


def _covered(file: FileCoverage, source: tuple[Path, list[str]] | None, shared: str) -> Covered:
    never = sorted(line for line, count in file.lines.items() if not count)
    functions = []
    for one in file.functions:
        counts = [count for line, count in file.lines.items() if one.line <= line <= one.last]
        functions.append((one, Share(sum(count > 0 for count in counts), len(counts))))
    pieces: list[list[tuple[int, str, int | None]]] = []
    texts = source[1] if source else []
    near = sorted({line + step for line in never for step in range(-AROUND, AROUND + 1)})
    for line in near if source else ():
        if 1 <= line <= len(texts):
            shown = (line, texts[line - 1], file.lines.get(line))
            if pieces and pieces[-1][-1][0] == line - 1:
                pieces[-1].append(shown)
            else:
                pieces.append([shown])
    path = file.path.removeprefix(shared)
    return Covered(path, Shares.of([file]), functions, pieces, _ranges(never), file)


def _ranges(lines: Sequence[int]) -> str:
    """Return sorted numbers as text: 3, 7-9."""
    found: list[list[int]] = []
    for line in lines:
        if found and found[-1][-1] == line - 1:
            found[-1].append(line)
        else:
            found.append([line])
    return ", ".join(str(one[0]) if len(one) == 1 else f"{one[0]}-{one[-1]}" for one in found)
