"""Poses from outside into the measurement queue, and the emergency stop; runs in the receiving task.

Packed poses are taken when they carry the last byte of the board's radio address.
The pilot adds the goal of each pose.
"""

from firmware_py.crazyflie.supervisor import Supervisor
from firmware_py.links.crtp_stack import CrtpStack, Task
from firmware_py.pilot import Arrived, Pilot
from firmware_py.rtos import Queue
from firmware_py.wire import WireError, crtp, localisation
from firmware_py.wire.crtp import Correction, Packet


class LocalisationService:
    """`address` is the last byte of the radio address."""

    def __init__(
        self,
        stack: CrtpStack,
        measurements: Queue[Arrived],
        supervisor: Supervisor,
        pilot: Pilot,
        address: int,
    ) -> None:
        self._stack = stack
        self._measurements = measurements
        self._supervisor = supervisor
        self._pilot = pilot
        self._address = address
        stack.handle(crtp.PORT_LOCALISATION, self._handle)

    def take_pose(self, data: bytes) -> Task:
        """Take the bytes of one pose, from whatever channel. Raises `WireError`."""
        yield from self._measure(self._stack.kernel.now_us, crtp.decode_ext_pose(data))

    def _handle(self, packet: Packet) -> Task:
        data, now_us = packet.data, self._stack.kernel.now_us
        kind = data[0] if data else -1
        if packet.channel in localisation.POSITIONS:
            return  # no pose without an attitude
        if packet.channel != crtp.CHANNEL_GENERIC:
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
            yield from self.take_pose(data)
        else:
            raise WireError(f"localisation packet {data.hex()}: unknown type")

    def _measure(self, now_us: int, pose: Correction) -> Task:
        yield from self._measurements.send(self._pilot.measured(pose, now_us), 0)
