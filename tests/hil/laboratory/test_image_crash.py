"""What an image dies of in flight, and what it left of its memory, stands in the events: of the tests' own firmware."""

import re
from pathlib import Path
from struct import pack

import pytest

pytest.importorskip("unicorn")

from hil.devices.stm32f405 import firmware
from hil.experiments import find_experiment
from hil.laboratory.flight import Flight
from hil.laboratory.recorder import load_events
from hil.laboratory.run import Request, fly, lockstep, prepare
from support.stm32_firmware import build

NOTHING, BUS_FAULT, _, ASSERTION, HUNGRY_WATCHDOG = range(5)


def said(folder: Path, planted: int, duration_s: float, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What stands in the events of a flight in which something goes wrong from its beginning on."""
    elf = build()
    monkeypatch.setattr(firmware, "WARM_UP_US", 20_000)
    request = Request.of(
        find_experiment("hover"),
        duration_s=duration_s,
        board=str(elf),
        overrides=("flight.release_us=50000",),
    )

    def made(*arguments: object) -> Flight:
        flight = lockstep(*arguments)  # type: ignore[arg-type]
        image = flight.robot.firmware
        image.chip.write(image.image.symbol("planted").address, pack("<I", planted))
        return flight

    prepare(folder / "run")
    fly(request, folder / "run", flight_of=made)
    return [event["text"] for event in load_events(folder / "run")]


@pytest.mark.long
@pytest.mark.parametrize(
    ("planted", "expected"),
    [
        (
            BUS_FAULT,
            r"HardFault: access to .* at 0x30000000, in task REPORT: go_wrong \(firmware.c:\d+\) < report ",
        ),
        (ASSERTION, r"assertion how != ASSERTION failed at firmware.c:\d+, in task REPORT: go_wrong "),
        (HUNGRY_WATCHDOG, r"watchdog reset: nobody fed it in time; this ran then, in task SPIN-[01]: "),
    ],
)
def test_what_an_image_dies_of_is_an_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, planted: int, expected: str
) -> None:
    texts = said(tmp_path, planted, 0.3, monkeypatch)
    assert any(re.match(expected, text) for text in texts), texts
    # It is told once per reset, though the fault's handler is a loop of one instruction.
    resets = sum("reset" in text for text in texts)
    assert sum(text.startswith(("HardFault", "assertion")) for text in texts) <= resets + 1
    if planted == ASSERTION:
        assert "reset by software" in texts


@pytest.mark.long
def test_a_flight_ends_with_what_was_never_used_of_the_stacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = said(tmp_path, NOTHING, 0.1, monkeypatch)
    assert re.fullmatch(
        r"bytes never used of stacks: FILTER \d+, FROZEN \d+, REPORT \d+, SPIN-0 \d+, SPIN-1 \d+, IDLE \d+",
        texts[-1],
    )
