"""Compilation by a C compiler or numba: strict IEEE arithmetic, kept on disk, never older than its sources.

Without fast maths neither reorders nor fuses, so every processor computes the same bits. A call on memory that does not
move (`bound`) is kept as machine code, which a later process loads without numba: loading numba takes longer than a
short flight. It is that of a C compiler where the function's room translates it (`Library`). Every other call goes through
numba's dispatcher and its own cache. Kept code is valid for the content of all sources; `firmware_py/kept_code.py` has its
folders. Stale code is overwritten.
"""

import ctypes
import hashlib
import inspect
import os
import platform
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property, partial, update_wrapper
from importlib.machinery import SourceFileLoader
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from firmware_py.kept_code import keep, kept_folder, may_load

PLAIN = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
SUFFIX, LIBRARY_SUFFIX = ".machine", ".so"
WHOLE = ("None", "bool", "int", "i32", "int32")  # what a bound function may return
# What kept code may call, by its name in C; numba never frees the memory of others.
FOREIGN = {"NRT_MemInfo_call_dtor": "abort", "numba_ldexp": "ldexp"} | {
    name: name for name in ("sqrt", "sqrtf", "memset", "memcpy", "memmove")
}
METHOD = "kept_method"
METHOD_IN_C = "floaty_method"
NO_ARGUMENTS = 4  # `METH_NOARGS`

Function = TypeVar("Function", bound=Callable[..., Any])
Arrays = tuple[NDArray[Any], ...]
# Returns the library of a function on memory of this kind, whose method `METHOD_IN_C` has the addresses of the arrays in
# its self; None where no C compiler makes it.
Library = Callable[[Callable[..., Any], Arrays], Path | None]
ctypes.pythonapi.PyCFunction_NewEx.restype = ctypes.py_object
ctypes.pythonapi.PyCFunction_NewEx.argtypes = (ctypes.c_void_p, ctypes.py_object, ctypes.py_object)


def compiler(*sources: Path, library: Library | None = None) -> Callable[[Function], Function]:
    """Return the decorator for functions that depend only on `sources`, files or folders, and on their own file.

    `library` compiles them as C; without it, or where it returns None, numba does.
    """
    shared = hash_of(*sources, *_version_of_numba())

    def compiled(function: Function) -> Function:
        if PLAIN:
            return function
        if not inspect.isfunction(function):  # `make fast` has compiled its module, too
            function = getattr(_module_from_source(function.__module__), function.__name__)
        stamp = shared.copy()
        # The kept code contains this name; own logic's has a hash of all its modules.
        stamp.update(function.__module__.encode())
        source = inspect.getfile(function)
        stamp.update(_content(source, os.stat(source).st_mtime_ns))
        return cast(Function, Compiled(function, stamp.hexdigest(), library))

    return compiled


def hash_of(*sources: Path) -> "hashlib._Hash":
    """Return a hash of this Python, numpy, this module and the content of files and folders; it may go on."""
    found = hashlib.sha256(f"{np.__version__} {sys.version}".encode())
    for source in (Path(__file__), *sources):
        for path in sorted(source.glob("*.py")) if source.is_dir() else (source,):
            found.update(path.read_bytes())
    return found


@cache
def _content(source: str, _changed_ns: int) -> bytes:
    return Path(source).read_bytes()


@cache
def _module_from_source(name: str) -> ModuleType:
    """Return a module as its source has it, beside the one that is imported under its name."""
    module = ModuleType(name)
    path = Path(__file__).parent.parent / f"{name.replace('.', '/')}.py"
    SourceFileLoader(name, str(path)).exec_module(module)
    return module


def _version_of_numba() -> list[Path]:
    found = find_spec("numba")
    return [Path(found.origin).with_name("_version.py")] if found is not None and found.origin else []


