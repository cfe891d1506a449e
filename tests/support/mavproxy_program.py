"""An unmodified MAVProxy as a process of its own."""

import importlib.util
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pymavlink.dialects.v20.development as dialect
import pytest

from support.serving import PATIENCE_S

mavproxy_here = pytest.mark.skipif(
    importlib.util.find_spec("MAVProxy") is None,
    reason="MAVProxy IS NOT TESTED: `make clients` (pip install --no-deps MAVProxy) installs it",
)


class MavProxy:
    """A headless MAVProxy; commands are typed, its screen is a file, and its log is a file, too."""

    def __init__(self, master: str, folder: Path) -> None:
        command = [
            sys.executable, shutil.which("mavproxy.py", path=str(Path(sys.executable).parent)),
            f"--master={master}", "--mav20", f"--state-basedir={folder}",
            "--default-modules=param,cmdlong,link,signing,misc",
        ]  # fmt: skip
        self.screen, self._tlog = folder / "screen", folder / "mav.tlog"
        with self.screen.open("w") as screen:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=screen, stderr=subprocess.STDOUT, cwd=folder,
                env={**os.environ, "HOME": str(folder), "PYTHONUNBUFFERED": "1"},
            )  # fmt: skip

    def type(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    def sees(self, text: str) -> None:
        """Wait for a text on the screen."""
        self._wait(lambda: text in self._shown(), repr(text))

    def answers(self, line: str, text: str) -> None:
        """Type a line every second until the text is on the screen: what it has logged it may not have handled yet."""
        again = 0.0

        def done() -> bool:
            nonlocal again
            if time.monotonic() >= again:
                self.type(line)
                again = time.monotonic() + 1.0
            return text in self._shown()

        self._wait(done, f"{text!r} after {line!r}")

    def heard(self) -> list[Any]:
        """Everything that it wrote into its log: 8 bytes of time ahead of each frame."""
        data, codec, messages = self._tlog.read_bytes(), dialect.MAVLink(None), []
        while len(data) > 8 + 12 and len(data) >= 8 + 12 + data[9]:
            size = 12 + data[9] + (13 if data[10] & 1 else 0)
            messages.append(codec.decode(bytearray(data[8 : 8 + size])))
            data = data[8 + size :]
        return messages

    def hears(self, wanted: Callable[[Any], bool]) -> None:
        """Wait for a message."""
        self._wait(lambda: any(map(wanted, self.heard())), "message")

    def _shown(self) -> str:
        return self.screen.read_text(errors="replace")

    def _wait(self, done: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            screen = self._shown()
            assert time.monotonic() < deadline, f"no {what} on {screen!r}"
            assert self.process.poll() is None, screen
            time.sleep(0.05)

    def kill(self) -> None:
        assert self.process.stdin is not None
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
