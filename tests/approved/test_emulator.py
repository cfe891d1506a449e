"""What the emulator said of the tests' firmware, it still says: its reports, its counts and its answers to a debugger.

Crashes of every kind, where the cycles went, and a debugger's random questions. If a change is meant: make approve.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.emulator.stm32f405.chip import RAM, StopReason
from hil.emulator.stm32f405.gdb_protocol import (
    REGISTERS,
    SIGINT,
    SIGTRAP,
    RemoteProtocol,
    ResumeRequest,
    framed,
)
from support.approved import approve, judge
from support.crazyflie_board import Board
from support.stm32_machine import FirmwareOnChip, Profiled

REPORTS = Path(__file__).with_name("emulator.json")
MISTAKES = range(21)  # `enum planted` of the tests' firmware
HANG = 9  # ends by the watchdog
PACKETS, SEEDS = 150, range(1, 4)


def crash(planted: int) -> list[str]:
    """Return what a board says of a mistake, what counts as a failure, its resets and its last outputs."""
    board = Board(planted)
    board.run(0, 450 if planted == HANG else 130)
    own = board.crazyflie
    return [
        *board.said,
        f"failures {len(own.failures)}, known {own.known}, resets {own.resets}, {board.counts[-3:]}",
    ]


def profile() -> list[str]:
    """Return where the cycles of 200 ms went."""
    return list(told(Profiled("clang").run_with_samples(200_000), "profile"))


def told(value: Any, name: str) -> Iterator[str]:
    """Yield the members of nested records, a line for each number or text; arrays by count, first, last and sum."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from told(getattr(value, field.name), f"{name}.{field.name}")
    elif isinstance(value, np.ndarray):
        yield f"{name}: {value.size} {value[:1]} {value[-1:]} {value.sum():.6g}"
    elif isinstance(value, list | tuple) and value and not isinstance(value[0], int | float | str):
        for number, one in enumerate(value):
            yield from told(one, f"{name}[{number}]")
    else:
        yield f"{name}: {value:.6g}" if isinstance(value, float) else f"{name}: {value}"


def debugger(seed: int) -> list[str]:
    """Return what random packets of a debugger are answered, between short runs."""
    rng, firmware = np.random.default_rng(seed), FirmwareOnChip()
    protocol = RemoteProtocol(firmware.chip)
    pick: Callable[..., Any] = lambda *of: of[int(rng.integers(len(of)))]  # noqa: E731
    found = []
    for _ in range(PACKETS):
        at, register = RAM + 4 * int(rng.integers(0, 64)), int(rng.integers(len(REGISTERS) + 1))
        length = pick(0, 1, 2, 4, 16)
        packet = pick(
            "?", "g", f"p{register:x}", f"m{at:x},{length:x}", f"m{at:x},{length:x}", f"M{at:x},4:{rng.bytes(4).hex()}",
            f"Z{pick(0, 1, 2, 3, 4)},{at:x},{pick(1, 2, 4)}", f"z{pick(0, 1, 2, 3, 4)},{at:x},{pick(1, 2, 4)}",
            "qfThreadInfo", f"qThreadExtraInfo,{pick(1, 2, 3):x}",
            f"H{pick('g', 'c')}{pick(-1, 0, 1, 2)}", f"T{pick(1, 2, 9)}",
            "qC", "qSupported", "vCont?", "qAttached", f"P{pick(0, 1, 5):x}={rng.bytes(4).hex()}", "D", "bs", "c", "s",
            "qRcmd,666f6f",
        )  # fmt: skip
        answer = protocol.receive(framed(packet.encode()))
        if protocol.request is not ResumeRequest.STOP:
            why = firmware.run(int(firmware.chip.now_us) + pick(20, 700))
            found.append(f"{packet} {protocol.request.name}: {StopReason(why)} {firmware.chip.now_us}")
            answer += protocol.stopped(pick(SIGTRAP, SIGINT), pick(None, at), bool(rng.integers(2)))
        text = answer.decode("latin-1")
        found.append(f"{packet} -> {text if len(text) < 90 else hashlib.sha256(answer).hexdigest()[:12]}")
    found.append(f"{sorted(firmware.chip.breakpoints)} {protocol.take_changes()} {protocol.take_changes()}")
    return found


FOUND: dict[str, Callable[[], list[str]]] = {
    **{f"mistake {planted}": lambda planted=planted: crash(planted) for planted in MISTAKES},  # type: ignore[misc]
    **{f"debugger {seed}": lambda seed=seed: debugger(seed) for seed in SEEDS},  # type: ignore[misc]
    "profile": profile,
}


@pytest.mark.parametrize("name", FOUND)
def test_the_emulator_tells_what_it_told(name: str) -> None:
    judge(REPORTS, name, FOUND[name](), "ziglang")


if __name__ == "__main__":
    approve(REPORTS, FOUND, "ziglang")
