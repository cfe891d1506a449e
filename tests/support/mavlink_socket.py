"""A bare MAVLink program on pymavlink's own codec: sends, and waits for what it wants to see."""

import math
import select
import socket
import time
from collections.abc import Callable
from typing import Any

import pymavlink.dialects.v20.development as dialect
import serial

from support.serving import PATIENCE_S

GAIN = "EXT_Z_P"  # extCtrl.z_P, the parameter that tests tune


class MavlinkSocket:
    """A ground station (system 255, component 190) on an end as `floaty serve --mavlink` prints it."""

    def __init__(self, master: str) -> None:
        kind, _, where = master.partition(":")
        self._serial: serial.Serial | None = None
        if kind in ("tcp", "udpin"):
            host, port = where.split(":")
            if kind == "tcp":
                self._socket = socket.create_connection((host, int(port)), PATIENCE_S)
                self._peer = None
            else:
                self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                self._socket.bind((host, int(port)))
            self._file = self._socket.fileno()
        else:
            self._serial = serial.Serial(master, 57600, timeout=0)
            self._file = self._serial.fileno()
        self.codec = dialect.MAVLink(self, srcSystem=255, srcComponent=190)
        self.codec.robust_parsing = True
        self.received: list[Any] = []
        self._seen = 0  # of these, by `wait`

    def write(self, data: bytes) -> None:
        """What the codec calls to send."""
        if self._serial is not None:
            self._serial.write(data)
        elif self._socket.type == socket.SOCK_STREAM:
            self._socket.sendall(data)
        else:
            self._socket.sendto(data, self._peer)

    def poll(self, timeout_s: float) -> None:
        """Receive what is there, or comes first within the time."""
        if not select.select([self._file], (), (), max(0.0, timeout_s))[0]:
            return
        if self._serial is not None:
            data = self._serial.read(65536)
        else:
            data, self._peer = self._socket.recvfrom(65536)
        assert data, "the board has closed the line"
        self.received += [
            message for message in self.codec.parse_buffer(data) or () if message.get_msgId() >= 0
        ]

    def wait(
        self, kind: str, wanted: Callable[[Any], bool] = lambda _: True, timeout_s: float = PATIENCE_S
    ) -> Any:
        deadline = time.monotonic() + timeout_s
        while True:
            while self._seen < len(self.received):
                message = self.received[self._seen]
                self._seen += 1
                if message.get_type() == kind and wanted(message):
                    return message
            left_s = deadline - time.monotonic()
            assert left_s > 0, f"no {kind} within {timeout_s} s"
            self.poll(left_s)

    def collect(self, duration_s: float) -> list[Any]:
        first, deadline = len(self.received), time.monotonic() + duration_s
        while (left_s := deadline - time.monotonic()) > 0:
            self.poll(left_s)
        self._seen = len(self.received)
        return self.received[first:]

    def parameters(self) -> dict[str, Any]:
        """Every PARAM_VALUE of one list, by name."""
        self.codec.param_request_list_send(1, 1)
        found: dict[str, Any] = {}
        deadline = time.monotonic() + PATIENCE_S
        while not found or len(found) < next(iter(found.values())).param_count:
            message = self.wait("PARAM_VALUE", timeout_s=deadline - time.monotonic())
            found[message.param_id] = message
        return found

    def set(self, name: str, value: float) -> float:
        """Set a parameter; returns what the board says it is now."""
        self.codec.param_set_send(1, 1, name.encode(), value, dialect.MAV_PARAM_TYPE_REAL32)
        return float(self.wait("PARAM_VALUE", lambda message: message.param_id == name).param_value)

    def command(self, number: int, *params: float, system: int = 1) -> int:
        """Send COMMAND_LONG; returns the result of its acknowledgement."""
        values = [*params, *[math.nan] * (7 - len(params))]
        self.codec.command_long_send(system, 1, number, 0, *values)
        return int(self.wait("COMMAND_ACK", lambda message: message.command == number).result)

    def close(self) -> None:
        if self._serial is not None:
            self._serial.close()
        else:
            self._socket.close()
