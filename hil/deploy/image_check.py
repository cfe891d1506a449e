"""The checks of `floaty deploy check --elf` on everything linked around the core, and their limits."""

from collections.abc import Callable, Iterator
from pathlib import Path

from firmware_py.export.app_toc import app_parameters
from hil.config import load_config
from hil.deploy.beside import fly_beside_python
from hil.deploy.doctor import Finding
from hil.deploy.image_bench import SERVO_OUTPUTS, ImageBench, check_parameters
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import image_at
from hil.stm32f405.image import Image, MemoryUse

FREE_LEAST = 1024  # [bytes]
APP = "floaty_toc_apply"  # exists in images with the exported app
UNPROVEN = (
    "values of log variables; limits that the laboratory's own parameters do not have",
    "absolute poses and the stock commander, manual angles, poses through the app channel",
    "port 10: calls for a host, hardware in the loop (`floaty deploy check --targets LINK` does on a board)",
    "restart after a crash; parameters stored in the EEPROM; decks, USB, flash wait states",
    "differences in flight below the bounds above",
)
Show = Callable[[str, int, int], None]  # (what, done, of how many)


def check_memory(memory: tuple[MemoryUse, ...]) -> Finding:
    """Return the use of the memories; less than a kilobyte left is a warning."""
    short = [f"{one.name} has less than {FREE_LEAST} B left" for one in memory if one.free < FREE_LEAST]
    uses = (f"{one.name} {one.used} B of {one.size}, {one.free} B free" for one in memory)
    return Finding("memory", "; ".join((*uses, *short)), not short)


def check_image(elf: Path, profile: str, overrides: tuple[str, ...], show: Show) -> Iterator[Finding]:
    """Yield the findings on an image's app, on the bench and in flight. Raises `LabError`."""
    config = load_config(profile, overrides)
    flashed = image_at(str(elf), None)
    show("boot", 0, 1)
    bench = ImageBench(flashed, config)
    constants = bench.constants(config)
    yield Finding("constants", constants or "as in the profile", not constants)
    table = app_parameters(config)
    found = list(check_parameters(table, bench, lambda done: show("parameters", done, len(table))))
    yield from _all(
        found, "params", f"{len(table)} defaults, limits and the fields that they write are the profile's"
    )
    yield from _all(list(bench.check_switches()), "switches", "stop, arm and reset act")
    yield from _all(list(bench.check_watch()), "watch", "acts when another controller runs, and only then")
    yield from _all(
        list(bench.check_servo_outputs()),
        "servos",
        f"{len(SERVO_OUTPUTS)} fields of timers and pins are as for 400 Hz",
    )

    def progress(name: str, now_us: int, flight: Flight) -> None:
        show(f"flight, {name}", now_us, flight.end_us)

    compared, ends, states = fly_beside_python(elf, profile, overrides, progress)
    yield from (Finding("flight", text, False) for text in ends)
    yield from (Finding("flight", str(one), one.held) for one in compared)
    yield from _all(
        states, "states", "the supervisor's states and causes are the Python board's, in their order"
    )


def has_app(elf: Path) -> tuple[bool, tuple[MemoryUse, ...]]:
    """Return whether an image has the exported app, and its memory use. Raises `LabError`."""
    image = Image(elf)
    return image.has(APP), image.memory


def _all(found: list[str], subject: str, good: str) -> Iterator[Finding]:
    if found:
        yield from (Finding(subject, text, False) for text in found)
    else:
        yield Finding(subject, good)
