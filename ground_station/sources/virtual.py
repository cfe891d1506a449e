"""Poses of `floaty board serve`, which come as datagrams of our own."""

from dataclasses import replace

from firmware_py.wire import WireError
from ground_station.clock import clock_us
from ground_station.errors import MocapError
from ground_station.mocap import MocapFrame
from ground_station.mocap_udp import DEFAULT_PORT, PoseReceiver, decode_frame


class VirtualSource:
    """Listens on a port, by default that of `floaty board serve`."""

    def __init__(self, port: int | None) -> None:
        self._port = DEFAULT_PORT if port is None else port
        self._receiver: PoseReceiver | None = None
        self._malformed = 0

    def open(self) -> None:
        """Take the port; raises `MocapError`."""
        try:
            self._receiver = PoseReceiver(self._port)
        except OSError as error:
            raise MocapError(f"port {self._port}: {error.strerror or error}") from None

    def receive(self, timeout_s: float) -> MocapFrame | None:
        """The next frame, None when none comes in time."""
        assert self._receiver is not None
        data = self._receiver.receive(timeout_s)
        if data is None:
            return None
        try:
            return replace(decode_frame(data), arrived_us=clock_us())
        except WireError:
            self._malformed += 1
            return None

    def notices(self) -> list[str]:
        """There is nothing to say."""
        return []

    def summary(self) -> str:
        """A few words on how it does."""
        return f"mocap virtual ({self._malformed} malformed)"

    def close(self) -> None:
        """Give the port back."""
        if self._receiver is not None:
            self._receiver.close()
