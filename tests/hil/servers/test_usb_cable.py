"""The cable between a client and its virtual dongle: frames in any pieces, eight transfers ahead, and vendor requests."""

from typing import Any

from hil.servers.dongle_plugin import CONTROL, PAUSES, READ, WRITE, frame
from hil.servers.dongle_server import AHEAD, _UsbCable


class Ends:
    """Both ends of a cable: the client that is read or paused, and a dongle that answers when the test lets it."""

    acknowledges = True

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.requests: list[tuple[int, int, bytes]] = []
        self.packets: list[tuple[bytes, Any]] = []
        self.reads = True
        self.cable = _UsbCable(self, self, lambda now_us: now_us // 2)  # type: ignore[arg-type]

    def send(self, now_us: int, data: bytes) -> None:
        self.sent.append(data)

    def listen(self, receive: object) -> None:
        self.reads = True

    def pause(self) -> None:
        self.reads = False

    def control(self, *request: Any) -> None:
        self.requests.append(request)

    def transmit(self, now_us: int, data: bytes, answer: Any) -> None:
        self.packets.append((data, answer))


def test_eight_transfers_are_under_way_and_a_client_that_is_further_ahead_waits() -> None:
    ends = Ends()
    wanted = [bytes((0x10, number)) for number in range(3 * AHEAD)]
    stream = b"".join(frame(WRITE, number, data) for number, data in enumerate(wanted))
    for at in range(len(stream)):  # byte by byte
        ends.cable.receive(0, stream[at : at + 1])
    assert (len(ends.packets), ends.reads) == (AHEAD, False)
    for number in range(3 * AHEAD):
        ends.packets[number][1](5, bytes((number,)))
        assert len(ends.packets) == min(number + 1 + AHEAD, 3 * AHEAD)
        assert ends.reads
    assert [data for data, _ in ends.packets] == wanted
    assert ends.sent == [frame(READ, number, bytes((number,))) for number in range(3 * AHEAD)]


def test_vendor_requests_have_a_value_of_16_bits_and_pauses_are_answered() -> None:
    ends = Ends()
    for data in (b"\x01\x02", b"\x01\x02\x03", b"\x06\x07\x08rest"):
        ends.cable.receive(0, frame(CONTROL, 0, data))
    ends.cable.receive(80, frame(PAUSES, 9, b""))
    assert ends.requests == [(1, 0x0302, b""), (6, 0x0807, b"rest")]
    assert ends.sent == [frame(READ, 9, (40).to_bytes(8))]
