"""What a table of contents costs a host at the virtual Crazyradio: exchanges and simulated time per element.

The host here takes no time itself and polls as cflib does, with safelink.
"""

from hil.clock import FreeRunning
from hil.config import load_config
from hil.servers.server import Server

LOSSLESS = ("radio.uplink_loss=0", "radio.downlink_loss=0")
STEP_US = 10
SAFELINK, NULL = b"\xff\x05\x01", b"\xff"
LOG_TOC, ELEMENT = 0x5C, 2


class Host:
    """A host without software: the next transfer begins when the last one has ended."""

    def __init__(self) -> None:
        server = Server(load_config("floaty", LOSSLESS), 1, 1, lambda line: None)
        self.lab = server.lab
        self.lab.clock = FreeRunning()
        self._dongle = server.ends._new_dongle()
        self._dongle.control(0x01, 80, b"")
        self.exchanges = 0
        self._up = self._down = 0
        self._run(2_000_000)
        assert self._transfer(SAFELINK)[1:] == SAFELINK

    def _run(self, duration_us: int) -> None:
        self.lab.end_us = self.lab.now_us + duration_us
        self.lab.run()

    def _transfer(self, data: bytes) -> bytes:
        answers: list[bytes] = []
        self._dongle.transmit(self.lab.now_us, data, lambda now_us, answer: answers.append(answer))
        while not answers:
            self._run(STEP_US)
        return answers[0]

    def exchange(self, data: bytes) -> bytes:
        """Send a packet and return what the board's acknowledgement carries."""
        self.exchanges += 1
        header = data[0] & 0xF3 | self._up << 3 | self._down << 2
        status, *answer = self._transfer(bytes((header,)) + data[1:])
        assert status & 1
        self._up ^= 1
        if answer and answer[0] >> 2 & 1 == self._down:
            self._down ^= 1
        return bytes(answer)

    def element(self, number: int) -> bytes:
        """Ask for an element of the log table and poll until it comes."""
        answer = self.exchange(bytes((LOG_TOC, ELEMENT, number, 0)))
        while answer[:1] == b"" or answer[0] >> 4 != LOG_TOC >> 4 or answer[2] != number:
            answer = self.exchange(NULL)
        return answer


def test_an_element_of_a_table_takes_a_host_about_two_exchanges_and_less_than_1500_us() -> None:
    host = Host()
    for number in range(5):
        host.element(number)
    host.exchanges, begin_us = 0, host.lab.now_us
    names = {host.element(number)[5:] for number in range(5, 105)}
    assert len(names) == 100
    assert host.exchanges < 2.2 * len(names)
    assert host.lab.now_us - begin_us < 1500 * len(names)  # with the host's share in it: 1820
