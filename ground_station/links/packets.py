"""Single packets to and from a board, over any link of cflib: radio, USB or UDP.

It fetches no table of contents and uses no other service of the board, so that it is ready at once.
"""

import re

import cflib.crtp
from cflib.crtp.crtpstack import CRTPPacket

from firmware_py.wire.core_port import CHANNEL_CALLS, PORT_CORE
from firmware_py.wire.crtp import header
from ground_station.clock import clock_us
from ground_station.errors import LinkError
from ground_station.links.crazyradio import URIS, first_line, start_cflib

USB = r"usb://\d"
HEADER = header(PORT_CORE, CHANNEL_CALLS)


class CflibPackets:
    """`ground_station.links.core_client.Packets` of a URI. Raises `LinkError` when there is no such link."""

    def __init__(self, uri: str) -> None:
        if not any(re.fullmatch(pattern, uri) for pattern in (*URIS, USB)):
            raise LinkError(f"{uri}: expected radio://0/80/2M/E7E7E7E7E7, usb://0 or udp://127.0.0.1:19850")
        start_cflib()
        self._uri, self._lost = uri, ""
        try:
            self._driver = cflib.crtp.get_link_driver(uri, lambda statistics: None, self._lose)
        except Exception as error:  # cflib raises bare exceptions
            raise LinkError(f"{uri}: {first_line(str(error))}") from None
        if self._driver is None:
            raise LinkError(f"{uri}: no driver for this link")

    def send(self, data: bytes) -> None:
        self._driver.send_packet(CRTPPacket(HEADER, list(data)))
        self._check()

    def receive(self, timeout_s: float) -> bytes | None:
        end_us = clock_us() + round(timeout_s * 1e6)
        while True:
            left_s = (end_us - clock_us()) * 1e-6
            packet = self._driver.receive_packet(left_s) if left_s > 0.0 else None
            self._check()
            if packet is None:
                return None
            if packet.port == PORT_CORE and packet.channel == CHANNEL_CALLS:
                return bytes(packet.data)

    @property
    def ready(self) -> bool:
        """Whether the radio has taken all earlier packets; UDP and USB take everything at once."""
        waiting = getattr(self._driver, "out_queue", None)
        return waiting is None or waiting.empty()

    def send_any(self, packet: bytes) -> None:
        """Send a whole packet of any port; waits until the link is ready."""
        self._driver.send_packet(CRTPPacket(packet[0], list(packet[1:])))
        self._check()

    def received(self, timeout_s: float = 0.0) -> list[bytes]:
        packets: list[bytes] = []
        while (packet := self._driver.receive_packet(0 if packets else timeout_s)) is not None:
            packets.append(bytes((packet.header,)) + bytes(packet.data))
        self._check()
        return packets

    def close(self) -> None:
        self._driver.close()

    def _lose(self, text: str) -> None:
        self._lost = self._lost or first_line(text)

    def _check(self) -> None:
        if self._lost:
            raise LinkError(f"{self._uri}: lost: {self._lost}")
