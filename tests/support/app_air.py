"""An app on a board of memory in the loop of a laboratory.

Board and link, with its faults, have a time line of their own. It is the wall clock, and goes on while the laboratory waits.
"""

from collections.abc import Callable

from firmware_py.wire.core_port import PORT_CORE
from hil.emulator.events import EventQueue
from support.app_packets import AppPackets
from support.crazyflie_app import App

STEP_US = 1000


class AppAir(AppPackets):
    """Requests are answered at once; what is told takes `delay_us` and up to `jitter_us` more, or is lost, each way.

    Packets keep their order. One takes `transfer_us` of the link, in which it takes no other. A laboratory `join`s it.
    """

    def __init__(
        self, app: App, delay_us: int = 3000, jitter_us: int = 0, loss: float = 0.0, drift: float = 0.0,
        transfer_us: int = 0,
    ) -> None:  # fmt: skip
        super().__init__(app)
        self.delay_us, self.jitter_us, self.loss, self.transfer_us = delay_us, jitter_us, loss, transfer_us
        self.dead = False  # the board
        self.slewed: list[int] = []
        self._period_us = round(STEP_US * (1.0 + drift))
        self._steps = 0
        self._inbox: list[bytes] = []
        self._free_us = 0
        self._arrived_us = {True: 0, False: 0}  # the last packet to the board, and from it
        self._line = EventQueue()
        self._offset_us = 0  # of the wall clock to the laboratory's time
        self._line.every(self._period_us, 500, self._step)

    def join(self, events: EventQueue) -> None:
        """Let a laboratory pass the time."""
        self._events = events

    def wall_us(self) -> int:
        self._line.run(max(self._line.now_us, self._events.now_us + self._offset_us))
        return self._line.now_us

    def late_us(self, now_us: int) -> int:
        return self.wall_us() - now_us - self._offset_us

    def shift(self, by_us: int) -> None:
        self.slewed.append(by_us)
        self._offset_us += by_us

    @property
    def ready(self) -> bool:
        return self._free_us <= self.wall_us()

    def send_any(self, packet: bytes) -> None:
        self._free_us = self.wall_us() + self.transfer_us

        def arrive(now_us: int) -> None:
            self.app.radio(packet[1:], packet[0] >> 4, packet[0] & 3)

        self._carry(arrive, True)

    def received(self, timeout_s: float = 0.0) -> list[bytes]:
        end_us = self.wall_us() + round(timeout_s * 1e6)
        while not self._inbox and self._line.next_us <= end_us:
            self._line.run(self._line.next_us)
        if not self._inbox:
            self._line.run(max(end_us, self._line.now_us))
        inbox, self._inbox = self._inbox, []
        return inbox

    def _step(self, now_us: int) -> None:
        if self.dead:
            return
        self._steps += 1
        self.app.step(self._steps)
        while packet := self.app.sent():
            assert packet[0] == PORT_CORE << 4 | 1
            self._carry(lambda now_us, packet=packet: self._inbox.append(packet), False)

    def _carry(self, arrive: Callable[[int], object], up: bool) -> None:
        lost, late = self._rng.random(2).tolist()
        if lost >= self.loss:
            way_us = self.transfer_us + self.delay_us + int(late * self.jitter_us)
            self._arrived_us[up] = max(self._arrived_us[up], self._line.now_us + way_us)
            self._line.at(self._arrived_us[up], arrive)
