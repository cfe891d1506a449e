"""Same seed, same hash, whatever the processor: each setting makes BLAS, numpy or the C library compute for another.

Run as a script, this file flies all flights and prints their hashes.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

from firmware_py import compiling
from firmware_py.core.subset import Block
from firmware_py.export import c99, kernels
from firmware_py.export.native import texts_of
from hil.board.board_firmware import PythonBoard
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.faults import parse
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from support.other_machine import CoreElsewhere, OtherMachine
from support.paths import TESTS

FAULTS = (
    "servo.slow.2@0.1:0.5=0.5", "imu.bias.p@0.2=3", "mocap.outlier@0.4", "radio.bit_errors@0.2", "push.y@0.6=2",
)  # fmt: skip
NUMPY = " ".join(feature for feature in __cpu_dispatch__ if __cpu_features__[feature])
SETTINGS = {
    "prescott": {"OPENBLAS_CORETYPE": "Prescott"},
    "haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "skylake": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "numpy": {"NPY_DISABLE_CPU_FEATURES": NUMPY},
    "plain": {"FLOATY_PURE": "1"},
    "libm": {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4"},
}
NEEDS = {"haswell": "AVX2", "skylake": "AVX512_SKX"}  # cores whose code does not run everywhere


def print_hashes() -> None:
    hover, yaw = EXPERIMENTS["hover"], EXPERIMENTS["yaw-sine-0.15"]
    markers = ["markers.enabled=true", "markers.mislabelled=0.01"]
    requests = (
        Request.of(hover, duration_s=1.0),
        Request.of(hover, overrides=markers, duration_s=1.0),
        Request.of(yaw, link="mavlink", duration_s=1.0, faults=[parse("serial.bit_errors@0.1")]),
        Request.of(hover, duration_s=1.0, faults=[parse(fault) for fault in FAULTS]),
    )
    for request in requests:
        with tempfile.TemporaryDirectory() as folder:
            result = fly(request, Path(folder))
            assert result.outcome in ("completed", "lost"), result.cause
            print(result.hash)


def hashes(setting: dict[str, str]) -> list[str]:
    """Return the hashes of all flights, flown by a process of its own."""
    command = [sys.executable, "-W", "error::ImportWarning", __file__]
    done = subprocess.run(
        command,
        env=os.environ | {"PYTHONPATH": str(TESTS)} | setting,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.fixture(scope="module")
def usual() -> list[str]:
    found = hashes({})
    assert len(set(found)) == 4
    return found


@pytest.mark.long
@pytest.mark.parametrize("name", SETTINGS)
def test_every_setting_makes_the_same_flights(name: str, usual: list[str]) -> None:
    if not __cpu_features__.get(NEEDS.get(name, "SSE2")):
        pytest.skip(f"this processor has no {NEEDS[name]}")
    assert hashes(SETTINGS[name]) == usual


@pytest.mark.long
def test_without_a_system_compiler_the_world_makes_the_same_flights(usual: list[str], tmp_path: Path) -> None:
    (tmp_path / "programs").mkdir()
    assert hashes({"PATH": str(tmp_path / "programs"), "FLOATY_CACHE_DIR": str(tmp_path)}) == usual


@pytest.mark.long
def test_core_and_world_on_another_machine_make_the_same_recorded_flight(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each call of the core, the body and the IMU is computed there; only the scheduler, which is integers, runs here."""
    request = Request.of(EXPERIMENTS["hover"], duration_s=1.0, faults=[parse(fault) for fault in FAULTS])

    def elsewhere(request: Request, telemetry: Path | None, stack: ExitStack) -> Flight:
        def bound(functions: compiling.Functions, *memory: compiling.Memory) -> list[Callable[..., Any]]:
            arrays = tuple(one.memory if isinstance(one, Block) else one for one in memory)
            texts = {"kernels.c": kernels.translate(functions, arrays)}
            machine = stack.enter_context(OtherMachine(texts))
            return [partial(machine.call, function.__name__, arrays) for function in functions]

        monkeypatch.setattr(compiling, "bound_together", bound)
        core = stack.enter_context(OtherMachine(texts_of(c99.translate())))
        return lockstep_flight(request, telemetry, PythonBoard(partial(CoreElsewhere, core)))

    here = fly(request, tmp_path / "here")
    there = fly(request, tmp_path / "there", flight_of=elsewhere)
    assert (there.outcome, there.hash) == (here.outcome, here.hash)


if __name__ == "__main__":
    print_hashes()
