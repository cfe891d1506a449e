"""What an image dies of stands in the events, what it left of its memory in the result: of the tests' own firmware."""

import re
from pathlib import Path
from struct import pack

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.board import image_firmware
from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.recorder import load_events
from hil.laboratory.files.result import Result, read_result
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import in_lockstep
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures.report import write_report
from support.stm32_firmware import build

NOTHING, BUS_FAULT, _, ASSERTION, HUNGRY_WATCHDOG = range(5)


def flown(folder: Path, planted: int, duration_s: float, monkeypatch: pytest.MonkeyPatch) -> Result:
    """A flight in which something goes wrong from its beginning on."""
    elf = build()
    monkeypatch.setattr(image_firmware, "WARM_UP_US", 20_000)
    request = Request.of(
        find_experiment("hover"),
        duration_s=duration_s,
        board=str(elf),
        overrides=("flight.release_us=50000",),
    )

    def made(*arguments: object) -> Flight:
        flight = in_lockstep(*arguments)  # type: ignore[arg-type]
        image = flight.robot.firmware
        image.chip.write(image.image.symbol("planted").address, pack("<I", planted))
        return flight

    return fly(request, folder / "run", flight_of=made)


def said(result: Result) -> list[str]:
    return [event["text"] for event in load_events(result.folder)]


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
def test_a_crash_s_cause_is_an_event_and_the_cause_of_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, planted: int, expected: str
) -> None:
    result = flown(tmp_path, planted, 0.3, monkeypatch)
    texts = said(result)
    assert any(re.match(expected, text) for text in texts), texts
    # It is reported once per reset, though the fault's handler is a loop of one instruction.
    resets = sum("reset" in text for text in texts)
    assert sum(text.startswith(("HardFault", "assertion")) for text in texts) <= resets + 1
    assert not result.passed
    assert any(re.match(expected, text) for text in result.failures)
    assert str(result.cause).startswith(result.failures[0])
    assert texts.index(result.failures[0]) == min(texts.index(one) for one in result.failures)
    assert read_result(result.folder).failures == result.failures
    by_software = sum(text.startswith("reset by software, in task REPORT: assertFail (") for text in texts)
    if planted == ASSERTION:
        assert by_software > 0
    assert result.image is not None
    counted = result.image.software_resets, result.image.watchdog_resets
    by_watchdog = sum(text.startswith("watchdog reset") for text in texts)
    assert counted == (by_software, by_watchdog)
    assert by_watchdog > 0 if planted == HUNGRY_WATCHDOG else sum(counted) > 0 or planted == BUS_FAULT


@pytest.mark.long
def test_the_report_has_free_stacks_and_restarts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = flown(tmp_path, ASSERTION, 0.3, monkeypatch)
    assert read_result(result.folder).image == result.image
    image = result.image
    assert image is not None
    assert list(image.stack_free_bytes) == ["FILTER", "FROZEN", "REPORT", "SPIN-0", "SPIN-1", "IDLE"]
    assert all(0 < free < 1024 for free in image.stack_free_bytes.values())
    assert image.heap_free_bytes is None  # it has none
    page = write_report(result.folder).read_text(encoding="utf-8")
    stacks = page[page.index('<table id="stacks">') :]
    for name, free in image.stack_free_bytes.items():
        assert f'<tr><td>{name}</td><td class="number">{free}</td></tr>' in stacks
    assert f"<td>0 by the watchdog, {image.software_resets} by the firmware itself</td>" in page
    assert (
        f"--board {result.request.bench.board}" in page[page.index('<dl id="story">') : page.index("</dl>")]
    )
