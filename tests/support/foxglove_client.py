"""A client of Foxglove's WebSocket protocol, as far as the tests need one: JSON and binary messages."""

import asyncio
import json
import struct
from typing import Any

from tornado.httpclient import HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect

PROTOCOL = "foxglove.sdk.v1"
MESSAGE = struct.Struct("<BIQ")  # operation 1, subscription, log time [ns]


def current_loop() -> IOLoop:
    """Return a new loop and make it the current one: from Python 3.12 on, asyncio does not do so by itself."""
    asyncio.set_event_loop(asyncio.new_event_loop())
    return IOLoop.current()


class FoxgloveClient:
    """Connects to a `ws://HOST:PORT`."""

    def __init__(self, address: str, **headers: str) -> None:
        self._loop = current_loop()
        request = HTTPRequest(address, headers=headers)
        try:
            self._socket = self._loop.run_sync(
                lambda: websocket_connect(request, subprotocols=[PROTOCOL]), timeout=20
            )
        except BaseException:
            self._loop.close(all_fds=True)
            raise
        self.selected = self._socket.selected_subprotocol
        self.channels: dict[str, int] = {}  # by topic
        self.described: dict[str, dict[str, str]] = {}  # without their numbers

    def send(self, **message: Any) -> None:
        """Send a JSON message."""
        self._loop.run_sync(lambda: self._socket.write_message(json.dumps(message)), timeout=20)

    def receive(self, operation: str) -> Any:
        """The next JSON message of that kind, or for "message" the next data: (log time [ns], payload)."""
        while True:
            data = self._loop.run_sync(self._socket.read_message, timeout=20)
            if isinstance(data, bytes):
                if operation == "message" and data[0] == 1:
                    return MESSAGE.unpack_from(data)[2], data[MESSAGE.size :]
                continue
            message = json.loads(data)
            if message["op"] == "advertise":
                self.channels |= {channel["topic"]: channel.pop("id") for channel in message["channels"]}
                self.described |= {channel["topic"]: channel for channel in message["channels"]}
            if message["op"] == operation:
                return message

    def close(self) -> None:
        self._socket.close()
        self._loop.close(all_fds=True)
