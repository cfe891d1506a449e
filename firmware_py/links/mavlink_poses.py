"""Absolute poses from the serial line into the measurement queue; runs in the receiving task.

A pose is compared with the goal that is in force when it arrives. Its age follows from its time stamp and from the
sender's clock, which is requested twice a second, faster at first. The sender of poses is the partner; before the first
pose, the sender of heartbeats.

The offset of the partner's clock from ours follows from exchanges of time stamps, in whole microseconds. We send our
time, the other side returns it with its own. The remote instant is somewhere in the round trip, so an exchange
gives the offset to plus or minus half of its round trip, and less well as it grows old, because clocks drift. Of the
last exchanges the most certain one counts. When two exchanges contradict each other, the remote clock was set
again, and only the newer one counts.
"""

from collections import deque
from dataclasses import dataclass
from math import dist

from firmware_py.links.mavlink_setpoints import SetpointService
from firmware_py.links.mavlink_stack import MavlinkStack, Task
from firmware_py.pilot import Arrived
from firmware_py.rtos import Queue
from firmware_py.wire import mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.crtp import Correction
from firmware_py.wire.mavlink_dialect import Message, sender_of

WINDOW = 16  # exchanges
DRIFT_PPM = 100  # of both clocks together: two crystals of 50 ppm
PENDING = 4  # requests that may be unanswered
LONGEST_US = 200_000  # round trip; a longer one is too uncertain
UNKNOWN_US = 100_000  # an offset that is less certain counts as unknown
SLACK_US = 1000  # some senders stamp in whole milliseconds


@dataclass(frozen=True, slots=True)
class TimeExchange:
    t_us: int  # when it arrived, our clock
    offset_us: int  # remote clock less ours
    half_us: int  # half of the round trip

    def uncertainty_us(self, now_us: int) -> int:
        """Return how wrong the offset may be by now; all exchanges age alike."""
        return self.half_us + (now_us - self.t_us) * DRIFT_PPM // 1_000_000


