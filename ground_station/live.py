"""The ground station with real hardware: poses from a source, a link to a board, until it is stopped.

It reconnects when the link is lost, shows the state of the link and the age of poses, and leaves the board with its
flaps at hover: it stops the corrections first, and closes the link when the board is in failsafe.
"""

from collections.abc import Callable
from dataclasses import dataclass

from firmware_py.wire.supervisor import State
from ground_station.clock import clock_us
from ground_station.errors import LinkError
from ground_station.frame_rate import FrameRate
from ground_station.links.live_link import LiveLink
from ground_station.mocap import MocapSource
from ground_station.station import GroundStation

POSE_TIMEOUT_US = 5_000_000
RECONNECT_TIMEOUT_US = 30_000_000
RECONNECT_PERIOD_US = 500_000
STATUS_PERIOD_US = 5_000_000
FAILSAFE_TIMEOUT_US = 2_000_000


@dataclass(slots=True)
class LiveStation:
    """Runs a ground station; `say` gets lines for the user, `stopping` returns whether to end."""

    link: LiveLink
    station: GroundStation
    source: MocapSource
    rate: FrameRate
    say: Callable[[str], None]
    stopping: Callable[[], bool]
    turn: Callable[[int], None]  # called again and again with the instant while the link holds

    def run(self) -> None:
        """Fly until stopped; raises `LinkError` when there are no poses or no board."""
        self._report()
        self._connect()
        try:
            while not self.stopping():
                try:
                    self._fly()
                except LinkError as error:
                    self.say(f"{error}; connecting again")
                    self._reconnect(error)
        finally:
            self._leave()

    def _connect(self) -> None:
        self.link.open(self._serve_source)
        self.say(f"connected to {self.link.uri}")
        self._report()

    def _serve_source(self) -> bool:
        """Serve the source while the link connects; return whether to give up."""
        self._drop_waiting()
        return self.stopping()

    def _drop_waiting(self) -> None:
        """Drop the waiting frames."""
        while self.source.receive(0.0) is not None:
            pass

    def _reconnect(self, cause: LinkError) -> None:
        """Retry until it succeeds or takes too long."""
        deadline_us = clock_us() + RECONNECT_TIMEOUT_US
        self.link.close()
        while not self.stopping():
            try:
                self._connect()
                return
            except LinkError:
                if clock_us() > deadline_us:
                    raise cause from None
                again_us = clock_us() + RECONNECT_PERIOD_US
                while clock_us() < again_us:
                    self.source.receive(0.02)

    def _fly(self) -> None:
        """Forward poses and telemetry while the link holds."""
        self._drop_waiting()
        pose_us = status_us = clock_us()
        while not self.stopping():
            frame = self.source.receive(0.02)
            now_us = clock_us()
            if frame is not None:
                self.station.on_frame(frame, now_us)
                pose_us = now_us
                if notice := self.rate.on_frame(frame.t_us):
                    self.say(notice)
            elif now_us - pose_us > POSE_TIMEOUT_US:
                self.say(f"no poses for {POSE_TIMEOUT_US * 1e-6:.0f} s")
                pose_us = now_us
            self._take_telemetry()
            self.turn(now_us)
            self._report()
            self.link.check()
            if now_us - status_us >= STATUS_PERIOD_US:
                status_us = now_us
                self._show()

    def _take_telemetry(self) -> None:
        for t_us, packet in self.link.received():
            self.station.on_packet(t_us, packet)

    def _report(self) -> None:
        for notice in self.source.notices() + self.station.notices() + self.link.notices():
            self.say(notice)

    def _show(self) -> None:
        counters, tracker = self.station.counters, self.station.tracker
        track = f"track {tracker.summary()}  " if tracker is not None else ""
        self.say(
            f"poses {counters.frames} ({counters.invalid} unusable)  {self.source.summary()}  {track}"
            f"{self.link.summary()}  telemetry {counters.samples}"
        )
        self.say(str(self.station.budget))

    def _leave(self) -> None:
        """Stop correcting, wait until the board has put its flaps to hover, disconnect."""
        self.link.mute()
        deadline_us = clock_us() + FAILSAFE_TIMEOUT_US
        while clock_us() < deadline_us and self.link.supervisor_state != State.FAILSAFE:
            self.source.receive(0.02)
            self._take_telemetry()
        if self.link.supervisor_state == State.FAILSAFE:
            self.say("the board is in failsafe, flaps at hover")
        self.link.close()
