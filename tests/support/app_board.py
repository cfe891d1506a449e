"""The exported app as a board behind a virtual Crazyradio and a UDP port: a process of its own, paced to the wall clock.

    python -m support.app_board LIBRARY [SECTION.KEY=VALUE ...]

What stands between the app and the sockets is what `floaty serve` has. Says in a line what state the app is in when that
changes. `board()` starts it.
"""

import os
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from firmware_py.board import Board
from firmware_py.wire.supervisor import Cause, State
from hil.board.board_firmware import PowerOn
from hil.board.clock import Paced
from hil.config import load_config
from hil.emulator.crazyflie.shockburst import syslink_us
from hil.laboratory.laboratory import NEVER_US, Laboratory
from hil.laboratory.robot import Site, Streams
from hil.servers.dongle_plugin import VARIABLE
from hil.servers.served_robot import ServedRobot
from support.crazyflie_app import App
from support.paths import TESTS
from support.serving import PATIENCE_S, Served

STEP_US = 1000


class AppBoard:
    """Executes the app in place of the firmware: `hil.board.board_firmware.Executor`."""

    needs_polls = False
    in_flash = b""  # what a boot loader writes is not executed
    wire_us = staticmethod(syslink_us)

    def __init__(self, library: Path, folder: Path) -> None:
        self._library, self._folder, self._boots = library, folder, 0

    def flashed_with(self, flash: bytes) -> "AppBoard":
        return self

    def boot(self, start: PowerOn) -> "AppFirmware":
        self._boots += 1
        return AppFirmware(App(self._library, self._folder / f"{self._boots}.so"), start.board)


class AppFirmware:
    """The app that has booted, stepped with every sample of the IMU, which has its own gyro."""

    flashed = scheduler = usage = clock_us = mavlink = flight_tasks = None
    overrun = ""
    variables = ()

    def __init__(self, app: App, board: Board) -> None:
        self.app, self.now_us, self.kernel = app, 0, self
        self._board = board
        self._state = ""
        self._waiting: deque[bytes] = deque()
        app.boot()

    def advance(self, now_us: int) -> None:
        self.now_us = now_us

    def run(self, now_us: int, until_us: int = 0) -> None:
        self.now_us = now_us

    def stop_before(self, us: int) -> None:
        pass

    def radio_received(self, data: bytes, broadcast: bool = False) -> None:
        self.app.radio(data[1:], data[0] >> 4, data[0] & 3)
        self._transmit()

    def radio_polled(self) -> None:
        pass

    def imu_ready(self) -> None:
        self.app.step(self.now_us // STEP_US)
        supervisor = self.app.supervisor
        state = f"state {State(supervisor.state).name} {Cause(supervisor.cause).name}"
        if state != self._state:
            print(state, flush=True)
        self._state = state
        self._transmit()

    def _transmit(self) -> None:
        while packet := self.app.sent():
            self._waiting.append(packet)
        while self._waiting and self._board.radio_send(self._waiting[0]):
            self._waiting.popleft()


def main(library: str, *overrides: str) -> None:
    """Serve for ever."""
    clock, config = Paced(), load_config(overrides=overrides)
    lab = Laboratory(clock)
    with tempfile.TemporaryDirectory() as folder:
        board = AppBoard(Path(library), Path(folder))
        site = Site(config, lab.events, Streams.of_seed(1), lambda source, text: None, board)
        served = ServedRobot(1, site, print)
        served.robot.body.hold()
        served.robot.watch(0)
        lab.add(served.robot)
        print("use", f"{VARIABLE}=127.0.0.1:{served.serve_radio(0, clock.readers)}")
        print("udp", served.serve_udp(0, clock.readers))
        print("radio", served.uri)
        print("serving", flush=True)
        lab.end_at(NEVER_US)
        lab.run()


@contextmanager
def board(library: Path, *overrides: str) -> Iterator[Served]:
    """A running board on a free port."""
    process = subprocess.Popen(
        [sys.executable, "-m", "support.app_board", str(library), *overrides], stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, env={**os.environ, "PYTHONPATH": str(TESTS)},
    )  # fmt: skip
    served = Served(process)
    try:
        served.wait_for("^serving", PATIENCE_S)
        yield served
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
