"""World, fast model and observation compiled as C compute the bits of their Python, with every compiler."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_py.compiling import bound, bound_in
from firmware_py.core.structs import Control, Estimator, Parameters
from firmware_py.core.subset import Block
from firmware_py.export.compilers import Compiler, compilers
from firmware_py.export.kernels import build, translate
from firmware_py.export.methods import METHOD
from hil.board import imu
from hil.pictures.exports import demonstrations
from hil.research.learn import agent
from hil.research.learn.tasks import PUSH_KINDS, PUSHES
from hil.world import fixed_order, motion, quadrotor
from hil.world.structs import GUSTS, NOISE_ROWS, Air, Flaps, Rigid
from support.other_machine import OtherMachine

COMPILERS = [one for one in compilers() if one.name != "cc"]
WARNINGS = ("-Wall", "-Wextra", "-Werror")
STATES = 40
FEW_ROWS = 8
Memory = list[Block[Any] | NDArray[Any]]


def floaty() -> Memory:
    return [Rigid.allocate(), Air.allocate(), Flaps.allocate(), np.zeros((NOISE_ROWS, GUSTS))]


def crazyflie() -> Memory:
    return [Rigid.allocate(), Air.allocate(), quadrotor.Rotors.allocate(), np.zeros((NOISE_ROWS, GUSTS))]


def sensor() -> Memory:
    return [imu.Imu.allocate(), np.zeros(3), np.zeros(3), np.zeros(2), np.zeros((imu.NOISE_ROWS, 6))]


def learner() -> Memory:
    shared = [Parameters.allocate(), Estimator.allocate(), Control.allocate(), agent.Sensing.allocate()]
    return [*floaty()[:3], agent.Agent.allocate(), np.zeros((1, agent.DRAWS)), *shared]


def board() -> Memory:
    return [Parameters.allocate(), Estimator.allocate(), np.zeros(4, np.float32), np.zeros(20, np.float32)]


def matrices() -> Memory:
    return [np.zeros((4, 4)), np.zeros((4, 4))]


def array_of(memory: Block[Any] | NDArray[Any]) -> NDArray[Any]:
    return memory.memory if isinstance(memory, Block) else memory


def bytes_of(memory: Memory) -> list[bytes]:
    return [array_of(one).tobytes() for one in memory]


def make_nan_one(array: NDArray[Any]) -> None:
    """Give every NaN of float64 the same bits: processors differ in them."""
    for part in [array[name] for name in array.dtype.names or ()] or [array]:
        if part.dtype == np.float64:
            part[np.isnan(part)] = np.nan


def draw(rng: np.random.Generator, memory: Memory) -> None:
    """Fill memory with finite numbers of many sizes, and with what steps, roots and floors need."""
    for one in memory:
        if not isinstance(one, Block):
            one[:FEW_ROWS] = rng.standard_normal(one[:FEW_ROWS].shape)
            continue
        for name in one.memory.dtype.names or ():
            field = one.memory[name]
            sizes = 10.0 ** rng.integers(-3, 3, field.shape)
            numbers = rng.standard_normal(field.shape) * sizes
            field[...] = rng.integers(0, 2, field.shape) if field.dtype == np.int32 else numbers
        fields: Any = one.fields
        if one.kind is Rigid:
            fields.time_us, fields.step_us, fields.until_us = 5000.0, 1000.0, 7000.0
            fields.q_WB[:] /= np.sqrt(np.sum(np.square(fields.q_WB)))
        if one.kind is agent.Agent:
            fields.pushes[:2] = rng.uniform(-0.1, 0.01, PUSHES), rng.integers(0, len(PUSH_KINDS), PUSHES)
        if one.kind is Air:
            fields.noise_row = rng.integers(0, FEW_ROWS - 2)
        if one.kind is Flaps:
            fields.lag, fields.rate_limit = 0.03, 5.0
        if one.kind is quadrotor.Rotors:
            fields.volts_to_thrust[:] = np.abs(fields.volts_to_thrust)
            fields.rpm_to_thrust[:], fields.lag = np.abs(fields.rpm_to_thrust), 0.05
        if one.kind is imu.Imu:
            fields.rows_left, fields.limit[:] = rng.integers(1, FEW_ROWS), 32768.0


KERNELS: dict[str, tuple[Callable[..., None], Callable[[], Memory]]] = {
    "floaty": (motion.advance, floaty),
    "quadrotor": (quadrotor.advance, crazyflie),
    "imu": (imu.channels, sensor),
    "learn": (agent.advance, learner),
    "observation": (demonstrations.observe_board, board),
    "eigen": (fixed_order.diagonalise, matrices),
}


@pytest.mark.parametrize("compiler", COMPILERS, ids=[one.name for one in COMPILERS])
@pytest.mark.parametrize(("kernel", "allocate"), KERNELS.values(), ids=KERNELS)
def test_steps_from_any_state_have_the_bits_of_python(
    kernel: Callable[..., None], allocate: Callable[[], Memory], compiler: Compiler
) -> None:
    rng = np.random.default_rng(2026)
    in_c, in_python = allocate(), allocate()
    arrays = tuple(array_of(one) for one in in_c)
    call = bound_in(
        build(translate((kernel,), arrays), compiler, WARNINGS), METHOD + kernel.__name__, *arrays
    )
    for _ in range(STATES):
        draw(rng, in_c)
        before = bytes_of(in_c)
        for ours, theirs in zip(in_python, in_c, strict=True):
            array_of(ours)[:] = array_of(theirs)
        call()
        with np.errstate(all="ignore"):
            kernel(*(one.fields if isinstance(one, Block) else one for one in in_python))
        assert bytes_of(in_c) == bytes_of(in_python) != before


@pytest.mark.long
@pytest.mark.skipif("zig" not in [one.name for one in COMPILERS], reason="no ziglang")
@pytest.mark.parametrize(("kernel", "allocate"), KERNELS.values(), ids=KERNELS)
def test_another_machine_computes_the_same_bits(
    kernel: Callable[..., None], allocate: Callable[[], Memory]
) -> None:
    rng = np.random.default_rng(2027)
    here, there = allocate(), allocate()
    arrays, copies = ([array_of(one) for one in memory] for memory in (here, there))
    call = bound(kernel, *here)
    with OtherMachine({"kernels.c": translate((kernel,), tuple(arrays))}) as machine:
        for _ in range(STATES):
            draw(rng, here)
            before = bytes_of(here)
            for ours, theirs in zip(copies, arrays, strict=True):
                ours[:] = theirs
            call()
            machine.call(kernel.__name__, copies)
            for one in (*arrays, *copies):
                make_nan_one(one)
            assert bytes_of(there) == bytes_of(here) != before
