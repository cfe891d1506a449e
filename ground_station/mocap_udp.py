"""Poses as datagrams on the loopback interface: the stand-in for a motion capture network (`--mocap virtual`).

A datagram carries the pose and the instants of exposure, receipt and departure by `clock.clock_us`, which sender and
receiver share.
"""

import socket
import struct
from dataclasses import replace

from firmware_py.wire import WireError
from ground_station.clock import clock_us
from ground_station.mocap import MocapFrame

HOST = "127.0.0.1"
DEFAULT_PORT = 19870

NOT_TOLD = -1

_MAGIC = b"FPO2"
_FRAME = struct.Struct(
    "<4s3qB7d"
)  # magic, exposure, receipt, departure [us], valid, p_WB x y z [m], q_WB w x y z


def encode_frame(frame: MocapFrame) -> bytes:
    """The datagram for a frame."""
    way = [NOT_TOLD if t_us is None else t_us for t_us in (frame.received_us, frame.transmitted_us)]
    return _FRAME.pack(_MAGIC, frame.t_us, *way, frame.valid, *frame.p_WB, *frame.q_WB)


def decode_frame(data: bytes) -> MocapFrame:
    """The frame in a datagram; `WireError` for anything else."""
    if len(data) != _FRAME.size or data[:4] != _MAGIC:
        raise WireError(f"not a pose: {len(data)} bytes")
    _, t_us, *way, valid, px, py, pz, qw, qx, qy, qz = _FRAME.unpack(data)
    told = [None if t_us == NOT_TOLD else t_us for t_us in way]
    return MocapFrame(t_us, (px, py, pz), (qw, qx, qy, qz), bool(valid), *told)


class PoseReceiver:
    """Listens for poses on a port; `OSError` when it is taken."""

    def __init__(self, port: int = DEFAULT_PORT) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((HOST, port))
        except OSError:
            self._socket.close()
            raise
        self.port: int = self._socket.getsockname()[1]

    def receive(self, timeout_s: float) -> bytes | None:
        """The next datagram, None when none comes in time."""
        self._socket.settimeout(timeout_s)
        try:
            return self._socket.recv(2048)
        except (TimeoutError, BlockingIOError):  # the latter when it is 0
            return None

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


class PosePublisher:
    """Sends poses to a port, whether anybody listens or not."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._receiver = (HOST, port)

    def send(self, frame: MocapFrame, now_us: int) -> None:
        """Send a frame of another clock, on which it is `now_us`; what cannot be sent is lost."""
        ahead_us = clock_us() - now_us
        received_us, sent_us = (
            None if t_us is None else t_us + ahead_us for t_us in (frame.received_us, frame.transmitted_us)
        )
        shared = replace(frame, t_us=frame.t_us + ahead_us, received_us=received_us, transmitted_us=sent_us)
        try:
            self._socket.sendto(encode_frame(shared), self._receiver)
        except OSError:
            return

    def close(self) -> None:
        """Stop sending."""
        self._socket.close()
