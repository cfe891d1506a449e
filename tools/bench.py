"""Measures the real-time factor of whole flights and the cost of their parts, side by side in one run.

    python tools/bench.py             everything but the first compilation
    python tools/bench.py --compile   also a first compilation in an empty cache (about half a minute)
    python tools/bench.py --campaign  also flights of a campaign on Dask's workers (about two minutes)
    python tools/bench.py --json FILE also write the figures there

Figures are processor time, except for the campaign, of this machine at this moment: compare rows of one run, not of two.
Peers in the same run: simpy on the scheduler's scenario, a flight of RotorPy (extra `bench`), and as the floor a loop of
as many empty events.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from heapq import heapreplace
from pathlib import Path
from timeit import repeat

import numpy as np
from bench_kernel import kernel_run, simpy_run, us_per_activation
from rich.console import Console
from rich.table import Table

from firmware_py.config import parameters_of
from firmware_py.core_runner import CoreBlocks, default_runner
from firmware_py.extras import install_command
from hil.commands.app import COMMANDS
from hil.commands.options import right
from hil.config import load_config
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import Recorder
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.world.floaty.plant import Plant

ROOT = Path(__file__).parent.parent
FLIGHT_S = 30.0
REPEATS, CALLS = 3, 20_000
IMAGE_S = 8.0  # of flight
# Of the events of a hover: IMU, exposures, their frames, rows of the log, and radio events.
EVENT_PERIODS_US = (1000, 5000, 5000, 10_000, 4000, 4000, 4000)
ROTORPY_S = 5.0
HOVER = "fly hover --duration 6"


def best(measure: Callable[[], float]) -> float:
    """Return the smallest of a few measurements, the least disturbed one."""
    return min(measure() for _ in range(REPEATS))


def us_per_call(call: Callable[[], object]) -> float:
    return min(repeat(call, timer=time.process_time, number=CALLS, repeat=REPEATS)) / CALLS * 1e6


def flight_s(recorded: bool) -> float:
    """Processor time of one hover, with or without recorder and telemetry log."""

    def measure() -> float:
        with tempfile.TemporaryDirectory() as folder:
            telemetry = Path(folder) / "telemetry.csv" if recorded else None
            flight = lockstep_flight(Request.of(EXPERIMENTS["hover"], duration_s=FLIGHT_S), telemetry)
            recorder = Recorder(Path(folder), flight.channels(), {}) if recorded else None
            start = time.process_time()
            flight.run(recorder=recorder)
            if recorder is not None:
                recorder.close()
            flight.close()
            return time.process_time() - start

    return best(measure)


def core_us() -> tuple[float, float]:
    """Microseconds of one estimator tick (with a pose every other tick) and one controller tick."""
    parameters = parameters_of(load_config())
    core = CoreBlocks(parameters, default_runner)
    call, data = core.run.call, core.data
    call("reset")
    data.fields.pose_quaternion[:] = 1.0, 0.0, 0.0, 0.0
    data.fields.mode = 1
    ticks = 0

    def estimate() -> None:
        nonlocal ticks
        ticks += 1
        data.fields.gyro_samples = 10
        if ticks % 2:
            data.fields.pose_age_us = 33_000
            call("file_pose")
        call("estimate")

    return us_per_call(estimate), us_per_call(lambda: call("control"))


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

    return us_per_call(step)


def command_s(*words: str, **environment: str) -> float:
    """Processor time of a process of Python, from its start to its end."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        variables = os.environ | {"PYTHONPATH": str(ROOT)} | environment
        subprocess.run([sys.executable, *words], cwd=folder, env=variables, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def start_up_s(board: str = "c", **environment: str) -> float:
    """Processor time of a process, set up as `floaty` does, until its first ticks; without the end of Python."""
    code = (
        "import gc, os; gc.set_threshold(100_000, 20, 50); os.environ.setdefault('OPENBLAS_NUM_THREADS', '1');"
        "from contextlib import ExitStack; from hil.laboratory.experiments import EXPERIMENTS;"
        "from hil.laboratory.lockstep import in_lockstep; from hil.laboratory.request import Request;"
        f"request = Request.of(EXPERIMENTS['hover'], duration_s=1.0, board={board!r});"
        "flight = in_lockstep(request, None, ExitStack()); flight.lab.end_at(30_000); flight.run(); os._exit(0)"
    )
    return command_s("-c", code, **environment)


def image_s(elf: str) -> float:
    """Processor time of one simulated second of an image."""

    def flown_s(duration_s: float) -> float:
        words = ("-m", "hil.commands", *HOVER.split()[:-1], str(duration_s), "--board", elf)
        return best(partial(command_s, *words))

    return (flown_s(IMAGE_S + 1.0) - flown_s(1.0)) / IMAGE_S


def empty_loop_us() -> float:
    """Microseconds of one millisecond of a loop with as many events as a hover, all empty."""
    heap = [(period_us, period_us) for period_us in sorted(EVENT_PERIODS_US)]

    def nothing(now_us: int) -> None:
        pass

    def millisecond() -> None:
        end_us = heap[0][0] + 1000
        while heap[0][0] < end_us:
            now_us, period_us = heap[0]
            heapreplace(heap, (now_us + period_us, period_us))
            nothing(now_us)

    return us_per_call(millisecond)


def rotorpy_s() -> float:
    """Processor time of a hover of RotorPy's quadrotor with its own controller; ImportError without the package."""
    from rotorpy.controllers.quadrotor_control import SE3Control
    from rotorpy.environments import Environment
    from rotorpy.trajectories.hover_traj import HoverTraj
    from rotorpy.vehicles.crazyflie_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    def measure() -> float:
        flight = Environment(Multirotor(quad_params), SE3Control(quad_params), HoverTraj())
        start = time.process_time()
        flight.run(t_final=ROTORPY_S)
        return time.process_time() - start

    return best(measure)


class Figures:
    """The measurements: a table for people, and the same for programs."""

    def __init__(self) -> None:
        self.table = Table("what", *right("value", "compared"), title="floaty bench")
        self.values: dict[str, float] = {}

    def add(self, name: str, value: float, unit: str, compared: str = "", digits: int = 2) -> None:
        self.table.add_row(name, f"{value:.{digits}f} {unit}", compared)
        self.values[f"{name} [{unit}]"] = round(value, 4)


def add_commands(figures: Figures) -> None:
    """Add the command line's cost: the slowest `--help`, and a short flight from Enter to the prompt."""
    empty = best(lambda: command_s("-c", ""))

    def add(name: str, seconds: float) -> None:
        figures.add(name, seconds, "s", f"{seconds / empty:.0f} x an empty Python")

    helps = [best(partial(command_s, "-m", "hil.commands", name, "--help")) for name in COMMANDS]
    add("slowest --help", max(helps))
    add(f"floaty {HOVER}", best(lambda: command_s("-m", "hil.commands", *HOVER.split())))


def add_campaign(figures: Figures) -> None:
    """Add a campaign's throughput on one worker and on one per core, and Dask's cost."""
    from bench_campaign import flights_per_s, growth_kb, overhead_s  # the extra `campaign`

    factors = {
        count: FLIGHT_S * flights_per_s(FLIGHT_S, count) for count in {1, len(os.sched_getaffinity(0))}
    }
    for count, factor in sorted(factors.items()):
        name = f"campaign of 30 s flights, {count} workers"
        figures.add(name, factor, "x real time", f"{factor / factors[1]:.2f} x one", 0)
    figures.add("Dask, per flight", 1e3 * overhead_s(), "ms")
    figures.add("memory kept per flight of 0.1 s", growth_kb(), "kB")


def add_loop(figures: Figures) -> None:
    """Add the real-time factor of whole flights, and the cost of their parts."""
    bare, recorded = flight_s(recorded=False), flight_s(recorded=True)
    simulated_s = FLIGHT_S + load_config().flight.release_us * 1e-6
    loop_us = recorded / simulated_s * 1e3
    figures.add("whole loop, recorded", simulated_s / recorded, "x real time", digits=0)
    figures.add("whole loop, not recorded", simulated_s / bare, "x real time", digits=0)
    try:
        factor = ROTORPY_S / rotorpy_s()
        slower = f"{simulated_s / recorded / factor:.1f} x slower"
        figures.add("RotorPy, a hover at 100 Hz", factor, "x real time", slower, 1)
    except ImportError as error:
        print(f"RotorPy is left out ({error}): {install_command('bench')}", file=sys.stderr)
    figures.add("one simulated millisecond", loop_us, "us", "100 %")

    def part(name: str, us: float, per_ms: float) -> None:
        figures.add(name, us, "us", f"{100.0 * us * per_ms / loop_us:.0f} %")

    part("floor: its events in an empty loop", empty_loop_us(), 1.0)
    estimate_us, control_us = core_us()
    part("core: estimator tick (100 Hz)", estimate_us, 0.1)
    part("core: controller tick (100 Hz)", control_us, 0.1)
    part("plant: one millisecond", plant_us(), 1.0)
    kernel_us, simpy_us = us_per_activation(kernel_run), us_per_activation(simpy_run)
    part("scheduler: one activation (4 per ms)", kernel_us, 4.0)
    figures.add("simpy on the same scenario", simpy_us, "us", f"{simpy_us / kernel_us:.1f} x ours")
    part("recorder and telemetry log, per ms", (recorded - bare) / simulated_s * 1e3, 1.0)
    figures.add("start to first tick, warm", best(start_up_s), "s")


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--compile", action="store_true", help="measure a first compilation too")
    arguments.add_argument("--campaign", action="store_true", help="measure a campaign's workers too")
    arguments.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    options = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:  # warm up
        fly(Request.of(EXPERIMENTS["hover"], duration_s=1.0), Path(folder))
    figures = Figures()
    add_loop(figures)
    add_commands(figures)
    if elf := os.environ.get("FLOATY_CF2_ELF"):
        figures.add("whole binary, from start to first tick", best(lambda: start_up_s(elf)), "s")
        figures.add("whole binary, one simulated second", image_s(elf), "s")
    if options.compile:
        with tempfile.TemporaryDirectory() as folder:
            first_s = start_up_s(FLOATY_CACHE_DIR=folder)
        figures.add("start to first tick, first compilation ever", first_s, "s", digits=1)
    if options.campaign:
        add_campaign(figures)
    Console(width=100).print(figures.table)
    if options.json:
        options.json.write_text(json.dumps(figures.values, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
