"""A client of Foxglove's WebSocket protocol, as far as the tests need one: RFC 6455 frames, JSON and binary messages."""

import base64
import json
import os
import socket
import struct
from typing import Any

PROTOCOL = "foxglove.sdk.v1"
MESSAGE = struct.Struct("<BIQ")  # operation 1, subscription, log time [ns]


class FoxgloveClient:
    """Connects to a `ws://HOST:PORT`."""

    def __init__(self, address: str) -> None:
        host, _, port = address.removeprefix("ws://").partition(":")
        self._socket = socket.create_connection((host, int(port)), timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        request = (
            f"GET / HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n"
        )
        self._socket.sendall(request.encode())
        self._stream = self._socket.makefile("rb")
        assert b" 101 " in self._stream.readline()
        while self._stream.readline() != b"\r\n":
            pass
        self.channels: dict[str, int] = {}  # by topic

    def send(self, **message: Any) -> None:
        """Send a JSON message in a masked frame."""
        data = json.dumps(message).encode()
        size = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xfe" + struct.pack(">H", len(data))
        self._socket.sendall(b"\x81" + size + bytes(4) + data)

    def receive(self, operation: str) -> Any:
        """The next JSON message of that kind, or for "message" the next data: (log time [ns], payload)."""
        while True:
            first, size = self._stream.read(2)
            size &= 0x7F
            if size >= 126:
                size = int.from_bytes(self._stream.read(2 if size == 126 else 8))
            data = self._stream.read(size)
            if first & 0x0F == 2:
                if operation == "message" and data[0] == 1:
                    return MESSAGE.unpack_from(data)[2], data[MESSAGE.size :]
                continue
            message = json.loads(data)
            if message["op"] == "advertise":
                self.channels |= {channel["topic"]: channel["id"] for channel in message["channels"]}
            if message["op"] == operation:
                return message

    def close(self) -> None:
        self._stream.close()
        self._socket.close()
