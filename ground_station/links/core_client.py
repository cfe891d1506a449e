"""The host's end of the core's port: it sends the requests of a batch and repeats unanswered ones, whatever is lost.

`firmware_py.wire.core_port` has the rules by which a board executes each request once. It knows no link: `packets` carries
them.
"""

from collections.abc import Iterator, Sequence
from typing import Protocol

from firmware_py.wire import WireError, core_port
from ground_station.clock import clock_us
from ground_station.errors import LinkError

Request = tuple[core_port.Message, bytes]

WINDOW = 4  # requests in flight; a board's queue has room for 5 packets, and it reboots when that overflows
FIRST_WAIT_S = 0.1  # for an answer, before requests are repeated
LONGEST_WAIT_S = 0.4
SILENCE_S = 3.0  # after which the board is given up
SESSIONS = 255
TEXTS: dict[int, str] = {
    core_port.Refusal.NO_SESSION: "it has rebooted, or another program uses it",
    core_port.Refusal.FLYING: "it may be in the air: disarm it (floaty.armed 0) and wait 5 s, or reboot it",
    core_port.Refusal.LOOP: "it flies with hardware in the loop, and executes no calls meanwhile",
    core_port.Refusal.OUTSIDE: "it refuses a request: its app is another version",
}


class Packets(Protocol):
    """Carries the data of packets on the core's port; some may be lost, doubled or late."""

    def send(self, data: bytes) -> None:
        """Send to the board; raises `LinkError`."""

    def receive(self, timeout_s: float) -> bytes | None:
        """Return the next packet within that time, else None; raises `LinkError`."""

    @property
    def ready(self) -> bool:
        """Whether nothing waits to be sent."""

    def send_any(self, packet: bytes) -> None:
        """Send a whole packet of any port; raises `LinkError`."""

    def received(self, timeout_s: float = 0.0) -> list[bytes]:
        """Return the whole packets received since the last call of this or `receive`, or the first within that time.

        Raises `LinkError`.
        """

    def close(self) -> None:
        """Close the link."""


class SilenceError(LinkError):
    """The app's port does not answer."""


class CoreClient:
    """A board's core; `begin` first. `name` is the user's name of the board. Every method raises `LinkError`."""

    def __init__(self, packets: Packets, name: str) -> None:
        self.name = name
        self.sent = 0  # packets
        self.repeated = 0  # of these
        self.packets = packets
        self._session = clock_us() % SESSIONS + 1
        self._number = 0  # of the next request

    def begin(self) -> core_port.About:
        """Begin a session, with all memory on the board zero."""
        for _ in range(SESSIONS):
            self._session, self._number = self._session % SESSIONS + 1, 0
            about = self._exchange([core_port.hello()])[0].about()
            if about.version != core_port.VERSION:
                what = f"its app has protocol version {about.version}, expected {core_port.VERSION}"
                raise LinkError(f"{self.name}: {what}: export and flash it again")
            if about.done == 0:  # otherwise that number was an earlier program's
                return about
        raise LinkError(f"{self.name}: it starts no session")

    def execute(self, requests: Sequence[Request]) -> list[core_port.CoreAnswer]:
        """Execute requests in their order, at most one of them a call; return their answers."""
        answers = self._exchange(requests)
        self._number = (self._number + len(requests)) & 0xFFFF
        return answers

    def memory(self, size: int) -> bytes:
        most = core_port.READ_MAX
        pieces = [core_port.read(offset, min(most, size - offset)) for offset in range(0, size, most)]
        return b"".join(answer.body for answer in self.execute(pieces))

    def close(self) -> None:
        self.packets.close()

    def _exchange(self, requests: Sequence[Request]) -> list[core_port.CoreAnswer]:
        answers: dict[int, core_port.CoreAnswer] = {}
        sent = begin = 0  # requests sent, and those answered without a gap
        wait_s, silent_s = FIRST_WAIT_S, 0.0
        while begin < len(requests):
            for index in range(sent, min(begin + WINDOW, len(requests))):
                self._send(requests[index], index)
                sent = index + 1
            received = self._receive(wait_s, requests)
            if received is not None:
                wait_s, silent_s = FIRST_WAIT_S, 0.0
                index, answer = received
                answers[index] = answer
                while begin in answers:
                    begin += 1
                continue
            silent_s += wait_s
            if silent_s >= SILENCE_S:
                raise SilenceError(f"{self.name}: silent for {SILENCE_S:.0f} s")
            wait_s = min(2.0 * wait_s, LONGEST_WAIT_S)
            for index in range(begin, sent):
                if index not in answers:
                    self._send(requests[index], index)
                    self.repeated += 1
        return [answers[index] for index in range(len(requests))]

    def _send(self, request: Request, index: int) -> None:
        self.sent += 1
        self.packets.send(core_port.encode_request(*request, self._session, self._number + index))

    def _receive(
        self, timeout_s: float, requests: Sequence[Request]
    ) -> tuple[int, core_port.CoreAnswer] | None:
        """Return the index of one of the requests and its answer; answers to earlier requests are skipped."""
        for data in iter(lambda: self.packets.receive(timeout_s), None):
            try:
                answer = core_port.decode_answer(data)
            except WireError:
                continue
            index = answer.number - self._number & 0xFFFF
            if answer.session != self._session or index >= len(requests):
                continue
            kind, body = requests[index]
            # A repeated HELLO is answered twice, and has the number of the first request.
            if answer.kind == core_port.Message.HELLO != kind:
                continue
            try:
                answer.check(kind, body)
            except WireError as error:
                raise LinkError(f"{self.name}: {error}") from None
            if answer.kind == core_port.Message.REFUSED:
                raise LinkError(f"{self.name}: {TEXTS.get(answer.refusal(), 'it refuses a request')}")
            return index, answer
        return None


def runs(places: Sequence[int], longest: int) -> Iterator[tuple[int, int]]:
    """Yield (offset, size) of pieces up to `longest` that cover sorted places, with small gaps."""
    begin = end = -1
    for place in places:
        if begin >= 0 and place - begin < longest:
            end = place
            continue
        if begin >= 0:
            yield begin, end + 1 - begin
        begin = end = place
    if begin >= 0:
        yield begin, end + 1 - begin
