"""A separate process for the package `motioncapture`: `python -m` this module SYSTEM KEY=VALUE...

Its connect() blocks the interpreter, neither that nor waitForNextFrame() ends without a server, and it prints to standard
output. Here that is harmless: frames are sent as lines of JSON to the former standard output, and the kernel ends the
process after `LIFE_S` without frames, also when the station has ended. A line has a frame's bodies, or why the process ends:

[123456789, {"floaty": [x, y, z, qw, qx, qy, qz]}]      arrival [us, `clock_us`]; [m], axes of the system
"no such computer"
"""

import json
import os
import signal
import socket
import sys
from dataclasses import dataclass
from typing import TextIO

from firmware_py.extras import install_command
from ground_station.clock import clock_us
from ground_station.errors import MocapError

Body = tuple[float, ...]  # p x y z, q w x y z


@dataclass(frozen=True, slots=True)
class Arrival:
    """The system's report of one frame."""

    t_us: int  # its arrival
    bodies: dict[str, Body]


def encode_arrival(arrival: Arrival) -> str:
    """Return the line of a frame."""
    return json.dumps([arrival.t_us, arrival.bodies]) + "\n"


def encode_error(text: str) -> str:
    """Return the line on why the stream ends."""
    return json.dumps(text) + "\n"


def decode_line(line: bytes) -> Arrival | str:
    """Return the content of a line, a text if it is an error's; `MocapError` for a malformed one."""
    try:
        content = json.loads(line)
    except (ValueError, RecursionError):
        raise MocapError(f"not a line of the capture process: {line[:40]!r}") from None
    if isinstance(content, str):
        return content
    match content:
        case [int(t_us), dict(bodies)] if 0 <= t_us < 2**63 and all(map(_is_body, bodies.values())):
            return Arrival(t_us, {name: tuple(body) for name, body in bodies.items()})
    raise MocapError(f"not a line of the capture process: {line[:40]!r}")


def _is_body(body: object) -> bool:
    return isinstance(body, list) and len(body) == 7 and all(isinstance(value, float) for value in body)


LIFE_S = 5


def main(system: str, *settings: str) -> None:
    """Stream the bodies of `system` until the reader ends, or no frame arrives."""
    lines = os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        _stream(lines, system, dict(setting.split("=", 1) for setting in settings))
    except ImportError as error:
        lines.write(encode_error(f"{error}: {install_command('mocap')}"))
    except (OSError, RuntimeError) as error:
        text = (isinstance(error, OSError) and error.strerror) or str(error)
        lines.write(encode_error(text.partition("\n")[0]))


def _stream(lines: TextIO, system: str, settings: dict[str, str]) -> None:
    import motioncapture

    signal.alarm(LIFE_S)
    host, colon, port = settings["hostname"].partition(":")
    settings["hostname"] = socket.gethostbyname(host) + colon + port  # the package cannot resolve names
    capture = motioncapture.connect(system, settings)
    while True:
        capture.waitForNextFrame()
        arrival_us = clock_us()
        bodies = {}
        for name, body in capture.rigidBodies.items():
            q = body.rotation
            bodies[name] = (*body.position.tolist(), q.w, q.x, q.y, q.z)
        if system == "vrpn" and not bodies:  # it has no frames: this poll had no result
            continue
        signal.alarm(LIFE_S)
        lines.write(encode_arrival(Arrival(arrival_us, bodies)))


if __name__ == "__main__":
    main(*sys.argv[1:])
