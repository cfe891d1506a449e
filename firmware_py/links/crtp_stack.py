"""CRTP on board: from the radio interrupt to the services and back, with the original's queues and priorities.

Uplink: radio interrupt -> SYSLINK (queue 8) -> CRTP-RX (delivery queue 5) -> localisation service -> measurement queue.
Downlink: LOG packs the telemetry blocks every 20 ms -> transmit queue (120) -> CRTP-TX -> radio chip.
"""

from collections.abc import Callable, Generator, Sequence

from firmware_py.board import Board
from firmware_py.config import CpuConfig
from firmware_py.measurements import POSE, Measurement, PoseMeasurement
from firmware_py.rtos import Kernel, Queue
from firmware_py.wire import WireError, crtp, telemetry

Task = Generator[int, None, None]

SYSLINK_QUEUE = 8
DELIVERY_QUEUE = 5
TRANSMIT_QUEUE = 120


class CrtpStack:
    """Creates the tasks and queues of the link on a kernel.

    `read_block` returns the present values of a telemetry block, in the order of its variables.
    """

    def __init__(
        self,
        kernel: Kernel,
        cost: CpuConfig,
        board: Board,
        measurements: Queue[Measurement],
        read_block: Callable[[telemetry.Block], Sequence[float]],
    ) -> None:
        self.malformed = 0
        self._kernel = kernel
        self._cost = cost
        self._board = board
        self._measurements = measurements
        self._read_block = read_block
        self._syslink: Queue[bytes] = kernel.create_queue(SYSLINK_QUEUE, "syslink")
        self._delivery: Queue[bytes] = kernel.create_queue(DELIVERY_QUEUE, "crtpPacketDelivery")
        self._transmit: Queue[bytes] = kernel.create_queue(TRANSMIT_QUEUE, "crtpTx")
        kernel.create_task("SYSLINK", 3, self._syslink_task)
        kernel.create_task("CRTP-RX", 2, self._receive_task)
        kernel.create_task("CRTP-TX", 2, self._transmit_task)
        kernel.create_task("LOG", 1, self._log_task)

    def received(self, data: bytes) -> None:
        """Take a packet from the radio chip; called from its interrupt."""
        self._syslink.send_from_isr(data)

    def _syslink_task(self) -> Task:
        while True:
            packet = yield from self._syslink.receive()
            if packet is not None:
                yield from self._kernel.work(self._cost.syslink_us)
                yield from self._delivery.send(packet, 0)

    def _receive_task(self) -> Task:
        while True:
            data = yield from self._delivery.receive()
            if data is None:
                continue
            yield from self._kernel.work(self._cost.crtp_us)
            try:
                packet = crtp.decode(data)
                if (packet.port, packet.channel) == (crtp.PORT_LOCALISATION, crtp.CHANNEL_GENERIC):
                    pose = PoseMeasurement(self._kernel.now_us, crtp.decode_ext_pose(packet.data))
                    yield from self._measurements.send((POSE, pose), 0)
            except WireError:
                self.malformed += 1

    def _transmit_task(self) -> Task:
        while True:
            data = yield from self._transmit.receive()
            yield from self._kernel.work(self._cost.crtp_us)
            while data is not None and not self._board.radio_send(data):
                yield from self._kernel.delay(1)

    def _log_task(self) -> Task:
        wake_tick = self._kernel.tick_count
        while True:
            wake_tick += telemetry.PERIOD_MS
            yield from self._kernel.delay_until(wake_tick)
            stamp_ms = self._kernel.tick_count
            yield from self._kernel.work(self._cost.log_us)
            for block in telemetry.BLOCKS:
                packet = telemetry.encode_sample(block, stamp_ms, self._read_block(block))
                yield from self._transmit.send(packet, 0)
