"""The commanders' ports: high-level commands (8), set-points and the notice of their end (7), attitudes (3).

A command is answered with its own head and a status in the fourth byte, in the receiving task.
"""

from firmware_py.crazyflie.commander import NULL, Setpoint
from firmware_py.crazyflie.stabilizer import Stabilizer
from firmware_py.links.crtp_stack import CrtpStack, Task
from firmware_py.wire import WireError, check_size, high_level, setpoints
from firmware_py.wire.crtp import PORT_COMMANDER, PORT_GENERIC_SETPOINT, Packet


class CommanderService:
    """Hands requests to the commanders."""

    def __init__(self, stack: CrtpStack, stabilizer: Stabilizer) -> None:
        self._stack = stack
        self._stabilizer = stabilizer
        stack.handle(high_level.PORT, lambda packet: stack.answer(packet, self.answer, 0))
        stack.handle(PORT_COMMANDER, self._take_attitude)
        stack.handle(PORT_GENERIC_SETPOINT, self._take_setpoint)

    def answer(self, packet: Packet) -> tuple[bytes, ...]:
        """Execute a command and return the reply."""
        status = self._stabilizer.command(packet.data, self._stack.kernel.now_us)
        return (packet.data[:3].ljust(3, b"\0") + bytes((status,)),)

    def _take_attitude(self, packet: Packet) -> Task:
        """Take roll, pitch, yaw rate and thrust. cflib sends zeros when it disconnects."""
        if packet.channel == 0:
            check_size("an attitude set-point", packet.data, setpoints.ATTITUDE_SIZE)
            self._follow(Setpoint(other=True))
        yield from self._stack.kernel.yield_if_pending()

    def _take_setpoint(self, packet: Packet) -> Task:
        data = packet.data
        if not data:
            raise WireError("an empty set-point")
        if packet.channel == setpoints.CHANNEL_NOTICE and data[0] == 0:
            check_size("a notice", data, setpoints.NOTICE_SIZE)
            self._stabilizer.commander.relax()
        elif packet.channel == setpoints.CHANNEL_SETPOINT:
            place = setpoints.decode_place(data)
            if place is not None:
                self._follow(Setpoint(*place))
            else:
                self._follow(NULL if setpoints.is_null(data) else Setpoint(other=True))
        yield from self._stack.kernel.yield_if_pending()

    def _follow(self, setpoint: Setpoint) -> None:
        self._stabilizer.follow(setpoint, self._stack.kernel.now_us)
