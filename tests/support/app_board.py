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
from types import SimpleNamespace

from firmware_py.board import EEPROM_SIZE
from firmware_py.wire.supervisor import Cause, State
from hil.clock import Paced
from hil.config import LabConfig, load_config
from hil.devices.shockburst import Air, syslink_us
from hil.events import EventQueue
from hil.laboratory.laboratory import NEVER_US, Laboratory
from hil.laboratory.robot import Streams
from hil.servers.dongle_plugin import VARIABLE
from hil.servers.served_robot import ServedRobot
from hil.servers.server import Ends
from support.crazyflie_app import App
from support.paths import TESTS
from support.serving import START_TIMEOUT_S, Served

STEP_US = 1000
TRANSMIT_PERIOD_US = 1000  # in which the firmware tries again when its radio chip takes nothing


class AppRobot:
    """What `ServedRobot` and `Laboratory` need of a robot, with the app in it and nothing around it."""

    uart = firmware = None
    polled_by_host = executes_image = False
    wire_us = staticmethod(syslink_us)
    next_wake_us = None

    def __init__(self, library: Path, folder: Path, events: EventQueue, config: LabConfig) -> None:
        self.config, self.events, self.air = config, events, Air.of(config.radio)
        self.board = SimpleNamespace(eeprom=bytearray(b"\xff" * EEPROM_SIZE), battery_mv=3900)
        self.powered = False
        self._library, self._folder = library, folder
        self._boots = self._booted_us = 0
        self._state = ""
        self._waiting: deque[bytes] = deque()
        events.every(STEP_US, STEP_US, self._step)

    def boot(self, now_us: int) -> None:
        self._boots += 1
        self._booted_us = now_us
        self.powered = True
        self.app = App(self._library, self._folder / f"{self._boots}.so")
        self.app.boot()
        self._waiting.clear()

    def cut_power(self) -> None:
        self.powered = False

    def packet_received(self, now_us: int, data: bytes, broadcast: bool = False) -> None:
        if self.powered:
            self.app.radio(data[1:], data[0] >> 4, data[0] & 3)
            self._transmit(now_us)

    def polled(self, now_us: int) -> None:
        pass

    def run(self, now_us: int) -> None:
        pass

    def advance(self, now_us: int) -> None:
        pass

    def _step(self, now_us: int) -> None:
        if self.powered:
            self.app.step((now_us - self._booted_us) // STEP_US)
            supervisor = self.app.supervisor
            state = f"state {State(supervisor.state).name} {Cause(supervisor.cause).name}"
            if state != self._state:
                print(state, flush=True)
            self._state = state
            self._transmit(now_us)

    def _transmit(self, now_us: int) -> None:
        while packet := self.app.sent():
            self._waiting.append(packet)
        while self._waiting and self.send_packet(now_us, self._waiting[0]):
            self._waiting.popleft()


def main(library: str, *overrides: str) -> None:
    """Serve for ever."""
    clock, config = Paced(), load_config(overrides=overrides)
    lab = Laboratory(clock)
    with tempfile.TemporaryDirectory() as folder:
        robot = AppRobot(Path(library), Path(folder), lab.events, config)
        served = ServedRobot(1, robot, Streams.of_seed(1).radio, print)
        ends = Ends(lab, clock.readers, config, 1)
        ends.robots.append(served)
        lab.robots.append(robot)
        print("use", f"{VARIABLE}={ends.serve_radio(0)}")
        print("udp", *ends.serve_udp(0))
        print("radio", served.uri)
        print("serving", flush=True)
        lab.end_us = NEVER_US
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
        served.wait_for("^serving", START_TIMEOUT_S)
        yield served
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
