"""Sends the values of a profile and an experiment to an image as to a real board: as parameters, over the radio.

An image has the constants of the profile that it was exported with. Before the release those that differ are reported,
then written one by one, as an operator does; those without a parameter remain and are reported again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from firmware_py.config import FirmwareConfig
from firmware_py.table import OF_PROFILE, value_in
from firmware_py.wire.crtp import decode
from ground_station.config import PilotConfig
from ground_station.controls import ControlAction, ControlRequest, ControlsError
from ground_station.links.crtp_controls import PORTS, CrtpControls, TocEntry
from hil.emulator.events import EventQueue
from hil.errors import LabError, hint, refusing

if TYPE_CHECKING:
    from hil.emulator.crazyflie.log_table import ImageParameter

TURN_US = 10_000  # between checks for an overdue answer
APP_PARAMETER = "floaty.armed"  # which every image with Floaty's app has
STOCK_SUPERVISOR, FIRST_RELEASE = "supervisor.info", "2023.06"
NO_APP = (
    "the image lacks Floaty's app: the servos move only if its own code moves them; Bitcraze's firmware flies with "
    "--profile crazyflie"
)


def contents(table: Mapping[str, ImageParameter]) -> dict[str, TocEntry]:
    """Return an image's parameters as its table of contents reports them."""
    return {name: TocEntry(one.number, one.scalar, one.writable, False) for name, one in table.items()}


def stock_contents(
    table: Mapping[str, ImageParameter], log: Mapping[str, int], pilot: PilotConfig
) -> dict[str, TocEntry]:
    """Return the `contents` of a Crazyflie's own firmware with these parameters and log variables.

    Raises `LabError` for an older release than the laboratory supports, and unless it takes the profile's parameters.
    """
    if APP_PARAMETER in table:
        raise LabError(
            "--board: the image has Floaty's app, which drives servos; a Crazyflie takes Bitcraze's firmware as it is"
        )
    if STOCK_SUPERVISOR not in log:
        raise LabError(
            f"--board: the image has no log variable {STOCK_SUPERVISOR}: its supervisor is older than that of release "
            f"{FIRST_RELEASE}, the first one that flies here"
        )
    entries = contents(table)
    for name, value in pilot.values.items():
        if name not in entries:
            raise LabError(f"pilot.parameters.{name}: the image has no such parameter; {hint(name, entries)}")
        with refusing("pilot.parameters.", ControlsError):
            entries[name].check(name, value)
    return entries


def board_values(config: FirmwareConfig) -> dict[str, float]:
    """Return a profile's values for a board's parameters, by the board's names."""
    return {one.name: value_in(config, key) / one.scale for key, one in OF_PROFILE.items()}


def to_set(table: Mapping[str, ImageParameter], config: FirmwareConfig) -> list[tuple[str, float]]:
    """Return the parameters to write, by the image's names: those it has with another value."""
    return [
        (name, value)
        for name, value in board_values(config).items()
        if name in table and table[name].scalar.cast(value) != table[name].read()
    ]


class ImageSettings:
    """`begin` at a laboratory time, then pass on what the board sends; `report` gets what was set and what was not.

    `table` has the image's parameters by name; `differences` describes in one line how it differs from a configuration.
    """

    def __init__(
        self,
        table: Mapping[str, ImageParameter],
        differences: Callable[[FirmwareConfig], str],
        config: FirmwareConfig,
        events: EventQueue,
        uplink: Callable[[int, bytes], object],
        report: Callable[[str], None],
    ) -> None:
        self._differences, self._config, self._events, self._report = differences, config, events, report
        entries = contents(table)
        self._controls = CrtpControls(lambda data: uplink(events.now_us, data), lambda: entries)
        self._left = to_set(table, config)
        self._set: list[str] = []

    def begin(self, now_us: int) -> None:
        """Report the constants that differ from the profile, and write the first such parameter."""
        if differs := self._differences(self._config):
            self._report(f"the image was built with other constants: {differs}")
        if self._left:
            self._ask(now_us)
            self._turn(now_us)
        else:
            self._finish()

    def on_packet(self, now_us: int, data: bytes) -> None:
        """Take a packet from the board; ignore all but answers."""
        if self._left and (packet := decode(data)).port in PORTS and self._controls.receive(now_us, packet):
            self._go_on(now_us)

    def _turn(self, now_us: int) -> None:
        self._go_on(now_us)
        if self._left:
            self._events.at(now_us + TURN_US, self._turn)

    def _ask(self, now_us: int) -> None:
        name, value = self._left[0]
        self._controls.ask(now_us, ControlRequest(ControlAction.WRITE, name, value))

    def _go_on(self, now_us: int) -> None:
        answer = self._controls.answer(now_us)
        if answer is None:
            return
        name, value = self._left.pop(0)
        if answer.error:
            self._report(answer.error)
        else:
            self._set.append(f"{name} {value:.6g}")
        if self._left:
            self._ask(now_us)
        else:
            self._finish()

    def _finish(self) -> None:
        if self._set:
            self._report(f"set over the radio: {', '.join(self._set)}")
        if stays := self._differences(self._config):
            self._report(f"the image keeps its own {stays}")
