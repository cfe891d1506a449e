"""Absolute poses from the serial line into the measurement queue; runs in the receiving task.

A pose is seen from the goal that is in force when it arrives. How old a
pose is follows from its time stamp and from the sender's clock, which is asked twice a second, faster at first. Whoever
sends poses is the partner; before the first pose, whoever sends heartbeats.
"""

from firmware_py.links.localisation import LocalisationService
from firmware_py.links.mavlink_setpoints import SetpointService
from firmware_py.links.mavlink_stack import MavlinkStack, Task
from firmware_py.links.timesync import RemoteClock
from firmware_py.measurements import POSE, Measurement
from firmware_py.rtos import Queue
from firmware_py.wire import mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.crtp import Correction
from firmware_py.wire.mavlink_frames import Message

# An older pose is of no use, so a greater age is taken as unknown.
OLDEST_US = 500_000
EARLIEST_US = -5_000  # the clocks' offset is known no better than this
# In ticks; prime, so that requests do not always collide with the frames of poses and telemetry.
SYNC_PERIOD = 487
FIRST_SYNC_PERIOD = 97
FIRST_SYNCS = 5
PATIENCE = 50  # requests after which it gives up, because some partners never answer


class PoseService:
    """`age_us` is that of the last pose when it arrived, None when it is not known."""

    def __init__(
        self,
        stack: MavlinkStack,
        measurements: Queue[Measurement],
        localisation: LocalisationService,
        setpoints: SetpointService,
    ) -> None:
        self.age_us: int | None = None
        self._stack = stack
        self._setpoints = setpoints
        self._measurements = measurements
        self._localisation = localisation
        self._partner: tuple[int, int] | None = None
        self._clock = RemoteClock()
        for name in mavlink.POSES:
            stack.handle(name, self._take_pose)
        stack.handle("HEARTBEAT", self._see_heartbeat)
        stack.handle("TIMESYNC", self._take_timesync)
        stack.kernel.create_task("MAV-SYNC", 1, self._sync_task)

    def _take_pose(self, message: Message) -> None:
        pose = mavlink.read_pose(message)
        self._meet(message)
        now_us = self._stack.kernel.now_us
        goal = self._setpoints.see_pose()
        self.age_us = self._age_us(now_us, pose.t_us)
        self._localisation.last = Correction(pose.p_WB, pose.q_WB, self.age_us)
        self._measurements.send_nowait((POSE, (now_us, self._localisation.last, True, goal)))

    def _age_us(self, now_us: int, t_us: int) -> int | None:
        """How long ago the sender's clock showed `t_us`; None when that is not known."""
        offset_us = self._clock.offset_us(now_us)
        if offset_us is None:
            return None
        age_us = now_us + offset_us - t_us
        return max(0, age_us) if EARLIEST_US <= age_us <= OLDEST_US else None

    def _see_heartbeat(self, message: Message) -> None:
        if self._partner is None:
            self._meet(message)

    def _meet(self, message: Message) -> None:
        """Let the sender of the message be the partner."""
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source != self._partner:
            self._partner, self._clock = source, RemoteClock()

    def _take_timesync(self, message: Message) -> None:
        """Answer a request; use an answer of the partner."""
        now_us = self._stack.kernel.now_us
        if message.tc1 == 0:
            self._stack.reply(services.timesync(now_us * 1000, message.ts1))
        elif (message.get_srcSystem(), message.get_srcComponent()) == self._partner:
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
