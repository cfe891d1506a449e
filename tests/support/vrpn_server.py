"""A VRPN server of trackers, byte by byte, for the unmodified client inside `motioncapture`.

A client says by UDP where it listens, the server connects there, both send a cookie, then messages: i32 length of header
and payload, seconds, microseconds, sender, type, sequence number; payload, padded to 8 bytes. Network byte order.
"""

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

COOKIE = b"vrpn: ver. 07.35  0".ljust(24, b"\0")
SENDER_DESCRIPTION, TYPE_DESCRIPTION = -1, -2
POSE_TYPE = 0
PERIOD_S = 0.005

Poses = Callable[[int], dict[str, tuple[float, ...]]]  # by name, p x y z, q x y z w, for each time


def message(sender: int, kind: int, payload: bytes) -> bytes:
    padded = payload.ljust(-(-len(payload) // 8) * 8, b"\0")
    return struct.pack(">6i", 24 + len(payload), 0, 0, sender, kind, 0) + padded


def named(number: int, kind: int, name: str) -> bytes:
    text = name.encode() + b"\0"
    return message(number, kind, struct.pack(">i", len(text)) + text)


@contextmanager
def vrpn_server(names: list[str], poses: Poses) -> Iterator[int]:
    """Serves trackers of these names at 200 Hz, those that have a pose then; gives the port."""
    stop = threading.Event()
    with socket.socket(type=socket.SOCK_DGRAM) as calls:
        calls.bind(("127.0.0.1", 0))
        calls.settimeout(0.05)
        thread = threading.Thread(target=_serve, args=(calls, names, poses, stop))
        thread.start()
        try:
            yield calls.getsockname()[1]
        finally:
            stop.set()
            thread.join()


def _serve(calls: socket.socket, names: list[str], poses: Poses, stop: threading.Event) -> None:
    while not stop.is_set():
        with suppress(OSError):
            host, port = calls.recv(100).rstrip(b"\0").split()
            with socket.create_connection((host.decode(), int(port)), 1.0) as line:
                _report(line, names, poses, stop)


def _report(line: socket.socket, names: list[str], poses: Poses, stop: threading.Event) -> None:
    described = [named(sender, SENDER_DESCRIPTION, name) for sender, name in enumerate(names)]
    described.append(named(POSE_TYPE, TYPE_DESCRIPTION, "vrpn_Tracker Pos_Quat"))
    line.sendall(COOKIE + b"".join(described))
    line.settimeout(PERIOD_S)
    number = 0
    while not stop.is_set():
        with suppress(TimeoutError):
            if not line.recv(4096):
                return
            time.sleep(PERIOD_S)
        number += 1
        for name, pose in poses(number).items():
            payload = struct.pack(">ii7d", 0, 0, *pose)
            line.sendall(message(names.index(name), POSE_TYPE, payload))
