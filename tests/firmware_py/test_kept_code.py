"""Compiled code is loaded only from folders and files that this user alone can have written."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_py import compiling, core_runner, kept_code
from firmware_py.compiling import bound, compiler
from firmware_py.config import parameters_of
from firmware_py.core.subset import F64s
from firmware_py.core_runner import CoreBlocks, PlainRunner, default_runner
from firmware_py.export import kernels
from firmware_py.export.compilers import Compiler, by_first_that_works, compile_texts, compilers
from firmware_py.export.errors import CompilerError, ExportError
from firmware_py.export.kernels import library
from firmware_py.export.live_reading import Arrays
from firmware_py.kept_code import UNUSED_S, keep, kept_folder, may_load
from hil.config import load_config
from hil.world.plates import limit

ABSENT_UID = 12345


@pytest.fixture(autouse=True)
def cache_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The user's cache folder, and the folder for temporary files, of this test alone."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.delenv("FLOATY_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def link_away(path: Path) -> None:
    moved = path.with_name("moved")
    path.rename(moved)
    path.symlink_to(moved)


def give_away(path: Path) -> None:
    if os.geteuid():
        pytest.skip("only root gives a file away")
    os.chown(path, ABSENT_UID, ABSENT_UID)


DOUBTS = [
    pytest.param(lambda path: path.chmod(0o770), "others may write it", id="group"),
    pytest.param(lambda path: path.chmod(0o702), "others may write it", id="all"),
    pytest.param(link_away, "a link", id="link"),
    pytest.param(give_away, "belongs to another user", id="owner"),
]


def test_kept_folders_are_private_whatever_the_umask(cache_home: Path) -> None:
    before = os.umask(0)
    try:
        folder = kept_folder("c", "key")
        keep(folder / "file", b"text")
    finally:
        os.umask(before)
    assert folder.parent.parent == cache_home / "floaty"
    assert {path.stat().st_mode & 0o777 for path in (folder, folder.parent, folder.parent.parent)} == {0o700}
    assert (folder / "file").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(("change", "why"), DOUBTS)
def test_a_folder_that_others_may_have_written_is_not_used(
    change: Callable[[Path], None], why: str, cache_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    doubtful = cache_home / "floaty"
    doubtful.mkdir(parents=True, mode=0o700)
    change(doubtful)
    folder = kept_folder("c", "key")
    assert folder.is_relative_to(Path(tempfile.gettempdir(), f"floaty-{os.geteuid()}"))
    assert folder.stat().st_mode & 0o777 == 0o700
    assert kept_folder("c", "another").parent == folder.parent
    assert capsys.readouterr().err == f"floaty: {doubtful}: {why}: compiled code is kept elsewhere\n"


def test_where_neither_folder_can_be_used_one_serves_that_ends_with_the_process(
    cache_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cache_home.touch()  # no folder can be made there, not even by root
    Path(tempfile.gettempdir(), f"floaty-{os.geteuid()}").mkdir(mode=0o700)
    Path(tempfile.gettempdir()).chmod(0o777)
    assert kept_folder("zig").stat().st_mode & 0o777 == 0o700
    first, second = capsys.readouterr().err.splitlines()
    assert first.endswith("/floaty: cannot be used (File exists): compiled code is kept elsewhere")
    assert second.endswith(": in a folder that all may write: compiled code is kept elsewhere")


def test_where_all_may_write_but_nobody_may_take_away_a_folder_is_used(cache_home: Path) -> None:
    cache_home.mkdir(mode=0o700)
    cache_home.chmod(0o1777)  # as of temporary files
    assert kept_folder("c").is_relative_to(cache_home)


def test_a_folder_that_cannot_be_written_is_not_used(
    cache_home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = os.access  # root may write everywhere
    monkeypatch.setattr(
        os, "access", lambda path, mode: not str(path).startswith(str(cache_home)) and real(path, mode)
    )
    assert not kept_folder("c", "key").is_relative_to(cache_home)
    assert capsys.readouterr().err == (
        f"floaty: {cache_home / 'floaty'}: cannot be written: compiled code is kept elsewhere\n"
    )


def test_a_relative_folder_is_never_used(monkeypatch: pytest.MonkeyPatch, empty_folder: Path) -> None:
    monkeypatch.setenv("FLOATY_CACHE_DIR", ".")
    assert not kept_folder("c", "key").is_relative_to(empty_folder / "floaty")
    assert not (empty_folder / "floaty").exists()


@pytest.mark.parametrize(("change", "why"), DOUBTS)
def test_a_file_that_others_may_have_written_is_not_loaded(
    change: Callable[[Path], None], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = kept_folder("c", "key") / "core.so"
    assert not may_load(path)
    keep(path, b"text")
    assert may_load(path)
    change(path)
    assert not may_load(path)
    assert capsys.readouterr().err == f"floaty: {path}: {why}: it is not loaded\n"


def twice(x: F64s) -> None:
    """Double the first number."""
    x[0] = 2.0 * x[0]


@pytest.mark.long
@pytest.mark.skipif(not list(compilers()), reason="no C compiler")
def test_a_library_is_compiled_once_and_again_when_others_may_have_written_it(
    cache_home: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []

    def count_and_make(functions: tuple[Callable[..., object], ...], arrays: Arrays) -> Path:
        made.append(library(functions, arrays))
        return made[-1]

    def call(*numbers: float) -> float:
        monkeypatch.setattr(compiling, "_LIBRARIES", {})  # as in another process
        x = np.array(numbers)
        bound(compiler()(twice), x)()
        return float(x[0])

    monkeypatch.setattr(kernels, "library", count_and_make)
    assert (call(4.0), call(4.0), len(made)) == (8.0, 8.0, 1)
    (kept,) = cache_home.rglob("*twice*.so")
    assert kept.stat().st_mode & 0o777 == 0o600
    kept.chmod(0o666)
    assert (call(4.0), len(made)) == (8.0, 2)
    assert capsys.readouterr().err == f"floaty: {kept}: others may write it: it is not loaded\n"
    assert (call(4.0, 1.0), len(made)) == (8.0, 3)
    assert (call(4.0), len(made), len(list(cache_home.rglob("*twice*.so")))) == (
        8.0,
        3,
        2,
    )  # one for each shape


@pytest.mark.parametrize("error", [CompilerError("no C compiler"), PermissionError(13, "Permission denied")])
def test_without_compiled_code_python_computes_the_same_and_one_line_says_why(
    error: Exception, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> Path:
        raise error

    monkeypatch.setattr(kernels, "library", fail)
    compiling.fall_back.cache_clear()
    for _ in range(2):
        x = np.array([4.0])
        bound(compiler()(twice), x)()
        assert x[0] == 8.0
    monkeypatch.setattr(core_runner, "core_library", fail)
    monkeypatch.setattr(core_runner, "PLAIN", False)
    blocks = CoreBlocks(parameters_of(load_config()), PlainRunner)
    assert isinstance(default_runner(blocks), PlainRunner)
    assert capsys.readouterr().err == f"floaty: flies as plain Python, far slower: {error}\n"


def outside(x: F64s) -> None:
    """Do what the subset has not."""
    x[0] = max(x.tolist())


def test_a_kernel_outside_the_subset_does_not_fly_as_python() -> None:
    with pytest.raises(ExportError, match=r"test_kept_code\.py:.*call"):
        bound(compiler()(outside), np.array([4.0]))


def test_folders_that_nobody_has_used_for_long_are_deleted() -> None:
    old, used = kept_folder("c", "old"), kept_folder("c", "used")
    for folder in (old, used):
        long_ago = folder.stat().st_mtime - UNUSED_S - 1.0
        os.utime(folder, (long_ago, long_ago))
    kept_code._made.cache_clear()  # as in another process
    assert kept_folder("c", "used") == used
    kept_folder("c", "new")
    assert (old.exists(), used.exists()) == (False, True)


def test_each_kind_of_memory_has_a_library_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "kept_library", lambda path, make: path)
    monkeypatch.setattr(compiling, "_LIBRARIES", {})
    memories = [
        np.zeros(shape, kind) for shape in (2, 3, (2, 3), (3, 2)) for kind in (np.float64, np.float32)
    ]
    found = [[compiling._library((limit,), (one,)) for one in memories] for _ in range(2)]
    assert found[0] == found[1]
    assert len(set(found[0])) == len(memories)
    assert compiling._library((limit,), (memories[0],) * 2) not in found[0]


def test_the_first_compiler_that_works_is_taken_ziglang_last_or_the_first_complaint_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = [Compiler(name, (name,), "1") for name in ("zig", "gcc", "clang")]
    monkeypatch.setattr("firmware_py.export.compilers.compilers", lambda: iter(found))
    for works in ("gcc", "clang", "zig", ""):
        asked: list[str] = []

        def make(compiler: Compiler, works: str = works, asked: list[str] = asked) -> Path:
            asked.append(compiler.name)
            if compiler.name != works:
                raise CompilerError(compiler.name)
            return Path(works)

        if works:
            assert by_first_that_works(make) == Path(works)
        else:
            with pytest.raises(CompilerError, match=r"^gcc$"):
                by_first_that_works(make)
        order = ["gcc", "clang", "zig"]
        assert asked == order[: order.index(works) + 1 if works else 3]


def test_what_was_compiled_is_found_by_all_that_it_was_made_of(monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[tuple[str, ...]] = []

    def run(command: tuple[str, ...], cwd: Path, env: object) -> SimpleNamespace:
        (cwd / command[command.index("-o") + 1]).write_bytes(b"code")
        runs.append(command)
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr("firmware_py.export.compilers._run", run)
    usual = {"a.c": "int a;"}, ("a.c",), ("-O1",), "a.so", Compiler("cc", ("cc",), "1")
    made = [
        usual, ({"a.c": "int b;"}, *usual[1:]), ({"b.c": "int a;"}, *usual[1:]), (usual[0], ("a.c", "a.c"), *usual[2:]),
        (*usual[:2], ("-O2",), *usual[3:]), (*usual[:4], Compiler("cc", ("gcc",), "1")),
        (*usual[:4], Compiler("cc", ("cc",), "2")),
    ]  # fmt: skip
    assert len({compile_texts(*inputs) for inputs in made}) == len(runs) == len(made)
    for inputs in made:
        compile_texts(*inputs)
    assert len(runs) == len(made)


@pytest.mark.long
def test_sources_are_replaced_where_another_process_may_compile_them() -> None:
    """A file that is written over while a compiler has it mapped ends that by SIGBUS."""
    text = "int one(void) { return 1; }\n"
    *_, last = compilers()  # zig would fill its empty cache
    result = compile_texts({"one.c": text}, ("one.c",), ("-shared", "-fPIC"), "one.so", last)
    assert result.stat().st_mode & 0o777 == 0o700
    with result.with_name("one.c").open() as mapped:
        result.unlink()
        assert compile_texts({"one.c": text}, ("one.c",), ("-shared", "-fPIC"), "one.so", last) == result
        assert os.fstat(mapped.fileno()).st_nlink == 0
        assert mapped.read() == result.with_name("one.c").read_text() == text
