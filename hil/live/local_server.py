"""An HTTP and WebSocket server for programs of this computer that have the token of its address.

It listens on 127.0.0.1, in a thread. A request without the token is refused; so is one by another name of this computer,
because a page of another site may reach it by a name of its own that leads here (DNS rebinding).
"""

import os
import threading
from collections.abc import Callable
from hmac import compare_digest
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop
from tornado.web import Application, HTTPError, RequestHandler

from hil.live.window import LOOPBACK, listen

BODY_MAX = 65_536  # bytes of a request: none has a body
MESSAGE_MAX = 1 << 20  # bytes of a WebSocket message
IDLE_S = 20.0  # for a connection without a request


class LocalServer:
    """Serves `handlers`, which derive from `Guarded`, by their paths, on the port `wanted` or a free one.

    The handlers' argument is `owner`.
    """

    def __init__(self, wanted: int, owner: Any, handlers: dict[str, type["Guarded"]]) -> None:
        self.token = os.urandom(16).hex()
        self._loop: IOLoop | None = None
        listener = listen(wanted)
        self.host = f"{LOOPBACK}:{listener.getsockname()[1]}"
        arguments = {"server": self, "owner": owner}
        application = Application(
            [(path, handler, arguments) for path, handler in handlers.items()],
            websocket_max_message_size=MESSAGE_MAX,
        )
        opened = threading.Event()

        def serve() -> None:
            self._loop = IOLoop()
            server = HTTPServer(
                application, max_body_size=BODY_MAX, idle_connection_timeout=IDLE_S, body_timeout=IDLE_S
            )
            server.add_socket(listener)
            opened.set()
            self._loop.start()
            server.stop()
            self._loop.close(all_fds=True)

        self._thread = threading.Thread(target=serve, name="local server", daemon=True)
        self._thread.start()
        opened.wait()

    def call(self, act: Callable[[], None]) -> None:
        """Let the server's thread act."""
        assert self._loop is not None
        self._loop.add_callback(act)

    def close(self) -> None:
        """End, and disconnect all."""
        assert self._loop is not None
        self._loop.add_callback(self._loop.stop)
        self._thread.join()


class Guarded(RequestHandler):
    """Refuses a request without the token, or by another name of this computer."""

    def initialize(self, server: LocalServer, owner: Any) -> None:
        self.server, self.owner = server, owner

    def prepare(self) -> None:
        known = compare_digest(self.get_query_argument("token", "").encode(), self.server.token.encode())
        if not known or self.request.host != self.server.host:
            raise HTTPError(403)

    def write_error(self, status_code: int, **_: Any) -> None:
        self.set_header("Content-Type", "text/plain")
        self.finish("Use the address that floaty prints, token and all.\n")
