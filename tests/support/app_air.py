"""An app on a board of memory in the loop of a laboratory: both on one time line, the link between them with its faults."""

from firmware_py.wire.core_port import PORT_CORE
from hil.events import EventQueue
from support.app_packets import AppPackets
from support.crazyflie_app import App

STEP_US = 1000


class AppAir(AppPackets):
    """Requests are answered at once; what is told takes `delay_us` and up to `jitter_us` more, or is lost, each way."""

    def __init__(
        self, app: App, delay_us: int = 3000, jitter_us: int = 0, loss: float = 0.0, drift: float = 0.0
    ) -> None:
        super().__init__(app)
        self.delay_us, self.jitter_us, self.loss = delay_us, jitter_us, loss
        self.standing = False  # the host
        self.dead = False  # the board
        self._period_us = round(STEP_US * (1.0 + drift))
        self._steps = 0
        self.slewed: list[int] = []
        self._inbox: list[bytes] = []

    def join(self, events: EventQueue) -> None:
        """Let the board live on a time line."""
        self.events = events
        self._next_us = 500
        events.at(self._next_us, self._step)

    def slew(self, by_us: int) -> None:
        """Let the host's time be later: on its time line the board's is earlier."""
        self.slewed.append(by_us)
        self._next_us -= by_us

    def tell(self, packet: bytes) -> None:
        self._carry(lambda now_us: self.app.radio(packet[1:], packet[0] >> 4, packet[0] & 3))

    def told(self) -> list[bytes]:
        inbox, self._inbox = self._inbox, []
        return inbox

    def _step(self, now_us: int) -> None:
        if self.dead:
            return
        self._next_us += self._period_us
        self.events.at(max(self._next_us, now_us), self._step)
        self._steps += 1
        self.app.step(self._steps)
        while packet := self.app.sent():
            assert packet[0] == PORT_CORE << 4 | 1
            self._carry(lambda now_us, packet=packet: self._inbox.append(packet))

    def _carry(self, arrive: object) -> None:
        lost, late = self._rng.random(2).tolist()
        if lost >= self.loss:
            self.events.at(self.events.now_us + self.delay_us + int(late * self.jitter_us), arrive)
