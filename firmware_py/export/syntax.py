"""The exporter's model of the core's source: types, constants, structs, kernels and modules."""

import ast
from collections.abc import Mapping
from dataclasses import dataclass, field
from threading import RLock
from typing import Union

from firmware_py.core.subset import Logged, Sensed, Settable, Tunable
from firmware_py.export.errors import Refusals

PACKAGE = "firmware_py.core"
SUBSET = f"{PACKAGE}.subset"
CORE = "floaty_core_"  # before the C names of the entry points
OWN = "own_logic"  # the package in which the entry module finds the user's modules
ENTRY = "entry"  # the module whose kernels are the C API, but for names that begin with `_`
SHARED = "structs"  # the module whose constants and structs are in the header
C_KEYWORDS = frozenset(
    {
        "auto", "bool", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern",
        "false", "float", "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short",
        "signed", "sizeof", "static", "struct", "switch", "true", "typedef", "union", "unsigned", "void", "volatile",
        "while", "NULL", "offsetof",
    }
)  # fmt: skip
_PARSING = RLock()


def parsed(text: str, path: str = "") -> ast.Module:
    """Return Python source as its tree. Raises `SyntaxError`.

    CPython 3.11 counts the depth of all threads' trees in one place: two that parse at once fail by chance.
    """
    with _PARSING:
        return ast.parse(text, path)


@dataclass(frozen=True, slots=True)
class ValueType:
    """A type: f32, i32, bool, void or a struct's name; an array of `rank` 1 or 2 when that is not 0.

    `shape` is empty for an array argument until a call determines it.
    """

    base: str
    rank: int = 0
    shape: tuple[int, ...] = ()
    struct: Union["StructType", None] = field(default=None, compare=False)


F32, I32, BOOL, VOID = ValueType("f32"), ValueType("i32"), ValueType("bool"), ValueType("void")
BROKEN = ValueType("?")  # of what was refused where it is defined
F64, I64 = ValueType("f64"), ValueType("i64")  # of the laboratory alone: see `live_reading.py`
SCALARS = {"f32": F32, "i32": I32, "Integer": I32, "bool": BOOL}
ARRAYS = {"F32s": "f32", "I32s": "i32"}


@dataclass(slots=True)
class Constant:
    """A module constant, a number or an array; `text` is its C literal with exact values."""

    c_name: str
    kind: ValueType
    text: str
    comment: str
    shared: bool


Mark = Tunable | Logged | Sensed | Settable


@dataclass(frozen=True, slots=True)
class StructField:
    """A field of a struct, with the comments above and beside it, and its marks as a parameter or a log variable."""

    name: str
    kind: ValueType
    above: str
    comment: str
    line: int
    marks: tuple[Mark, ...] = ()

    @property
    def mark(self) -> Mark | None:
        """The first mark; own logic has no further ones."""
        return self.marks[0] if self.marks else None


@dataclass(frozen=True, slots=True)
class StructType:
    """A state struct; `name` is that of the C."""

    name: str
    doc: str
    fields: Mapping[str, StructField]
    shown: str = ""  # its name in the text
    broken: frozenset[str] = frozenset()  # fields that were refused


@dataclass(slots=True)
class Signature:
    """A kernel's signature; `writes` and the shapes of array arguments are found later."""

    c_name: str
    path: str
    node: ast.FunctionDef
    arguments: dict[str, ValueType]
    result: ValueType
    public: bool
    scope: "Module"
    writes: set[str] = field(default_factory=set)  # arguments and array names through which it writes
    calls: set[str] = field(default_factory=set)  # C names
    lost: set[str] = field(default_factory=set)  # names whose definition in the body was refused


Named = Constant | StructType | Signature


@dataclass(slots=True)
class Module:
    """A module of the core, or of the user's: every name that it defines or imports, and its comments by line."""

    name: str
    path: str
    doc: str
    own: bool = False  # the user's
    names: dict[str, "Named | Module"] = field(default_factory=dict)
    builtins: set[str] = field(default_factory=set)  # names imported from the subset
    defined: list[Named] = field(default_factory=list)  # here, in order
    broken: set[str] = field(default_factory=set)  # names whose definition was refused
    refusals: Refusals = field(default_factory=Refusals)
    trailing: dict[int, str] = field(default_factory=dict)
    standing: dict[int, str] = field(default_factory=dict)  # comments on separate lines

    def comment(self, node: ast.stmt) -> str:
        """Return the comments behind a statement."""
        lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
        return " ".join(self.trailing[line] for line in lines if line in self.trailing)

    def above(self, line: int) -> str:
        """Return the block of comment lines right above a line."""
        found: list[str] = []
        while line - 1 in self.standing:
            line -= 1
            found.insert(0, self.standing[line])
        return " ".join(found)
