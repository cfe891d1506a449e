"""Shows a run's recording at a time in rerun's viewer: in its window or in a browser, also by links of the report."""

import re
import signal
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from hil.errors import LabError
from hil.laboratory.files.result import read_result
from hil.live.window import end, page_of, serve_viewer, show
from hil.pictures.links import HOST, PORT, key_of
from hil.pictures.report import REPORT
from hil.pictures.viewer.recording import ServedRecording

IDLE_S = 5.0  # for a connection without a request
ROUTE = re.compile(r"/(\w+)/(-?\d+(?:\.\d+)?)")


def show_at(run: Path, at_s: float) -> None:
    """Show the recording of a run folder until the window is closed. Raises `LabError` when no window opens."""
    recording = ServedRecording(run)  # it has to exist as long as the window
    show(recording.at(at_s), "--new")


def browse(run: Path, at_s: float, say: Callable[[str], None]) -> None:
    """Serve the recording of a run folder to browsers, and the links of its report, until Ctrl-C.

    Raises `LabError` when the links' port is taken, or no viewer opens.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the viewer ends with this process
    recording = ServedRecording(run)
    with Links(run, lambda instant_s: page_of(web_port, recording.at(instant_s))) as links:
        web_port, viewer = serve_viewer(recording.at(at_s))
        try:
            say(f"view    {page_of(web_port, recording.at(at_s))}")
            say(
                f"report  http://{HOST}:{PORT}/{REPORT}, whose links lead here, as those of the file do, until Ctrl-C"
            )
            links.serve_forever()
        except KeyboardInterrupt:
            pass
        finally:
            end(viewer)


class Links(ThreadingHTTPServer):
    """Leads from the links of one report to the pages that `page_at` returns for an instant [s].

    Each connection has a thread. A request by another name of this computer is refused: a page of another site may have a
    name of its own that leads here (DNS rebinding), and read the report.
    """

    def __init__(self, run: Path, page_at: Callable[[float], str], port: int = PORT) -> None:
        self.run, self.page_at = run, page_at
        self.key = key_of(read_result(run))
        try:
            super().__init__((HOST, port), _Visit)
        except OSError as error:
            raise LabError(
                f"{run}: the links of reports lead to port {port}, which is taken ({error.strerror}): "
                "another floaty view --view web?"
            ) from None


class _Visit(BaseHTTPRequestHandler):
    server: Links
    timeout = IDLE_S

    def do_GET(self) -> None:
        names = [f"{name}:{self.server.server_port}" for name in (HOST, "localhost")]
        if self.headers.get("Host") not in names:
            self._respond(HTTPStatus.FORBIDDEN, "text/plain", b"Use the address that floaty prints.\n")
            return
        found, report = ROUTE.fullmatch(self.path), self.server.run / REPORT
        if found is not None and found[1] == self.server.key:
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", self.server.page_at(float(found[2])))
            self.end_headers()
        elif self.path == f"/{REPORT}" and report.is_file():
            self._respond(HTTPStatus.OK, "text/html", report.read_bytes())
        else:
            text = f"Here is {self.server.run}; for another flight: floaty view RUN --view web with its folder.\n"
            self._respond(HTTPStatus.NOT_FOUND, "text/plain", text.encode())

    def _respond(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *arguments: object) -> None:
        """Log nothing: visits need no messages."""
