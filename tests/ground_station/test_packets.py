"""Single packets over cflib's drivers, to a UDP port where nobody answers."""

from queue import Queue

import pytest

from ground_station.errors import LinkError
from ground_station.links.packets import CflibPackets

pytestmark = pytest.mark.long  # cflib takes a second to close a port


def test_a_link_is_ready_when_the_radio_has_taken_what_was_sent_and_udp_always_is() -> None:
    packets = CflibPackets("udp://127.0.0.1:9")
    assert packets.ready
    packets._driver.out_queue = Queue()  # which cflib's radio driver has
    packets._driver.out_queue.put(b"")
    assert not packets.ready
    packets._driver.out_queue.get()
    assert packets.ready
    packets.close()


def test_a_lost_link_is_reported_once_in_one_line() -> None:
    packets = CflibPackets("udp://127.0.0.1:9")
    packets._lose("pulled out\nTraceback ...")
    packets._lose("again")
    for use in (packets.received, lambda: packets.receive(0.0), lambda: packets.send(b"\0")):
        with pytest.raises(LinkError, match=r"^udp://127\.0\.0\.1:9: lost: pulled out$"):
            use()
    packets.close()
