"""Where the time goes: real-time factor of whole flights and the cost of their parts, side by side in one run.

    python tools/bench.py            everything but the first compilation
    python tools/bench.py --compile  also a first compilation in an empty cache (about half a minute)

Absolute figures are of this machine at this moment; compare rows of one run, not of two.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from bench_kernel import kernel_us_per_activation, simpy_us_per_activation
from rich.console import Console
from rich.table import Table

from firmware_py.config import parameters_of
from firmware_py.core import entry
from firmware_py.core.structs import Control, Estimator, Input
from firmware_py.fast import STALE, STATE
from hil.config import load_config
from hil.experiments import EXPERIMENTS
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.recorder import Recorder
from hil.laboratory.run import Request, fly
from hil.world.plant import Plant

ROOT = Path(__file__).parent.parent
FLIGHT_S = 30.0
REPEATS = 3
IMAGE_S = 5.0  # of flight


def best(measure: Callable[[], float]) -> float:
    """The smallest of a few measurements: the one that was disturbed least."""
    return min(measure() for _ in range(REPEATS))


def us_per_call(call: Callable[[], object], count: int) -> float:
    def measure() -> float:
        start = time.perf_counter()
        for _ in range(count):
            call()
        return (time.perf_counter() - start) / count * 1e6

    return best(measure)


def flight_s(recorded: bool) -> float:
    """Wall time of one hover, with or without recorder and telemetry log."""

    def measure() -> float:
        with tempfile.TemporaryDirectory() as folder:
            telemetry = Path(folder) / "telemetry.csv" if recorded else None
            flight = lockstep_flight(load_config(), EXPERIMENTS["hover"], FLIGHT_S, 1, telemetry)
            if recorded:
                flight.recorder = Recorder(Path(folder), flight.channels(), {})
            start = time.perf_counter()
            flight.run()
            if flight.recorder is not None:
                flight.recorder.close()
            flight.close()
            return time.perf_counter() - start

    return best(measure)


def core_us() -> tuple[float, float]:
    """Microseconds of one estimator tick (with a pose every other tick) and one controller tick."""
    parameters = parameters_of(load_config())
    data, estimator, control = (struct.allocate() for struct in (Input, Estimator, Control))
    entry.reset(parameters.arg, estimator.arg)
    data.fields.pose_quaternion[:] = 1.0, 0.0, 0.0, 0.0
    data.fields.pose_age_us = 42_000
    data.fields.gyro_samples = 10
    data.fields.mode = 1
    ticks = 0

    def estimate() -> None:
        nonlocal ticks
        ticks += 1
        if ticks % 2:
            entry.file_pose(parameters.arg, data.arg, estimator.arg)
        entry.estimate(parameters.arg, data.arg, estimator.arg, control.arg)

    def steer() -> None:
        entry.control(parameters.arg, data.arg, estimator.arg, control.arg)

    return us_per_call(estimate, 20_000), us_per_call(steer, 20_000)


def plant_us() -> float:
    """Microseconds of one millisecond of the plant."""
    config = load_config()
    plant = Plant(config.geometry, config.plant, config.tunnel, config.actuators, np.random.default_rng(1))
    plant.hold()
    now_us = 0

    def step() -> None:
        nonlocal now_us
        now_us += 1000
        plant.advance(now_us)

    return us_per_call(step, 20_000)


def start_up_s(cache: Path | None) -> float:
    """Wall time of a process that flies until its first tick; with a cache folder: compiling everything."""
    code = (
        "from hil.config import load_config; from hil.experiments import EXPERIMENTS;"
        "from hil.laboratory.lockstep import lockstep_flight;"
        "flight = lockstep_flight(load_config(), EXPERIMENTS['hover'], 1.0, 1, None);"
        "flight.lab.end_us = 30_000; flight.run()"
    )
    environment = dict(os.environ)
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, check=True)
    return time.perf_counter() - start


def image_factor(elf: str) -> float:
    """Real-time factor of the binary that FLOATY_CF2_ELF names, without its start."""
    request = Request.of(EXPERIMENTS["hover"], duration_s=IMAGE_S, board=elf)
    with tempfile.TemporaryDirectory() as folder:
        return fly(request, Path(folder)).real_time_factor


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--compile", action="store_true", help="measure a first compilation too")
    options = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:  # warm up
        fly(Request(EXPERIMENTS["hover"], load_config(), "floaty", (), 1, 1.0), Path(folder))

    table = Table(title=f"floaty bench: {STATE}")
    table.add_column("what")
    table.add_column("value", justify="right")
    table.add_column("share of the loop", justify="right")
    bare, recorded = flight_s(recorded=False), flight_s(recorded=True)
    simulated_s = FLIGHT_S + load_config().flight.release_us * 1e-6
    loop_us = recorded / simulated_s * 1e3
    table.add_row("whole loop, recorded", f"{simulated_s / recorded:.0f} x real time", "")
    table.add_row("whole loop, not recorded", f"{simulated_s / bare:.0f} x real time", "")
    table.add_row("one simulated millisecond", f"{loop_us:.1f} us", "100 %")

    def part(name: str, us: float, per_ms: float) -> None:
        table.add_row(name, f"{us:.2f} us", f"{100.0 * us * per_ms / loop_us:.0f} %")

    estimate_us, control_us = core_us()
    part("core: estimator tick (100 Hz)", estimate_us, 0.1)
    part("core: controller tick (100 Hz)", control_us, 0.1)
    part("plant: one millisecond", plant_us(), 1.0)
    kernel_us, simpy_us = kernel_us_per_activation(), simpy_us_per_activation()
    part("scheduler: one activation (4 per ms)", kernel_us, 4.0)
    table.add_row("simpy on the same scenario", f"{simpy_us:.2f} us", f"{simpy_us / kernel_us:.1f} x ours")
    table.add_row("recorder and telemetry log", f"{(recorded - bare) / simulated_s * 1e3:.2f} us/ms",
                  f"{100.0 * (recorded - bare) / recorded:.0f} %")  # fmt: skip
    table.add_row("start to first tick, warm", f"{best(lambda: start_up_s(None)):.2f} s", "")
    if elf := os.environ.get("FLOATY_CF2_ELF"):
        table.add_row("whole binary in the emulated chip", f"{image_factor(elf):.1f} x real time", "")
    if options.compile:
        with tempfile.TemporaryDirectory() as folder:
            table.add_row(
                "start to first tick, first compilation ever", f"{start_up_s(Path(folder)):.1f} s", ""
            )
    Console(width=100).print(table)
    if STALE:
        print(f"what `make fast` has compiled is not used: {STALE}")


if __name__ == "__main__":
    main()
