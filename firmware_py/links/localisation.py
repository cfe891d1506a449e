"""Poses from outside into the measurement queue, and the emergency stop; runs in the receiving task.

A position without attitude is counted and logged but not fused, as in the original. Packed items are taken when they
carry the last byte of the board's radio address. The pilot adds the goal of each pose.
"""

from firmware_py.crazyflie.supervisor import Supervisor
from firmware_py.links.crtp_stack import CrtpStack, Task
from firmware_py.pilot import Arrived, Pilot
from firmware_py.rtos import Queue
from firmware_py.wire import WireError, crtp, localisation
from firmware_py.wire.crtp import Correction, Packet

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


class LocalisationService:
    """`address` is the last byte of the radio address; `last` and `positions` are for the log."""

    def __init__(
        self,
        stack: CrtpStack,
        measurements: Queue[Arrived],
        supervisor: Supervisor,
        pilot: Pilot,
        address: int,
    ) -> None:
        self.last = Correction((0.0, 0.0, 0.0), UPRIGHT, None)
        self.positions = 0
        self._stack = stack
        self._measurements = measurements
        self._supervisor = supervisor
        self._pilot = pilot
        self._address = address
        stack.handle(crtp.PORT_LOCALISATION, self._handle)

    def _handle(self, packet: Packet) -> Task:
        data, now_us = packet.data, self._stack.kernel.now_us
        kind = data[0] if data else -1
        if packet.channel == localisation.CHANNEL_POSITION:
            self._see_position(localisation.decode_position(data))
        elif packet.channel == localisation.CHANNEL_PACKED:
            for address, p_GB in localisation.decode_packed_positions(data):
                if address == self._address:
                    self._see_position(p_GB)
        elif packet.channel != crtp.CHANNEL_GENERIC:
            self._stack.unserved += 1
        elif kind == localisation.EXT_POSE_PACKED:
            for address, pose in localisation.decode_packed_poses(data):
                if address == self._address:
                    yield from self._measure(now_us, pose)
        elif data == bytes((localisation.EMERGENCY_STOP,)):
            self._supervisor.stop_wanted = True
        elif data == bytes((localisation.EMERGENCY_STOP_WATCHDOG,)):
            self._supervisor.feed_watchdog(self._stack.kernel.tick_count)
        elif kind == crtp.EXT_POSE:
            yield from self._measure(now_us, crtp.decode_ext_pose(data))
        else:
            raise WireError(f"localisation packet {data.hex()}: unknown type")

    def _see_position(self, p_GB: tuple[float, float, float]) -> None:
        self.positions += 1
        self.last = Correction(p_GB, self.last.q_GB, None)

    def _measure(self, now_us: int, pose: Correction) -> Task:
        self.last = pose
        yield from self._measurements.send(self._pilot.measured(pose, now_us), 0)