class Compiled:
    """A function that is compiled when it is first called, also from another one."""

    def __init__(self, function: Callable[..., Any], stamp: str, library: Library | None = None) -> None:
        self.__wrapped__: Callable[..., Any]
        self.__name__: str
        update_wrapper(self, function)
        self.stamp, self.library = stamp, library
        returned = function.__annotations__.get("return")
        self.whole = getattr(returned, "__name__", str(returned)) in WHOLE

    @property
    def folder(self) -> Path:
        """The folder of its kept code, which the contents of its sources name: every copy of them finds it."""
        return kept_folder("numba", self.stamp)

    @cached_property
    def dispatcher(self) -> Any:
        """Numba's dispatcher, whose cache follows all sources; numba itself checks the function's file only."""
        dispatcher = _numba().njit(error_model="numpy", fastmath=False)(self.__wrapped__)
        _enable_cache(dispatcher, self.folder, self.stamp)
        return dispatcher

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_

    def __call__(self, *arguments: Any) -> Any:
        """Call the function through numba."""
        return self.dispatcher(*arguments)

    def file(self, kinds: str, suffix: str = SUFFIX) -> Path:
        """Return the file of kept code for arguments of certain kinds."""
        name = f"{self.__wrapped__.__module__}.{self.__name__}-{kinds}{suffix}"
        return self.folder / name


