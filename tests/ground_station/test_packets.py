"""Single packets over cflib's drivers, to a UDP port where nobody answers."""

import threading

import pytest

from ground_station.errors import LinkError
from ground_station.links.packets import TOLD_WAITING, CflibPackets

pytestmark = pytest.mark.long  # cflib takes a second to close a port


def test_a_link_that_is_too_slow_drops_what_is_told_instead_of_falling_behind() -> None:
    packets = CflibPackets("udp://127.0.0.1:9")
    may_go, sent = threading.Event(), []
    packets._driver.send_packet = lambda packet: (may_go.wait(10.0), sent.append(bytes(packet.data)))
    for number in range(100):
        packets.tell(bytes((0xA1, number)))
    may_go.set()
    packets.close()
    assert len(sent) in (TOLD_WAITING, TOLD_WAITING + 1)
    assert sent == [bytes((number,)) for number in range(len(sent))]


def test_a_lost_link_is_said_once_and_for_all_in_one_line() -> None:
    packets = CflibPackets("udp://127.0.0.1:9")
    packets._lose("pulled out\nTraceback ...")
    packets._lose("again")
    for use in (packets.told, lambda: packets.receive(0.0), lambda: packets.send(b"\0")):
        with pytest.raises(LinkError, match=r"^udp://127\.0\.0\.1:9: lost: pulled out$"):
            use()
    packets.close()
