"""Chromium without a window, driven over its own protocol: a page as a reader sees and uses it."""

import asyncio
import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

BROWSER = shutil.which("chromium")
PATIENCE_S = 60.0


class Tab:
    """An open page; `errors` are those of its console so far."""

    def __init__(self, loop: asyncio.AbstractEventLoop, socket: WebSocketClientConnection) -> None:
        self._loop, self._socket, self._count = loop, socket, 0
        self.errors: list[str] = []
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command and return its answer."""
        self._count += 1
        self._socket.write_message(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            text = self._loop.run_until_complete(asyncio.wait_for(_read(self._socket), PATIENCE_S))
            message: dict[str, Any] = json.loads(text)
            if message.get("id") == self._count:
                assert "error" not in message, message
                return dict(message["result"])
            told, content = message["method"], message["params"]
            if told == "Runtime.exceptionThrown":
                self.errors.append(str(content["exceptionDetails"].get("exception", {}).get("description")))
            elif told == "Runtime.consoleAPICalled" and content["type"] == "error":
                self.errors.append(str([one.get("value") for one in content["args"]]))
            elif told == "Log.entryAdded" and content["entry"]["level"] == "error":
                self.errors.append(f"{content['entry']['text']} {content['entry'].get('url', '')}")

    def open(self, address: str, width: int = 1280, height: int = 800) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=address)
        self.until("document.readyState === 'complete'")

    def value(self, expression: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, condition: str, timeout_s: float = PATIENCE_S) -> Any:
        """Wait until an expression is true, and return it."""
        deadline = time.monotonic() + timeout_s
        while not (value := self.value(condition)):
            assert time.monotonic() < deadline, f"{condition}: not within {timeout_s} s"
            time.sleep(0.05)
        return value

    def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key)

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))


async def _read(socket: WebSocketClientConnection) -> str:
    message = await socket.read_message()
    assert isinstance(message, str), "the browser has ended"
    return message


@contextmanager
def browser(profile: Path, *options: str) -> Iterator[Tab]:
    """Run the browser with one open tab while the block runs."""
    assert BROWSER is not None
    command = [
        BROWSER, "--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--remote-debugging-port=0",
        "--hide-scrollbars", f"--user-data-dir={profile}", *options, "about:blank",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)  # tornado's messages ask for it, and another test's may be closed
    try:
        port_file, deadline = profile / "DevToolsActivePort", time.monotonic() + PATIENCE_S
        while not (port_file.is_file() and "\n" in port_file.read_text()):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=PATIENCE_S) as answer:
            (page,) = [one for one in json.load(answer) if one["type"] == "page"]
        yield Tab(loop, loop.run_until_complete(_connected(page["webSocketDebuggerUrl"])))
    finally:
        process.terminate()
        process.wait()
        loop.close()


async def _connected(address: str) -> WebSocketClientConnection:
    return await websocket_connect(address, max_message_size=100_000_000)
