"""The typed subset of Python in which the flight core is written, and how it runs.

Subset: module constants `f32(..)`, `i32(..)`, plain ints and arrays `constant(..)`; state structs (`class Name(Struct)`
with `f32`, `i32` or `Annotated[F32s, ...]` annotations); functions marked `@kernel` with annotated scalars and structs;
`for` over `range`, `if`/`elif`/`else`; `+ - * /` on float32, `+ - * // %` on small non-negative int32; comparisons,
`and`/`or`/`not`; calls of other kernels; `abs`, `sqrt`, `elapsed`. Floats never meet ints without `f32(..)`, and every
constant is explicitly float32, as in C. `f64`, `i64` and their arrays, `call` and tasks (`firmware_py/rtos/awaited.py`) are
for the laboratory alone, the world and the scheduler: the core's translator refuses them.

A struct is one block of memory with the layout of the C struct (naturally aligned), so that plain Python, C and the
microcontroller can be compared byte by byte. Kernels are plain Python that a debugger can step through; their C flies.
"""

import ctypes
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Generic, Self, TypeAlias, TypeVar, cast, get_args

import numpy as np
from numpy.typing import NDArray

f32 = np.float32
i32 = np.int32
f64 = float
i64 = int
sqrt = np.sqrt  # correctly rounded on every target: sqrtss on x86, VSQRT.F32 on the Cortex-M4

Integer: TypeAlias = int | np.int32

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def kernel(function: Kernel) -> Kernel:
    """Mark a function that becomes C."""
    return function


@kernel
def elapsed(later: Integer, earlier: Integer) -> i32:
    """Return the time between two instants of a clock of 32 bits that wraps."""
    return i32(((int(later) - int(earlier) + 2147483648) & 4294967295) - 2147483648)


def call(function: int) -> int:
    """Call the object of Python that a field holds, see `Block.connect`; return its integer, 0 for None."""
    answer = ctypes.cast(function, ctypes.py_object).value()
    return 0 if answer is None else int(answer)


def step(task: Generator[int, None, object]) -> int:
    """Take a step of a task that is C; in Python the scheduler steps its generator."""
    raise NotImplementedError(task)


# What a call of the scheduler answers a task: SWITCH and WAITS give up the processor, after WAITS the call is made AGAIN.
# Values below FAILED are errors.
FAILED: Final = 0
DONE: Final = 1
SWITCH: Final = 2
WAITS: Final = 3
AGAIN: Final = -(1 << 62)  # as a timeout: the wait goes on

F32s: TypeAlias = NDArray[np.float32]
I32s: TypeAlias = NDArray[np.int32]
F64s: TypeAlias = NDArray[np.float64]
I64s: TypeAlias = NDArray[np.int64]


def constant(*rows: float | Sequence[float]) -> F32s:
    """Return an array of float32 that never changes: numbers for a vector, one tuple per row for a matrix."""
    array = np.array(rows, f32)
    array.flags.writeable = False
    return array


S_co = TypeVar("S_co", bound="Struct", covariant=True)


@dataclass(frozen=True, slots=True)
class Tunable:
    """Marks a field as a parameter of own logic: `Annotated[f32, Tunable(0.5, "rad/m", low=-5.0, high=5.0)]`.

    The bounds are inclusive; the unit of a pure number is "".
    """

    default: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """How clients see a field: its names, its first element and its type on the wire."""

    stock: str = ""  # names that the Crazyflie firmware has, too: an app in that firmware omits them
    type: str = ""  # a name in `Scalar`; empty: F32 or I32, as in memory
    first: int = 0  # the array element of the first name, counted in memory
    step: int = 1  # from one name to the next


@dataclass(frozen=True, slots=True)
class Logged(Served):
    """Marks a field as log variables `names` ("group.one two three"); own logic states only the unit."""

    unit: str
    names: str = ""


@dataclass(frozen=True, slots=True)
class Sensed:
    """Marks a field as what a sensor of the user's own robot measures, in a unit: `Annotated[f32, Sensed("m")]`.

    NaN without a sample. It is a log variable as well.
    """

    unit: str


