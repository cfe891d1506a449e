"""Unmodified ground tools against `floaty serve --mavlink`: MAVProxy and MAVSDK, each as a program of its own."""

import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pymavlink.dialects.v20.common as dialect
import pytest
from mavlink_socket import GAIN, Client
from serving import Served, free_port, serve

PATIENCE_S = 15.0

mavproxy_here = pytest.mark.skipif(
    importlib.util.find_spec("MAVProxy") is None,
    reason="MAVProxy IS NOT TESTED: `make clients` (pip install --no-deps MAVProxy) installs it",
)
mavsdk_here = pytest.mark.skipif(
    importlib.util.find_spec("mavsdk") is None,
    reason="MAVSDK IS NOT TESTED: `make clients` (pip install mavsdk) installs it",
)


def address(end: str) -> str:
    """What to serve on, so that tests do not meet."""
    return {"pty": "pty", "udp": f"udp:{free_port()}", "tcp": "tcp:0"}[end]


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
        self._wait(lambda: text in self.screen.read_text(errors="replace"), repr(text))

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

    def _wait(self, done: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            screen = self.screen.read_text(errors="replace")
            assert time.monotonic() < deadline, f"no {what} on {screen!r}"
            assert self.process.poll() is None, screen
            time.sleep(0.05)

    def kill(self) -> None:
        assert self.process.stdin is not None
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()


@pytest.fixture(params=["pty", "udp"])
def proxied(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Served, MavProxy]]:
    with serve("--mavlink", address(request.param)) as served:
        proxy = MavProxy(served.line("mavlink ")[0], tmp_path)
        yield served, proxy
        proxy.kill()


@mavproxy_here
def test_mavproxy_watches_tunes_and_commands(proxied: tuple[Served, MavProxy], tmp_path: Path) -> None:
    served, proxy = proxied
    proxy.sees("Detected vehicle 1:1")
    proxy.sees("Received ")
    proxy.type(f"param set {GAIN} 2.5")
    proxy.hears(lambda message: message.get_type() == "PARAM_VALUE" and message.param_value == 2.5)
    proxy.type(f"param show {GAIN}")
    proxy.sees(f"{GAIN:<16} 2.5")
    proxy.type("long MAV_CMD_REQUEST_MESSAGE 148")
    proxy.type("long MAV_CMD_NAV_LAND")
    proxy.sees("Got COMMAND_ACK: NAV_LAND: UNSUPPORTED")
    proxy.hears(lambda message: message.get_type() == "AUTOPILOT_VERSION")

    messages = proxy.heard()
    kinds = {message.get_type() for message in messages}
    assert {"HEARTBEAT", "ATTITUDE", "LOCAL_POSITION_NED", "SYS_STATUS", "AUTOPILOT_VERSION"} <= kinds
    values = {message.param_id: message for message in messages if message.get_type() == "PARAM_VALUE"}
    count = values[GAIN].param_count
    assert len(values) == count
    proxy.sees(f"Received {count} parameters")
    assert values[GAIN].param_value == 2.5
    saved = dict(line.split() for line in (tmp_path / "mav.parm").read_text().splitlines())
    assert set(saved) == set(values)
    proxy.kill()
    again = Client(served.line("mavlink ")[0])  # the board does not care that it has gone
    again.wait("HEARTBEAT")
    again.close()


@mavproxy_here
def test_a_signed_board_obeys_mavproxy_once_it_has_the_key(tmp_path: Path) -> None:
    key = hashlib.sha256(b"floaty").hexdigest()
    with serve("--mavlink", address("pty"), "--set", f"mavlink.signing_key={key}") as served:
        proxy = MavProxy(served.line("mavlink ")[0], tmp_path)
        try:
            proxy.sees("Detected vehicle 1:1")  # it listens to who signs, and is not listened to
            proxy.type("long MAV_CMD_NAV_LAND")
            proxy.type("signing key floaty")
            proxy.sees("Received ")
            assert "NAV_LAND" not in proxy.screen.read_text()
            proxy.type(f"param set {GAIN} 2.0")
            proxy.hears(lambda message: message.get_type() == "PARAM_VALUE" and message.param_value == 2.0)
        finally:
            proxy.kill()


@pytest.fixture(params=["udp", "pty", "tcp"])
def url(request: pytest.FixtureRequest) -> Iterator[str]:
    """An end of a served board, in MAVSDK's words."""
    with serve("--mavlink", address(request.param)) as served:
        master = served.line("mavlink ")[0]
        if request.param == "pty":
            yield f"serial://{master}:921600"
        else:
            kind, host, port = master.split(":")
            yield {"udpin": "udpin", "tcp": "tcpout"}[kind] + f"://{host}:{port}"


@mavsdk_here
def test_mavsdk_reads_telemetry_and_tunes(url: str) -> None:
    script = Path(__file__).parent / "mavsdk_client.py"
    command = [sys.executable, str(script), url, GAIN, "2.5"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ended.returncode == 0, ended.stderr + ended.stdout
    seen = json.loads(ended.stdout.splitlines()[-1])
    assert seen["system"] == 1
    assert seen["attitude_deg"] == pytest.approx([0, 0, 0], abs=5)  # held at home
    assert seen["quaternion"] == pytest.approx([1, 0, 0, 0], abs=0.05)
    assert len(seen["position"]) == 3
    assert seen["battery_V"] == pytest.approx(3.9, abs=0.1)
    assert len(seen["floats"]) > 30
    assert seen["others"] == 0
    assert seen["before"] == seen["floats"][GAIN] != 2.5
    assert seen["after"] == 2.5
