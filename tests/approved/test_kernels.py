"""Every kernel computes from random memory what it computed before, and the C of all that flies is what it was.

The memory has plausible, far, and special numbers. The order of a sum, a sign, an edge or a reset that changes shows
here by the kernel's name. If one is meant, give the reason in CHANGELOG where a flight's hash changes too, and write the
results anew:

    make approve
"""

import hashlib
import importlib
import inspect
import json
import pkgutil
import re
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import firmware_py.core
import firmware_py.logic.laws
from firmware_py import compiling
from firmware_py.config import LogicConfig, parameters_of
from firmware_py.core.structs import Estimator, Parameters
from firmware_py.core.subset import Block, Struct
from firmware_py.export import c99
from firmware_py.export.kernels import translate
from firmware_py.logic.laws import SHIPPED_LAWS
from firmware_py.logic.loading import translation_of
from hil import RigidBody, fly_swarm
from hil.config import load_config
from hil.laboratory.bodies import make_body
from hil.pictures.exports.demonstrations import observer
from hil.research.learn.envs import make_env
from hil.world import fixed_order
from support.approved import approve, judge

RESULTS = Path(__file__).with_name("kernels.json")
DRAWS = 30
FLOWN = (
    "estimate",
    "predict_now",
)  # advance the covariance many times: pinned by the reference flights' hashes
SHAPES = {"P": (16, 16), "M": (16, 16), "command": (64, 4)}
SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 1e-42, 3.4e38, -1e20, np.inf, -np.inf, np.nan], np.float32)
OWN = parameters_of(load_config()).memory
MODULES = [
    importlib.import_module(f"{package.__name__}.{module.name}")
    for package in (firmware_py.core, firmware_py.logic.laws)
    for module in pkgutil.iter_modules(package.__path__)
]


def kernels(module: ModuleType) -> dict[str, Callable[..., Any]]:
    """Return a module's own kernels."""
    return {
        name: one
        for name, one in vars(module).items()
        if inspect.isfunction(one)
        and name not in FLOWN
        and one.__module__ == module.__name__
        and inspect.getsource(one).startswith("@kernel")
    }


class Draws:
    """Random arguments of one call."""

    def __init__(self, number: int) -> None:
        self.rng = np.random.default_rng(number)
        self.wild = number % 3

    def floats(self, shape: Any = ()) -> Any:
        """Plausible numbers, numbers of any size, or special ones among them."""
        plausible = self.rng.normal(0.0, (0.3, 1.0, 2.0)[self.rng.integers(3)], shape).astype(np.float32)
        if self.wild == 0:
            return plausible
        far = (plausible * 10.0 ** self.rng.uniform(-6, 6, shape)).astype(np.float32)
        special = self.rng.choice(SPECIAL, shape)
        return np.where(
            self.rng.random(shape) < (0.3 if self.wild == 1 else 0.15),
            far if self.wild == 1 else special,
            plausible,
        )

    def integers(self, shape: Any = ()) -> Any:
        """Counters and choices, most of them small."""
        small, large = self.rng.integers(0, 12, shape), self.rng.integers(-2000, 200_000, shape)
        return np.where(self.rng.random(shape) < 0.7, small, large).astype(np.int32)

    def struct(self, kind: type[Struct]) -> Block[Any]:
        block = Block(kind)
        for name, (field, *_) in kind.dtype.fields.items():
            drawn = self.floats(field.shape) if field.base == np.float32 else self.integers(field.shape)
            block.memory[name] = drawn
        if kind is Parameters:
            drawn = block.copy()
            block.memory[:] = OWN
            for name in kind.dtype.names or ():
                if self.rng.random() < 0.15:
                    block.memory[name] = drawn.memory[name]
        return block

    def argument(self, name: str, kind: Any) -> Any:
        """Return an argument of an annotated kind."""
        if inspect.isclass(kind) and issubclass(kind, Struct):
            return self.struct(kind)
        text = str(kind)
        if "ndarray" in text:
            return self.floats(SHAPES.get(name, 64)) if "float32" in text else self.integers(64)
        if kind is np.float32:
            return np.float32(self.floats())
        assert "int" in text, kind
        return int(self.rng.integers(0, 4))


