"""The core's port of an app on a board of memory: packets without a link, or with a bad one."""

from collections import deque

import numpy as np

from firmware_py.wire.core_port import PORT_CORE
from support.crazyflie_app import App


class AppPackets:
    """`ground_station.links.core_client.Packets`; each way loses, doubles and overtakes with chance `mess`."""

    ready = True

    def __init__(self, app: App, mess: float = 0.0) -> None:
        self.app = app
        self.mess = mess
        self.silent = False
        self.closed = 0
        self.services: list[bytes] = []  # what the firmware around the app would say
        self._rng = np.random.default_rng(1)
        self._up: deque[bytes] = deque()
        self._down: deque[bytes] = deque()

    def send(self, data: bytes) -> None:
        self._pass(self._up, data)
        while self._up:
            self.app.radio(self._up.popleft(), PORT_CORE, 0)
            while packet := self.app.sent():
                assert packet[0] == PORT_CORE << 4
                self._pass(self._down, packet[1:])

    def receive(self, timeout_s: float) -> bytes | None:
        return self._down.popleft() if self._down and not self.silent else None

    def send_any(self, packet: bytes) -> None:
        self.app.radio(packet[1:], packet[0] >> 4, packet[0] & 3)

    def received(self, timeout_s: float = 0.0) -> list[bytes]:
        return self.services

    def close(self) -> None:
        self.closed += 1

    def _pass(self, queue: deque[bytes], data: bytes) -> None:
        lost, doubled, overtakes = (self._rng.random(3) < self.mess).tolist()
        copies = [data] * ((not lost) + doubled)
        queue.extendleft(copies) if overtakes else queue.extend(copies)