def bound(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """Return the call of a function on these arguments; where all are arrays or records of one, on their present memory."""
    if not isinstance(function, Compiled):
        return partial(function, *arguments)
    if not function.whole or not all(map(_stays, arguments)):
        return partial(function.dispatcher, *arguments)
    method = _kept_library(function, arguments) or _kept(function, arguments)
    return partial(function.dispatcher, *arguments) if method is None else _on_memory(method, arguments)


def bound_in(library: Path, method: str, *arrays: NDArray[Any]) -> Callable[[], Any]:
    """Return the call of a method in a library on the present memory of arrays and records."""
    return _on_memory(_method_in(library, method)[0], arrays)


def _on_memory(method: "_Method", arguments: Arrays) -> Callable[[], Any]:
    places = struct.pack(f"{len(arguments)}P", *(one.__array_interface__["data"][0] for one in arguments))
    # the unused last argument keeps the memory alive as long as the call
    return cast(
        Callable[[], Any], ctypes.pythonapi.PyCFunction_NewEx(ctypes.byref(method), places, arguments)
    )


def is_kept(function: Callable[..., Any]) -> bool:
    """Return whether a function has been compiled on this machine already."""
    if not isinstance(function, Compiled):
        return True
    names = (function.file("*", suffix).name for suffix in (SUFFIX, LIBRARY_SUFFIX))
    return any(path for name in names for path in function.folder.glob(name))


def _stays(argument: Any) -> bool:
    return isinstance(argument, np.void) or (isinstance(argument, np.ndarray) and argument.flags.c_contiguous)


class _Method(ctypes.Structure):
    """CPython's `PyMethodDef`."""

    _fields_: ClassVar = [
        ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    ]


_LOADED: dict[tuple[str, str, str], tuple[_Method, Any]] = {}  # with what holds its machine code


def _kept_library(function: Compiled, arrays: Arrays) -> _Method | None:
    """Return a function's code in C for arrays of these kinds; None where there is none."""
    if function.library is None:
        return None
    key = _key(function, arrays, f"{sys.platform} {platform.machine()}")
    if key not in _LOADED:
        make = partial(function.library, function.__wrapped__, arrays)
        path = kept_library(function.file(key[2], LIBRARY_SUFFIX), make)
        if path is None:
            return None
        try:
            _LOADED[key] = _method_in(path, METHOD_IN_C)
        except OSError:  # in a file system from which nothing may be executed
            return None
    return _LOADED[key][0]


def kept_library(path: Path, make: Callable[[], Path | None]) -> Path | None:
    """Return a library that is kept at `path`, made if it is missing; None where nothing makes it."""
    if may_load(path):
        return path
    made = make()
    if made is None:
        return None
    with suppress(OSError):
        _replace(path, made.read_bytes())
    return path if path.exists() else made


@cache
def _method_in(library: Path, name: str) -> tuple[_Method, Any]:
    """Return a method in a library, and the owner of its machine code, which Python never frees."""
    code = ctypes.CDLL(str(library))
    address = ctypes.cast(code[name], ctypes.c_void_p).value
    return _Method(name.encode(), address, NO_ARGUMENTS, None), code


def _key(function: Compiled, arrays: Arrays, machine: str) -> tuple[str, str, str]:
    """Return module and name of a function, and a hash of its arrays' kinds and the machine."""
    kinds = [(one.dtype.str, one.shape) for one in arrays]
    digest = hashlib.sha256(f"{kinds} {machine}".encode()).hexdigest()[:16]
    return function.__wrapped__.__module__, function.__name__, digest


def _replace(path: Path, content: bytes) -> None:
    """Keep the code of a function instead of that for other kinds of arguments."""
    keep(path, content)
    for older in path.parent.glob(f"{path.name.rsplit('-', 1)[0]}-*{path.suffix}"):
        if older != path:
            older.unlink(missing_ok=True)


def _kept(function: Compiled, arguments: Arrays) -> _Method | None:
    """Return a function's machine code of numba for arrays of these kinds; None where it needs numba."""
    key = _key(function, arguments, _processor())
    if key not in _LOADED:
        path = function.file(key[2])
        content = path.read_bytes() if may_load(path) else b""
        if not content:
            content = _machine_code(function, arguments)
            if not content:
                return None
            with suppress(OSError):
                _replace(path, content)
        _LOADED[key] = _load(function.__name__, content)
    return _LOADED[key][0]


@cache
def _processor() -> str:
    """Return the processor that numba compiles for: this one, unless the environment names another."""
    from llvmlite import binding

    features = sorted(name for name, there in binding.get_host_cpu_features().items() if there)
    chosen = [os.environ.get(f"NUMBA_CPU_{what}") for what in ("NAME", "FEATURES")]
    return f"{binding.get_host_cpu_name()} {features} {chosen}"


def _machine_code(function: Compiled, arguments: Arrays) -> bytes:
    """Return the object file of a method without arguments, whose self has the addresses of the arrays.

    Empty where the code needs numba.
    """
    from llvmlite import binding

    numba = _numba()
    names = [f"a{index}" for index in range(len(arguments))]
    scope: dict[str, Any] = {"function": function, "carray": numba.carray}
    for name, argument in zip(names, arguments, strict=True):
        scope |= {f"{name}_shape": argument.shape or (1,), f"{name}_kind": argument.dtype}
    places = (
        f"carray({name}, {name}_shape, {name}_kind)" + ("" if argument.shape else "[0]")
        for name, argument in zip(names, arguments, strict=True)
    )
    call = f"function({', '.join(places)})"
    nothing = str(function.__wrapped__.__annotations__.get("return")) == "None"
    body = f"{call}\n    return 0" if nothing else f"return {call}"
    exec(f"def on_arrays({', '.join(names)}):\n    {body}", scope)
    signature = numba.types.int64(*[numba.types.voidptr] * len(arguments))
    dispatcher = numba.njit(
        error_model="numpy", fastmath=False, no_cpython_wrapper=True, no_cfunc_wrapper=True
    )(scope["on_arrays"])
    dispatcher.compile(signature)
    done = dispatcher.overloads[signature.args]
    module = done.library._final_module.clone()
    called = {one.name for one in module.functions if one.is_declaration and not one.name.startswith("llvm.")}
    if called - FOREIGN.keys():
        return b""
    module.link_in(binding.parse_assembly(_method_text(done.fndesc.llvm_func_name, len(arguments))))
    return bytes(done.library.codegen._tm.emit_object(module))


def _method_text(name: str, count: int) -> str:
    """Return a method as LLVM's text; numba's function returns 0 unless it fails, and its result through a pointer."""
    lines = [
        f"declare i32 @{name}(ptr, ptr{', ptr' * count})",
        "declare ptr @PyBytes_AsString(ptr)",
        "declare ptr @PyLong_FromLongLong(i64)",
        f"define ptr @{METHOD}(ptr %self, ptr %nothing) {{",
        "  %places = call ptr @PyBytes_AsString(ptr %self)",
        "  %answer = alloca i64",
        "  %failure = alloca ptr",
    ]
    for index in range(count):
        lines.append(f"  %place{index} = getelementptr ptr, ptr %places, i64 {index}")
        lines.append(f"  %array{index} = load ptr, ptr %place{index}")
    arrays = "".join(f", ptr %array{index}" for index in range(count))
    return "\n".join(
        [
            *lines,
            f"  %status = call i32 @{name}(ptr %answer, ptr %failure{arrays})",
            "  %fine = icmp eq i32 %status, 0",
            "  br i1 %fine, label %done, label %failed",
            "failed:",
            "  ret ptr null",
            "done:",
            "  %value = load i64, ptr %answer",
            "  %result = call ptr @PyLong_FromLongLong(i64 %value)",
            "  ret ptr %result",
            "}",
        ]
    )


def _load(function: str, content: bytes) -> tuple[_Method, Any]:
    """Return the method in an object file, and the owner of its machine code."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    process = ctypes.CDLL(None)
    for name, in_c in FOREIGN.items():
        if binding.address_of_symbol(name) is None:
            binding.add_symbol(name, ctypes.cast(process[in_c], ctypes.c_void_p).value)
    machine = binding.Target.from_default_triple().create_target_machine()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    engine.add_object_file(binding.ObjectFileRef.from_data(content))
    engine.finalize_object()
    return _Method(function.encode(), engine.get_function_address(METHOD), NO_ARGUMENTS, None), engine


def _enable_cache(dispatcher: Any, folder: Path, stamp: str) -> None:
    """Let numba keep what a dispatcher compiles in a folder, and load from there."""
    config = _numba().config
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
    try:
        dispatcher.enable_caching()
    finally:
        config.CACHE_DIR = before
    kept = dispatcher._cache
    kept._cache_file = _kept_file()(kept.cache_path, kept._impl.filename_base, stamp)
    if not Path(kept.cache_path).is_relative_to(
        folder
    ):  # numba prefers a folder beside the source to a full disk
        kept.disable()


@cache
def _kept_file() -> Any:
    """Return numba's class for the files of one function, with the checks of `kept_code`."""
    _numba()
    from numba.core.caching import IndexDataCacheFile

    class KeptFile(IndexDataCacheFile):
        def save(self, key: object, data: object) -> None:
            with suppress(OSError):
                super().save(key, data)  # type: ignore[no-untyped-call]

        def _load_index(self) -> Any:
            return super()._load_index() if may_load(Path(self._index_path)) else {}  # type: ignore[no-untyped-call]

        def _load_data(self, name: str) -> Any:
            if not may_load(Path(self._cache_path, name)):
                raise FileNotFoundError(name)  # numba compiles it again
            return super()._load_data(name)  # type: ignore[no-untyped-call]

        @contextmanager
        def _open_for_write(self, filepath: str) -> Iterator[Any]:
            with super()._open_for_write(filepath) as file:
                os.fchmod(file.fileno(), 0o600)
                yield file

    return KeptFile


@cache
def _numba() -> Any:
    """Return numba, without the BLAS of scipy, which takes longer to load than all the rest: nothing here uses one."""
    if hide_scipy := "scipy" not in sys.modules:
        sys.modules["scipy"] = None  # type: ignore[assignment] # an import fails
    import numba
    import numba.np.arraymath  # which looks for it, when the first function is compiled or loaded

    if hide_scipy:
        del sys.modules["scipy"]
    return numba
