"""High-level commands that the app takes back are those that the Python board refuses: the same numbers on both."""

import ctypes
import math
import struct
from collections.abc import Iterator
from errno import EBUSY
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_py.core.structs import Report
from firmware_py.crazyflie.high_level_commander import ENOEXEC, OK, HighLevelCommander
from firmware_py.crazyflie.planner import PathPoint
from firmware_py.wire.high_level import PORT, PathCommand, encode
from hil.config import load_config
from support.crazyflie_app import App

HOME = np.array(load_config().flight.home)
RADIUS, BELOW, ABOVE = 0.5, 0.7, 0.3  # [m]
PLACE, YAW = HOME + np.array((0.2, -0.1, 0.05)), 0.7  # where the robot is, inside the box
FLYING = 1  # TRAJECTORY_STATE_FLYING
LAYOUTS = {  # kinds of the fields behind the command: u byte, ? flag, f number, t time
    PathCommand.SET_GROUP_MASK: "u", PathCommand.STOP: "u",
    PathCommand.TAKE_OFF_1: "uft", PathCommand.LAND_1: "uft", PathCommand.TAKE_OFF: "uff?t", PathCommand.LAND: "uff?t",
    PathCommand.TAKE_OFF_WITH_VELOCITY: "uf?f?t", PathCommand.LAND_WITH_VELOCITY: "uf?f?t",
    PathCommand.GO_TO_1: "u?fffft", PathCommand.GO_TO: "u??fffft", PathCommand.SPIRAL: "u??fffft",
    PathCommand.START_1: "u??ut", PathCommand.START: "u???ut",
}  # fmt: skip


def drawn(command: PathCommand, rng: np.random.Generator) -> bytes:
    """A command whose numbers are now and then no numbers, whose times no times, and whose size is wrong."""

    def numbers() -> tuple[float, ...]:
        return rng.uniform(-0.5, 0.5), rng.uniform(0.5, 1.6), np.nan, np.inf

    draw = {
        "u": lambda: bytes((rng.integers(4),)),
        "?": lambda: bytes((rng.integers(2),)),
        "f": lambda: struct.pack("<f", rng.choice(numbers(), p=(0.6, 0.38, 0.01, 0.01))),
        "t": lambda: struct.pack("<f", rng.choice((1.5, 0.0, -1.0, np.nan), p=(0.7, 0.14, 0.14, 0.02))),
    }
    data = bytes((command,)) + b"".join(draw[kind]() for kind in LAYOUTS[command])
    return rng.choice(np.array((data, data[:-1], data + b"\0"), object), p=(0.9, 0.05, 0.05))


def spoilt() -> Iterator[bytes]:
    """Commands inside the box, each with one number that is none."""
    for command, layout in LAYOUTS.items():
        height = 1.1 if layout.startswith("uf") and "?f?" not in layout else 0.1  # 0.1 is relative
        fine = {"u": 0, "?": True, "f": height, "t": 1.5}
        for place, kind in enumerate(layout):
            if kind in "ft":
                values = [fine[one] for one in layout]
                values[place] = math.nan
                yield struct.pack("<B" + layout.replace("u", "B").replace("t", "f"), command, *values)


def board_of(flying: bool) -> HighLevelCommander:
    """The Python board's commander with the robot in its place, at rest or at the end of a path."""

    def admits(places: tuple[tuple[float, ...], ...]) -> bool:
        x, y, z = np.subtract(places[-1], HOME)
        return bool(np.hypot(x, y) <= RADIUS and -BELOW <= z <= ABOVE)

    elsewhere = PathPoint((0.0, 0.0, 0.0), 0.0)
    estimate = elsewhere if flying else PathPoint(tuple(PLACE.tolist()), YAW)
    board = HighLevelCommander(
        SimpleNamespace(estimate=lambda: estimate, admits=admits), lambda kind, text: None
    )
    board.block(False)
    if flying:
        assert board.execute(encode(PathCommand.GO_TO, 0, False, False, *PLACE, YAW, 0.0)[1:], 0.0) == OK
        board.setpoint(1.0)
    return board


@pytest.fixture
def app(library: Path, tmp_path: Path) -> App:
    app = App(library, tmp_path / "copy.so")
    app.boot(absolute=True)
    for name, size in (("radius", RADIUS), ("below", BELOW), ("above", ABOVE)):
        app.set(f"box.{name}", size)
    return app


@pytest.mark.long
@pytest.mark.parametrize("flying", [False, True])
def test_the_app_takes_back_what_the_python_board_refuses_and_nothing_else(app: App, flying: bool) -> None:
    place = (ctypes.c_float * 4).in_dll(app.c, "floaty_commanded")
    report = app._struct(Report)
    if flying:
        place[:] = (*PLACE, YAW)
    else:
        report.position[:], report.attitude[2] = PLACE, YAW
    ctypes.c_int32.in_dll(app.c, "stub_planner").value = FLYING if flying else 0
    waits, rng, refused = ctypes.c_int32.in_dll(app.c, "stub_waits"), np.random.default_rng(7), []
    waiting: list[bytes] = []
    drawn_ones = [drawn(command, rng) for command in 100 * list(LAYOUTS)]
    for data in (*drawn_ones, *spoilt()):
        if len(waiting) == 4 or rng.random() < 0.5:  # the firmware's commander gets its turn
            waiting, waits.value = [], 0
        app.radio(data, PORT, 0)
        waiting.append(data)
        answers = list(iter(app.sent, b""))
        assert app.suspended.value == 0
        refused.append(bool(answers))
        if answers:
            errors = (*[EBUSY] * (len(waiting) - 1), ENOEXEC)
            assert [answer[1:4] for answer in answers] == [each[:3].ljust(3, b"\0") for each in waiting]
            assert [tuple(answer[4:]) for answer in answers] == [(error,) for error in errors]
            waiting = []
        assert waits.value == len(waiting), "what is not taken back waits for the firmware"
        assert bool(answers) == (board_of(flying).execute(data, 1.0) == ENOEXEC), data.hex()
    assert 0.2 < np.mean(refused) < 0.8


@pytest.mark.parametrize("data", [b"", b"\x0e\0", b"\xff\0"])
def test_what_is_no_command_is_the_firmware_s_to_refuse(app: App, data: bytes) -> None:
    app.radio(data, PORT, 0)
    assert (app.sent(), ctypes.c_int32.in_dll(app.c, "stub_waits").value) == (b"", 1)