@dataclass(frozen=True, slots=True)
class Settable(Served):
    """Marks a field of the core as a parameter, within inclusive bounds: a profile sets it, clients may change it.

    `section` is the profile's, empty for fields that are zero at boot. Memory holds `scale` times the client's value.
    """

    section: str
    names: str  # "group.one two three"; empty: "section.key"
    unit: str
    low: float
    high: float
    meaning: str = ""
    key: str = ""  # in the section, for elements "one two three"; empty: the field's name
    scale: int = 1
    shown: str = ""  # the unit for clients, where it is not the profile's
    persistent: bool = True


class Block(Generic[S_co]):
    """The memory of one instance of the struct class `kind`.

    `memory` is a structured array of shape (1,); `fields` gives attribute access to it, as if it were the struct: array
    fields are views.
    """

    def __init__(self, kind: type[S_co], memory: NDArray[Any] | None = None) -> None:
        self.kind = kind
        self.memory: NDArray[Any] = np.zeros(1, kind.dtype) if memory is None else memory
        self.fields = cast(S_co, kind._view(self.memory))
        self._connected: dict[str, Callable[[], int | None]] = {}  # keeps them alive

    def connect(self, **functions: Callable[[], int | None]) -> None:
        """Let fields of type i64 hold the functions that kernels `call`."""
        self._connected |= functions
        for name, function in functions.items():
            setattr(self.fields, name, id(function))

    def cell(self, name: str) -> memoryview:
        """Return the memory of a number: `cell[0]` reads it in a fifth of the time of `fields`."""
        return self.memory[name].data

    def copy(self) -> Self:
        """Return an independent copy."""
        other = type(self)(self.kind)
        other.memory[:] = self.memory
        return other

    def piece(self, first: str, count: int) -> F64s:
        """Return `count` numbers from a field of f64 on, over the following ones of that type."""
        assert self.kind.dtype.fields is not None
        return np.ndarray(count, f64, self.memory, self.kind.dtype.fields[first][1])

    def bytes(self) -> bytes:
        """Return the struct's bytes in memory."""
        return self.memory.tobytes()


def _scalar_property(name: str) -> property:
    slot = "_" + name

    def get(view: Any) -> Any:
        return getattr(view, slot)[0]

    def put(view: Any, value: Any) -> None:
        getattr(view, slot)[0] = value

    return property(get, put)


class Struct:
    """Base of the state structs; annotations are the fields in the order of the C struct.

    Array fields are written `Annotated[F32s, 16, 16]` or `Annotated[I32s, 3]`; own logic adds `Tunable` and `Logged`.
    """

    dtype: ClassVar[np.dtype[Any]]
    _view: ClassVar[type[Any]]

    def __init_subclass__(cls) -> None:
        columns: list[Any] = []
        for name, kind in cls.__annotations__.items():
            shape = tuple(size for size in getattr(kind, "__metadata__", ()) if isinstance(size, int))
            element = getattr(kind, "__origin__", kind)
            if shape:
                element = get_args(element)[-1]  # the dtype; from numpy 2.5 on its scalar
                (element,) = get_args(element) or (element,)
            columns.append((name, element, shape) if shape else (name, element))
        cls.dtype = np.dtype(columns, align=True)
        scalars = tuple(column[0] for column in columns if len(column) == 2)
        arrays = tuple(column[0] for column in columns if len(column) == 3)

        def seen(memory: NDArray[Any]) -> Any:
            """Return a view; integers of 64 bits become Python's own, in half the time."""
            return memory.data if memory.dtype == np.int64 else memory

        def bind(view: Any, memory: NDArray[Any]) -> None:
            for name in scalars:
                setattr(view, "_" + name, seen(memory[name]))
            for name in arrays:
                setattr(view, name, seen(memory[name][0]))

        body: dict[str, Any] = {name: _scalar_property(name) for name in scalars}
        body["__slots__"] = (*("_" + name for name in scalars), *arrays)
        body["__init__"] = bind
        cls._view = type(cls.__name__ + "View", (), body)

    @classmethod
    def allocate(cls) -> Block[Self]:
        """Return a zeroed instance."""
        return Block(cls)