class RemoteClock:
    """The clock of one partner. `exchanges` counts the useful answers."""

    def __init__(self) -> None:
        self.requests = 0
        self.exchanges = 0
        self._pending: deque[int] = deque(maxlen=PENDING)
        self._window: deque[TimeExchange] = deque(maxlen=WINDOW)
        self._best: TimeExchange | None = None

    def request(self, now_us: int) -> None:
        """Note that a request is sent now."""
        self.requests += 1
        self._pending.append(now_us)

    def answer(self, now_us: int, sent_us: int, remote_us: int) -> bool:
        """Take the answer to the request of `sent_us`; False when there was no such request, or when it took too long."""
        if sent_us not in self._pending:
            return False
        self._pending.remove(sent_us)
        round_trip_us = now_us - sent_us
        if round_trip_us > LONGEST_US:
            return False
        exchange = TimeExchange(now_us, remote_us - (sent_us + now_us) // 2, round_trip_us // 2)
        if any(_contradict(old, exchange) for old in self._window):
            self._window.clear()
        self._window.append(exchange)
        self._best = min(self._window, key=lambda old: old.uncertainty_us(now_us))
        self.exchanges += 1
        return True

    def offset_us(self, now_us: int) -> int | None:
        """Return how far the remote clock is ahead; None when unknown."""
        best = self._best
        return None if best is None or best.uncertainty_us(now_us) > UNKNOWN_US else best.offset_us


def _contradict(old: TimeExchange, new: TimeExchange) -> bool:
    """Return whether no clock that ran undisturbed explains both."""
    reach_us = new.half_us + old.uncertainty_us(new.t_us) + SLACK_US
    return abs(new.offset_us - old.offset_us) > reach_us


# An older pose is useless, so a greater age counts as unknown.
OLDEST_US = 500_000
EARLIEST_US = -5_000  # the clocks' offset is no more certain than this
# In ticks; prime, so that requests do not always collide with the frames of poses and telemetry.
SYNC_PERIOD = 487
FIRST_SYNC_PERIOD = 97
FIRST_SYNCS = 5
TURNS_US = 1_000_000  # within which two senders of poses are seen
PATIENCE = 50  # requests after which it gives up, because some partners never answer


class PoseService:
    """`age_us` is that of the last pose when it arrived, None when it is not known."""

    def __init__(
        self,
        stack: MavlinkStack,
        measurements: Queue[Arrived],
        setpoints: SetpointService,
    ) -> None:
        self.age_us: int | None = None
        self._stack = stack
        self._setpoints = setpoints
        self._measurements = measurements
        self._partner: tuple[int, int] | None = None
        self._clock = RemoteClock()
        self._last: dict[str, mavlink.Pose] = {}  # of the partner, by their kind
        self._posed_us: dict[tuple[int, int], int] = {}  # the last poses of senders
        for name in mavlink.POSES:
            stack.handle(name, self._take_pose)
        stack.handle("HEARTBEAT", self._see_heartbeat)
        stack.handle("TIMESYNC", self._take_timesync)
        stack.kernel.create_task("MAV-SYNC", 1, self._sync_task)

    def _take_pose(self, message: Message) -> None:
        pose = mavlink.read_pose(message)
        now_us = self._stack.kernel.now_us
        self._note_sender(message, now_us)
        self._make_partner(message)
        self._follow_frame(message, pose)
        goal = self._setpoints.note_pose()
        self.age_us = self._age_us(now_us, pose.t_us)
        correction = Correction(pose.p_WB, pose.q_WB, self.age_us)
        self._measurements.send_nowait((now_us, correction, True, goal))

    def _note_sender(self, message: Message, now_us: int) -> None:
        """Report poses of two senders in turn: the partner changes with each, and no clock becomes known."""
        sender = sender_of(message)
        recent = {one: t_us for one, t_us in self._posed_us.items() if now_us - t_us < TURNS_US}
        turns = sender != self._partner and self._partner in recent and sender in recent
        if turns and sender == min(recent):  # one line for all of them
            senders = " and ".join(f"{system}/{component}" for system, component in sorted(recent))
            self._stack.notice(message, f"poses of {senders} in turn: their age stays unknown")
        self._posed_us = {**recent, sender: now_us}

    def _follow_frame(self, message: Message, pose: mavlink.Pose) -> None:
        """Move the goal with the frame of the poses, where the partner has moved that since its last one of this kind."""
        kind = message.get_type()
        last = self._last.get(kind, pose)
        self._last[kind] = pose
        if pose.frame != last.frame:
            self._setpoints.follow_frame(last, pose)
            moved = dist(last.p_WB, pose.p_WB)
            self._stack.notice(
                message, f"poses: their frame has moved by {moved:.2f} m, and the goal with it"
            )

    def _age_us(self, now_us: int, t_us: int) -> int | None:
        """Return how long ago the sender's clock showed `t_us`; None when unknown."""
        offset_us = self._clock.offset_us(now_us)
        if offset_us is None:
            return None
        age_us = now_us + offset_us - t_us
        return max(0, age_us) if EARLIEST_US <= age_us <= OLDEST_US else None

    def _see_heartbeat(self, message: Message) -> None:
        if self._partner is None:
            self._make_partner(message)

    def _make_partner(self, message: Message) -> None:
        """Make the sender of the message the partner."""
        if (sender := sender_of(message)) != self._partner:
            self._partner, self._clock, self._last = sender, RemoteClock(), {}

    def _take_timesync(self, message: Message) -> None:
        """Answer a request; use an answer of the partner."""
        now_us = self._stack.kernel.now_us
        if message.tc1 == 0:
            self._stack.reply(services.timesync_answer(now_us * 1000, message))
        elif sender_of(message) == self._partner:
            self._clock.answer(now_us, message.ts1 // 1000, message.tc1 // 1000)

    def _sync_task(self) -> Task:
        """Ask the partner for its time."""
        kernel = self._stack.kernel
        wake_tick = kernel.tick_count
        while True:
            begins = self._clock.exchanges < FIRST_SYNCS and self._clock.requests < PATIENCE
            wake_tick += FIRST_SYNC_PERIOD if begins else SYNC_PERIOD
            yield from kernel.delay_until(wake_tick)
            if self._partner is not None:
                self._clock.request(kernel.now_us)
                yield from self._stack.offer(services.timesync(0, kernel.now_us * 1000))
