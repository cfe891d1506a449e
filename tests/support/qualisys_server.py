"""A Qualisys Track Manager of one body, byte by byte, for the unmodified client inside `motioncapture`.

Real-time protocol 1.19, little endian: u32 size, u32 kind (1 command, 2 XML, 3 data, 6 event), rest. Commands come to
TCP port 22223, and frames go to the UDP port that `StreamFrames` names, by that client always 6734.
"""

import re
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest

PORT = 22_223
SETTINGS = (
    "<QTM_Parameters_Ver_1.19><The_6D><Bodies>1</Bodies><Body><Name>{}</Name><RGBColor>255</RGBColor></Body></The_6D>"
    "</QTM_Parameters_Ver_1.19>"
)
COMMAND, XML, DATA, EVENT = 1, 2, 3, 6
EULER_6D = 6  # kind of a component
PERIOD_S = 0.005

Pose = tuple[float, ...]  # x y z [mm], Euler angles [deg]


def packet(kind: int, payload: bytes) -> bytes:
    return struct.pack("<II", 8 + len(payload), kind) + payload


def frame(number: int, pose: Pose) -> bytes:
    component = struct.pack("<IIIHH6f", 16 + 24, EULER_6D, 1, 0, 0, *pose)
    return packet(DATA, struct.pack("<QII", number * 5000, number, 1) + component)


@contextmanager
def qualisys_server(name: str, pose: Callable[[int], Pose | None]) -> Iterator[None]:
    """Serves `name` at 200 Hz, with a frame where there is a pose."""
    stop = threading.Event()
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(("127.0.0.1", PORT))
        except OSError:
            pytest.skip(f"TCP port {PORT} is taken")
        listener.listen()
        listener.settimeout(0.05)
        thread = threading.Thread(target=_serve, args=(listener, name, pose, stop))
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()


def _serve(
    listener: socket.socket, name: str, pose: Callable[[int], Pose | None], stop: threading.Event
) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as frames:
        while not stop.is_set():
            with suppress(OSError), listener.accept()[0] as line:
                line.settimeout(PERIOD_S)
                line.sendall(packet(COMMAND, b"QTM RT Interface connected\0"))
                _talk(line, frames, name, pose, stop)


def _talk(
    line: socket.socket, frames: socket.socket, name: str, pose: Callable[[int], Pose | None], stop: threading.Event
) -> None:  # fmt: skip
    number, port = 0, None
    while not stop.is_set():
        try:
            asked = line.recv(4096)  # one command: the client waits for each answer
            if not asked:
                return
            text = asked[8:].rstrip(b"\0").decode()
            if answer := _answer(text, name):
                line.sendall(answer)
            if streaming := re.match(r"StreamFrames .*UDP:(\d+)", text):
                port = int(streaming[1])
        except TimeoutError:
            number += 1
            if port is not None and (seen := pose(number)) is not None:
                frames.sendto(frame(number, seen), ("127.0.0.1", port))


def _answer(asked: str, name: str) -> bytes:
    if asked.startswith("Version "):
        return packet(COMMAND, f"Version set to {asked.split()[1]}\0".encode())
    if asked == "QTMVersion":
        return packet(COMMAND, b"QTM Version is 2018.1 (build 4220)\0")
    if asked == "GetParameters 6D":
        return packet(XML, SETTINGS.format(name).encode() + b"\0")
    return packet(EVENT, b"\1") if asked == "GetState" else b""
