"""Frames around random bodies: a file of a user's small laws, and a module of the laboratory's kernels."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from textwrap import indent
from typing import Any

from support.random_programs import Language

LAW_HEAD = '''"""Small laws."""

from typing import Annotated

from firmware_py.core.maths import ZERO, clamp
from firmware_py.core.structs import Control, Estimator, Input
from firmware_py.core.subset import F32s, I32s, Logged, Struct, Tunable, constant, f32, i32, kernel, sqrt

TABLE = constant(0.5, -1.25, 3.0, 0.1)
DT = f32(0.01)
MANY = 80


class Gains(Struct):
    gain_z: Annotated[f32, Tunable(3.0, "rad/m", low=0.0, high=10.0)]


class Memory(Struct):
    ticks: i32
    mode: i32
    integral: Annotated[f32, Logged("m s")]
    errors: Annotated[F32s, 4]
    counts: Annotated[I32s, 3]
    answers: Annotated[F32s, MANY]


'''
LAW = """@kernel
def law_{name}(estimator: Estimator, own: Gains, memory: Memory) -> f32:
{body}

"""
HOOKS = """@kernel
def reset_law(data: Input, memory: Memory) -> None:
    memory.ticks = i32(0)


@kernel
def control_law(data: Input, estimator: Estimator, control: Control, own: Gains, memory: Memory) -> None:
{calls}"""
OWN = Language(
    reals=("own.gain_z", "memory.errors[0]", "memory.errors[n % 4]", "TABLE[min(max(m, 0), 3)]", "estimator.now[2]", "DT"),
    wholes=("memory.ticks", "memory.counts[1]", "memory.counts[m % 3]"),
    places=(("memory.integral", False), ("memory.errors[m % 4]", False), ("memory.counts[n % 3]", True)),
    real="f32({})", of_whole="f32({})", whole_of="i32({})", root="sqrt", truth="{}", live=False,
)  # fmt: skip
LIVE = Language(
    reals=("numbers[0]", "numbers[n % 5]", "COEFFICIENTS[m % 3]"),
    wholes=("counts[0]", "counts[m % 3]"),
    places=(("numbers[m % 5]", False), ("counts[n % 3]", True)),
    real="{}", of_whole="f64({})", whole_of="i32({})", root="math.sqrt", truth="{}", live=True,
)  # fmt: skip
KERNEL_HEAD = """\
import math
from firmware_py.compiling import compiler
from firmware_py.core.subset import F64s, I32s, f64, i32

COEFFICIENTS = (0.5, -0.25, 3.0)
kernel = compiler()
"""
KERNEL = """

@kernel
def random_{name}(numbers: F64s, counts: I32s) -> None:
    \"\"\"Do.\"\"\"
{body}
    numbers[4] = numbers[4] * 0.125 + (x - y if is_far else n - m - counts[0])
"""


def law_of(bodies: list[str], top: str = "") -> str:
    laws = "".join(LAW.format(name=n, body=indent(body, "    ")) for n, body in enumerate(bodies))
    calls = [f"    memory.answers[{n}] = law_{n}(estimator, own, memory)\n" for n in range(len(bodies))]
    return f"{LAW_HEAD}{top}\n\n{laws}\n{HOOKS.format(calls=''.join(calls) or '    return')}"


def names_in(path: Path) -> dict[str, Any]:
    """Execute a module from its file and return its names."""
    spec = spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return vars(module)
