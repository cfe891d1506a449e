"""CRTP on board: from the radio interrupt to the services and back, with the original's queues and priorities.

Uplink: radio interrupt -> SYSLINK (queue 8) -> CRTP-RX (delivery queue 5) -> a handler, or the queue of a port.
Downlink: services -> transmit queue (120) -> CRTP-TX -> radio chip.
Replies of the services' own tasks wait for space in the transmit queue. Unrequested packets, and answers of the receiving
task itself, are dropped when the queue is full: a deaf partner must not keep poses from coming in.
When the radio chip has received nothing for a second, not even an empty poll, the partner is gone, as in the Crazyflie
firmware: services that send unasked then stop and discard their queue (`hang_up`), so that the next partner gets no old
rows.
"""

from collections.abc import Callable, Generator
from typing import Final

from firmware_py.board import Board
from firmware_py.config import CpuConfig
from firmware_py.rtos import FOREVER, Kernel, Queue
from firmware_py.wire import WireError, crtp
from firmware_py.wire.crtp import Packet

Task = Generator[int, None, None]
Handler = Callable[[Packet], Task]
# From a request to the data of its replies, on the same port and channel.
Answer = Callable[[Packet], tuple[bytes, ...]]

SYSLINK_QUEUE = 8
DELIVERY_QUEUE = 5
TRANSMIT_QUEUE = 120
PORT_QUEUE = 16  # Crazyflie firmware
SILENCE_US: Final = 1_000_000  # Crazyflie firmware: RADIO_ACTIVITY_TIMEOUT_MS


class CrtpStack:
    """Creates the tasks and queues of the link on a kernel; services are added before the scheduler starts."""

    def __init__(self, kernel: Kernel, cost: CpuConfig, board: Board) -> None:
        self.kernel = kernel
        self.cost = cost
        self.malformed = 0  # packets that no service could read
        self.unserved = 0  # well-formed packets to ports without a service
        self.unicasts = 0  # packets to this board
        self.broadcasts = 0  # packets to all boards
        # When the radio chip last received anything.
        self._heard_us = 0
        self._board = board
        self._handlers: dict[int, Handler] = {}
        self._ports: dict[int, Queue[Packet]] = {}
        self._syslink: Queue[bytes] = kernel.create_queue(SYSLINK_QUEUE, "syslink")
        self._delivery: Queue[bytes] = kernel.create_queue(DELIVERY_QUEUE, "crtpPacketDelivery")
        self._transmit: Queue[bytes] = kernel.create_queue(TRANSMIT_QUEUE, "crtpTx")
        kernel.create_task("SYSLINK", 3, self._syslink_task)
        kernel.create_task("CRTP-RX", 2, self._receive_task)
        kernel.create_task("CRTP-TX", 2, self._transmit_task)

    @property
    def dropped(self) -> int:
        """Packets that found a queue of the link full, in either direction."""
        link = self._syslink.dropped + self._delivery.dropped + self._transmit.dropped
        return link + sum(queue.dropped for queue in self._ports.values())

    @property
    def connected(self) -> bool:
        """Whether anything was received within the last second."""
        return self.kernel.now_us - self._heard_us < SILENCE_US

    def received(self, data: bytes, broadcast: bool = False) -> None:
        """Take a packet from the radio chip; called from its interrupt."""
        self._heard_us = self.kernel.now_us
        if self._syslink.send_from_isr(data):
            self.broadcasts += broadcast
            self.unicasts += not broadcast

    def polled(self) -> None:
        """Note that the radio chip has received an empty packet; called from its interrupt."""
        self._heard_us = self.kernel.now_us

    def hang_up(self) -> Task:
        """Discard the packets queued for sending."""
        yield from self._transmit.reset()

    def handle(self, port: int, handler: Handler) -> None:
        """Have the receiving task run `handler` for each packet of the port; it must not wait."""
        self._handlers[port] = handler

    def open_port(self, port: int) -> Queue[Packet]:
        """Return the queue into which the receiving task puts the packets of the port."""
        self._ports[port] = self.kernel.create_queue(PORT_QUEUE, f"port{port}")
        return self._ports[port]

    def serve(self, name: str, priority: int, port: int, answer: Answer) -> None:
        """Create a task that answers each packet of a port; `answer` raises `WireError` for malformed ones."""
        self.kernel.create_task(name, priority, self._service_task, self.open_port(port), answer)

    def answer(self, packet: Packet, answer: Answer, timeout: int = FOREVER) -> Task:
        """Answer one packet; its replies wait up to `timeout` ticks for space."""
        yield from self.kernel.work(self.cost.crtp_us)
        try:
            replies = answer(packet)
        except WireError:
            self.malformed += 1
            return
        yield from self.kernel.yield_if_pending()
        for data in replies:
            reply = crtp.encode(Packet(packet.port, packet.channel, data))
            yield from self._transmit.send(reply, timeout)

    def offer(self, data: bytes) -> Generator[int, None, bool]:
        """Queue a complete packet that was not requested; False when it was dropped."""
        return self._transmit.send(data, 0)

    def deliver(self, data: bytes) -> Generator[int, None, bool]:
        """Queue a complete packet as soon as there is space."""
        return self._transmit.send(data)

    def _syslink_task(self) -> Task:
        while True:
            packet = yield from self._syslink.receive()
            if packet is not None:
                yield from self.kernel.work(self.cost.syslink_us)
                yield from self._delivery.send(packet, 0)

    def _receive_task(self) -> Task:
        while True:
            data = yield from self._delivery.receive()
            if data is None:
                continue
            yield from self.kernel.work(self.cost.crtp_us)
            try:
                packet = crtp.decode(data)
                handler = self._handlers.get(packet.port)
                if handler is not None:
                    yield from handler(packet)
                elif packet.port in self._ports:
                    yield from self._ports[packet.port].send(packet, 0)
                else:
                    self.unserved += 1
            except WireError:
                self.malformed += 1

    def _service_task(self, requests: Queue[Packet], answer: Answer) -> Task:
        while True:
            packet = yield from requests.receive()
            if packet is not None:
                yield from self.answer(packet, answer)

    def _transmit_task(self) -> Task:
        while True:
            data = yield from self._transmit.receive()
            yield from self.kernel.work(self.cost.crtp_us)
            while data is not None and not self._board.radio_send(data):
                yield from self.kernel.delay(1)
