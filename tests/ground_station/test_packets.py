"""Single packets over one of cflib's drivers: what is sent, what is taken, when the link is ready and when it is lost."""

from collections import deque
from queue import Queue
from typing import Any

import cflib.crtp
import pytest
from cflib.crtp.crtpstack import CRTPPacket

from firmware_py.wire.core_port import CHANNEL_CALLS, PORT_CORE
from firmware_py.wire.crtp import header
from ground_station.errors import LinkError
from ground_station.links.packets import CflibPackets

URI = "udp://127.0.0.1:9"
CALL = header(PORT_CORE, CHANNEL_CALLS)
OTHER_CHANNEL, OTHER_PORT = header(PORT_CORE, CHANNEL_CALLS + 1), header(PORT_CORE - 1, CHANNEL_CALLS)


class Driver:
    """A driver of cflib; `waiting` are packets that arrive, None a wait in vain."""

    def __init__(self, uri: str, statistics: Any, lose: Any) -> None:
        self.uri, self.lose = uri, lose
        self.sent: list[bytes] = []
        self.waiting: deque[bytes | None] = deque()
        self.waits_s: list[float] = []
        self.closed = False

    def send_packet(self, packet: CRTPPacket) -> None:
        self.sent.append(bytes((packet.header, *packet.data)))

    def receive_packet(self, wait_s: float) -> CRTPPacket | None:
        self.waits_s.append(wait_s)
        data = self.waiting.popleft() if self.waiting else None
        return None if data is None else CRTPPacket(data[0], list(data[1:]))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def packets(monkeypatch: pytest.MonkeyPatch) -> CflibPackets:
    monkeypatch.setattr(cflib.crtp, "get_link_driver", Driver)
    monkeypatch.setattr("ground_station.links.packets.clock_us", lambda: 7_000_000)
    return CflibPackets(URI)


def test_a_call_goes_to_the_core_and_only_its_answer_is_taken(packets: CflibPackets) -> None:
    driver = packets._driver
    packets.send(b"\1\2")
    packets.send_any(b"\x5d\3\4")
    assert driver.sent == [bytes((CALL, 1, 2)), b"\x5d\3\4"]
    driver.waiting += bytes((OTHER_CHANNEL, 1)), bytes((OTHER_PORT, 2)), bytes((CALL, 3, 4)), bytes((CALL, 5))
    assert [packets.receive(0.25) for _ in range(3)] == [b"\3\4", b"\5", None]
    assert driver.waits_s == [0.25] * 5
    assert packets.receive(0.0) is None
    assert len(driver.waits_s) == 5
    packets.close()
    assert driver.closed


def test_packets_of_others_leave_less_time_to_wait(
    packets: CflibPackets, monkeypatch: pytest.MonkeyPatch
) -> None:
    instants_us = iter(range(7_000_000, 9_000_000, 100_000))
    monkeypatch.setattr("ground_station.links.packets.clock_us", lambda: next(instants_us))
    packets._driver.waiting += [bytes((OTHER_PORT, 1))] * 5
    assert packets.receive(0.35) is None
    assert packets._driver.waits_s == pytest.approx([0.25, 0.15, 0.05])


def test_all_that_waits_is_taken_whole_and_only_the_first_is_waited_for(packets: CflibPackets) -> None:
    driver = packets._driver
    driver.waiting += b"\x5d\1\2", b"\x0c"
    assert packets.received(0.5) == [b"\x5d\1\2", b"\x0c"]
    assert driver.waits_s == [0.5, 0, 0]
    assert packets.received() == []


def test_a_link_is_ready_when_the_radio_has_taken_what_was_sent_and_udp_always_is(
    packets: CflibPackets,
) -> None:
    assert packets.ready
    packets._driver.out_queue = Queue()  # which cflib's radio driver has
    packets._driver.out_queue.put(b"")
    assert not packets.ready
    packets._driver.out_queue.get()
    assert packets.ready


def test_a_lost_link_is_reported_once_in_one_line(packets: CflibPackets) -> None:
    packets._driver.lose("pulled out\nTraceback ...")
    packets._driver.lose("again")
    for use in (
        packets.received, lambda: packets.receive(0.0), lambda: packets.send(b"\0"), lambda: packets.send_any(b"\0"),
    ):  # fmt: skip
        with pytest.raises(LinkError, match=r"^udp://127\.0\.0\.1:9: lost: pulled out$"):
            use()


def test_a_uri_without_a_driver_or_a_device_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise Exception("Couldn't load link driver: Cannot find a Crazyradio Dongle\n\nTraceback")

    for driver, why in (
        (lambda *_: None, "no driver for this link"),
        (fails, "Cannot find a Crazyradio Dongle"),
    ):
        monkeypatch.setattr(cflib.crtp, "get_link_driver", driver)
        with pytest.raises(LinkError) as caught:
            CflibPackets("usb://0")
        assert str(caught.value) == f"usb://0: {why}"
    for uri in ("usb://", "usb://10", "udp://127.0.0.1", "radio://0/80/3M"):
        with pytest.raises(
            LinkError, match=f"^{uri}: expected radio://.*, usb://0 or udp://127.0.0.1:19850$"
        ):
            CflibPackets(uri)
