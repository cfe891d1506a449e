"""Same seed, same hash, whatever the processor: each setting makes BLAS, numpy or the C library compute for another.

Run as a script, this file flies all flights and prints their hashes.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.faults import parse
from hil.laboratory.request import Request
from hil.laboratory.run import fly

FAULTS = (
    "servo.slow.2@0.1:0.5=0.5",
    "imu.bias.p@0.2=3",
    "mocap.outlier@0.4",
    "radio.bit_errors@0.2",
    "push.y@0.6=2",
)
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
    done = subprocess.run(command, env=os.environ | setting, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.fixture(scope="module")
def usual() -> list[str]:
    found = hashes({})
    assert len(set(found)) == 4
    return found


@pytest.mark.long
def test_oldest_blas_and_no_vector_instructions_make_the_same_flights(usual: list[str]) -> None:
    assert hashes(SETTINGS["prescott"] | SETTINGS["numpy"] | SETTINGS["libm"]) == usual


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


if __name__ == "__main__":
    print_hashes()