def result(function: Callable[..., Any], number: int) -> bytes:
    """Return what a call returns and leaves behind; NaN has one pattern."""
    draws = Draws(number)
    hints = typing.get_type_hints(function)
    hints.pop("return")
    arguments = [draws.argument(name, kind) for name, kind in hints.items()]
    taken = [one.fields if isinstance(one, Block) else one for one in arguments]
    with np.errstate(all="ignore"):
        try:
            answer = function(*taken)
        except (IndexError, OverflowError, ValueError) as error:
            return type(error).__name__.encode()
    found = [
        np.float64(answer).tobytes() if answer is not None and answer == answer else repr(answer).encode()
    ]
    for one in arguments:
        if isinstance(one, Block | np.ndarray):
            memory = one.memory if isinstance(one, Block) else one
            found += [leaf.tobytes() for leaf in leaves(memory)]
    return b"".join(found)


def leaves(memory: Any) -> Iterator[Any]:
    """Yield arrays of one type."""
    for name in memory.dtype.names or ():
        yield from leaves(memory[name])
    if memory.dtype.names is None:
        yield np.where(np.isnan(memory), np.float32(np.nan), memory) if memory.dtype.kind == "f" else memory


def results(module: ModuleType) -> dict[str, str]:
    """Return the hash of each kernel's results."""
    found = {}
    for name, function in kernels(module).items():
        digest = hashlib.sha256()
        failed = 0
        for number in range(DRAWS):
            one = result(function, number)
            failed += one.endswith(b"Error")
            digest.update(one)
        found[f"{module.__name__}.{name}"] = f"{digest.hexdigest()[:16]}" + (
            f", {failed} raise" if failed else ""
        )
    return found


def texts() -> dict[str, str]:
    """Return the hash of each part of the core, of laws, and of the libraries that flights bind."""
    found: dict[str, str] = {}
    make = compiling._library

    def note(place: str, text: str) -> None:
        parts: dict[str, str] = {}
        for part in text.split("\n\n"):
            name = re.search(r"(\w+)\(.*\{$", part, re.MULTILINE)
            key = f"{place} {name[1] if name else ''}"
            parts[key] = parts.get(key, "") + part
        found.update({key: hashlib.sha256(part.encode()).hexdigest()[:12] for key, part in parts.items()})

    def library(functions: compiling.Functions, arrays: tuple[Any, ...]) -> Path:
        note(f"{functions[0].__module__}.{functions[0].__name__}", translate(functions, arrays))
        return make(functions, arrays)

    note("core", c99.translate().source)
    for name, law in SHIPPED_LAWS.items():
        note(f"{name}.py", translation_of(LogicConfig(controller=law)).source)

    class Own(RigidBody):
        mass, inertia = 0.1, (1e-3, 1e-3, 1e-3)

        def wrench(self, *of: Any) -> Any:
            return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)

    rng, home, numbers = np.random.default_rng(1), (0.0, 0.0, 1.0), np.zeros(20, np.float32)
    with pytest.MonkeyPatch.context() as patch, TemporaryDirectory() as folder:
        patch.setattr(compiling, "_library", library)
        fly_swarm("hover", 2, f"{folder}/swarm", duration_s=0.02)
        make_env("Hover", "fast", duration_s=0.1).reset(seed=1)
        make_body(load_config("crazyflie"), rng, home)
        Own(load_config(), rng, home)
        fixed_order.eigen(np.eye(4))
        observer(Parameters.allocate(), Estimator.allocate(), numbers[:4], numbers)
    return found


@pytest.mark.skipif(compiling.PLAIN, reason="FLOATY_PURE=1: nothing is bound as C")
def test_the_c_of_every_kernel_that_flies_is_what_it_was() -> None:
    judge(RESULTS.with_name("flown_c.json"), "functions", texts())


@pytest.mark.long
@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_a_kernel_computes_from_random_memory_what_it_computed(module: ModuleType) -> None:
    known = json.loads(RESULTS.read_text())
    found = results(module)
    assert found == {name: text for name, text in known.items() if name.rpartition(".")[0] == module.__name__}


if __name__ == "__main__":
    RESULTS.write_text(
        json.dumps({name: text for one in MODULES for name, text in results(one).items()}, indent=2) + "\n"
    )
    approve(RESULTS.with_name("flown_c.json"), {"functions": texts})
