"""A process of its own for the package `motioncapture`: `python -m` this module SYSTEM KEY=VALUE...

Its connect() holds the interpreter, neither that nor waitForNextFrame() ends without a server, and it prints to standard
output. Here that does no harm: frames go as lines (`capture_lines`) to what was standard output, and the kernel ends the
process when nothing has come for `LIFE_S`, also when the station is no more.
"""

import os
import signal
import socket
import sys
from typing import TextIO

from firmware_py.extras import install_command
from ground_station.clock import clock_us
from ground_station.sources.capture_lines import Arrival, encode_arrival, encode_error

LIFE_S = 5


def main(system: str, *settings: str) -> None:
    """Stream the bodies of `system` until the reader is gone, or no frame arrives."""
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
    settings["hostname"] = socket.gethostbyname(host) + colon + port  # it cannot resolve names
    capture = motioncapture.connect(system, settings)
    while True:
        capture.waitForNextFrame()
        arrival_us = clock_us()
        bodies = {}
        for name, body in capture.rigidBodies.items():
            q = body.rotation
            bodies[name] = (*body.position.tolist(), q.w, q.x, q.y, q.z)
        if system == "vrpn" and not bodies:  # it has no frames: this was a poll without result
            continue
        signal.alarm(LIFE_S)
        lines.write(encode_arrival(Arrival(arrival_us, bodies)))


if __name__ == "__main__":
    main(*sys.argv[1:])
