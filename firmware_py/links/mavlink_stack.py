"""MAVLink on board: from the UART interrupt to the services and back.

Uplink: UART interrupt -> MAV-RX, which finds the frames and runs a handler for each message.
Downlink: services -> transmit queue (32) -> MAV-TX -> UART. Replies may fill the queue; unrequested messages leave
room for them and are dropped and counted when the line is too slow. MAV-TX alone makes frames, so that their
sequence numbers are sent in order.

No request is ignored silently: refused and unserved messages are reported in a STATUSTEXT per kind and sender.
"""

from collections.abc import Callable, Generator, Iterable

from firmware_py.board import Board
from firmware_py.config import CpuConfig, MavlinkConfig
from firmware_py.links.console import Notices
from firmware_py.rtos import Kernel, Queue
from firmware_py.rtos.tables import GO_ON
from firmware_py.wire import WireError, mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import NUMBERS, Message, sender_of
from firmware_py.wire.mavlink_frames import FrameReceiver, FrameSender, Signing

Task = Generator[int, None, None]
Handler = Callable[[Message], object]

TRANSMIT_QUEUE = 32
UNASKED_LIMIT = 24  # messages in the queue beyond which nothing is sent unasked
BACKLOG = 4  # messages in the queue at which streams wait for their turn
SILENCE_TICKS = 50  # after which MAV-RX has the receiver search half a frame again

SILENCE_US = 3_000_000  # three heartbeats of a ground station
INFO, WARNING = 6, 4  # MAV_SEVERITY
NOTICES = 64  # kinds and senders that are distinguished


class MavlinkStack:
    """Creates the tasks and the queue of the link on a kernel; services are added before the scheduler starts."""

    def __init__(self, kernel: Kernel, cost: CpuConfig, config: MavlinkConfig, board: Board) -> None:
        self.kernel = kernel
        self.system = config.system
        self.component = config.component
        self.refused = 0  # messages that a service refused
        self.unserved = 0  # messages that no service reads, or that are for other systems
        self._heard_us = 0  # when a message was last received
        # Unrequested messages that the line was too slow for, and messages that fit no frame.
        self.unsent = 0
        self._cost_us = cost.mavlink_us
        self._board = board
        signing = Signing(bytes.fromhex(config.signing_key)) if config.signing_key else None
        self._receiver = FrameReceiver(signing)
        self._sender = FrameSender(config.system, config.component, signing)
        self.counters = self._receiver.counters
        self._handlers: dict[int, Handler] = {}
        self._received = kernel.create_binary_semaphore("uartReady")
        self._transmit: Queue[Message] = kernel.create_queue(TRANSMIT_QUEUE, "mavTx")
        self._notices = Notices(kernel, self._warn)
        self._noticed: set[str] = set()
        self._texts = 0  # sent
        self._paced: Message | None = None
        self._paced_sent = kernel.create_binary_semaphore("mavPaced")
        kernel.create_task("MAV-RX", 2, self._receive_task)
        kernel.create_task("MAV-TX", 2, self._transmit_task)

    @property
    def dropped(self) -> int:
        """Messages that the line was too slow for, or that fit no frame."""
        return self.unsent + self._transmit.dropped

    @property
    def overruns(self) -> int:
        """Bytes that the UART lost because they were not read in time."""
        return self._board.uart_overruns

    @property
    def connected(self) -> bool:
        """Whether a message was received lately."""
        return self.kernel.now_us - self._heard_us < SILENCE_US

    def uart_ready(self) -> None:
        self._received.give_from_isr()

    def handle(self, name: str, handler: Handler) -> None:
        """Have the receiving task call `handler` for each message of this name; `WireError` refuses it."""
        self._handlers[NUMBERS[name]] = handler

    def reply(self, message: Message) -> None:
        """Queue a message that was requested. A plain call, for handlers; dropped when the queue is full."""
        self._transmit.send_nowait(message)

    @property
    def room(self) -> int:
        """How many messages of streams the queue takes: none until it is nearly empty, so that answers are fast."""
        waiting = len(self._transmit)
        return UNASKED_LIMIT - waiting if waiting < BACKLOG else 0

    def offer(self, message: Message) -> Iterable[int]:
        """Queue a message that was not requested, if the line has time for it."""
        if len(self._transmit) >= UNASKED_LIMIT:
            self.unsent += 1
            return GO_ON
        return self._transmit.send_nowait(message)

    def notice(self, message: Message, text: str) -> None:
        """Report why a message was refused: once per kind and sender, then now and then with a count."""
        source = "{}/{}".format(*sender_of(message))
        kind = f"{source} {''.join(filter(str.isalpha, text))}"  # without its numbers
        if kind not in self._noticed:
            if len(self._noticed) == NOTICES:
                kind, text = "others", "requests of further kinds or senders refused"
            else:
                self._noticed.add(kind)
        self._notices.refuse(kind, text)

    def _warn(self, line: str) -> None:
        if len(self._transmit) < UNASKED_LIMIT:
            self.report(WARNING, line)

    def deliver(self, message: Message) -> Task:
        """Queue one of many messages and wait until the line has taken it; for use by one task only."""
        self._paced = message
        yield from self._transmit.send(message)
        yield from self._paced_sent.take()

    def console_line(self, line: str) -> None:
        """Send a line of the console as STATUSTEXT."""
        self.report(WARNING if "failsafe" in line else INFO, line)

    def report(self, severity: int, line: str) -> None:
        """Send a line to the operators as STATUSTEXT."""
        self._texts = self._texts % 0xFFFF + 1
        for message in services.status_text(severity, line, self._texts):
            self.reply(message)

    def _receive_task(self) -> Task:
        kernel, receiver, board = self.kernel, self._receiver, self._board
        while True:
            yield from self._received.take(SILENCE_TICKS)
            for message in receiver.feed(kernel.now_us, board.uart_read()):
                yield from kernel.work(self._cost_us)
                self._dispatch(message)
                yield from kernel.yield_if_pending()

    def _dispatch(self, message: Message) -> None:
        if sender_of(message) == (self.system, self.component):
            return  # an echo of our own
        self._heard_us = self.kernel.now_us
        handler = self._handlers.get(message.get_msgId())
        if handler is None or not self._is_ours(message):
            self.unserved += 1
            if handler is None and message.get_type() not in mavlink.ENDS and self._is_request(message):
                self.notice(message, f"{message.get_type()} is not served")
            return
        try:
            handler(message)
        except WireError as error:
            self.refused += 1
            self.notice(message, str(error))

    def _is_ours(self, message: Message) -> bool:
        """Return whether this board is addressed; 0 means all."""
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        return system in (0, self.system) and component in (0, self.component)

    def _is_request(self, message: Message) -> bool:
        """Return whether a message without a service is addressed to this board."""
        if hasattr(message, "target"):  # MANUAL_CONTROL
            return message.target in (0, self.system)
        return hasattr(message, "target_system") and self._is_ours(message)

    def _transmit_task(self) -> Task:
        kernel, sender, board = self.kernel, self._sender, self._board
        while True:
            message = yield from self._transmit.receive()
            if message is None:
                continue
            yield from kernel.work(self._cost_us)
            try:
                frame = sender.encode(kernel.now_us, message)
            except WireError:
                self.unsent += 1
                frame = b""
            while not board.uart_write(frame):
                yield from kernel.delay(1)
            if message is self._paced:
                yield from self._paced_sent.give()
