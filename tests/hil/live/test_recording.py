"""Links of a report into the recording: each leads to its instant in the viewer's own words, others nowhere."""

import http.client
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from rerun.blueprint import Blueprint

from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.result import read_result
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live.recording import Links
from hil.live.window import free_port
from hil.pictures.links import HOST, link_to
from hil.pictures.viewer.recording import ServedRecording


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording") / "run"
    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.5), folder)
    return folder


@pytest.fixture
def links(run: Path) -> Iterator[Links]:
    with Links(run, lambda at_s: f"http://viewer/{at_s:g}", free_port(0)) as served:
        thread = threading.Thread(target=served.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield served
        served.shutdown()
        thread.join()


def answer(links: Links, path: str, **headers: str) -> tuple[int, str | None, str]:
    """Return an answer's status, the address to which it redirects, and its text, whose type is checked, too."""
    connection = http.client.HTTPConnection(HOST, links.server_port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    told = response.status, response.headers["Location"], response.read().decode()
    connection.close()
    kinds = {200: "text/html; charset=utf-8", 302: None}
    assert response.headers["Content-Type"] == kinds.get(told[0], "text/plain; charset=utf-8")
    return told


@pytest.mark.parametrize("at_s", [0.0, 12.25, -0.5])
def test_a_link_leads_to_its_instant_on_this_computer_alone(links: Links, run: Path, at_s: float) -> None:
    assert links.server_address == (HOST, links.server_port)
    _, _, path = link_to(read_result(run), at_s).split("/", 3)[1:]
    assert answer(links, f"/{path}")[:2] == (302, f"http://viewer/{at_s:g}")


@pytest.mark.parametrize("path", ["/", "/0123456789abcdef/1.00", "/../result.json", "/log.parquet"])
def test_a_foreign_link_leads_nowhere(links: Links, run: Path, path: str) -> None:
    status, where, text = answer(links, path)
    assert (status, where) == (404, None)
    assert text.startswith(f"Here is {run}; for another flight: floaty view RUN --view web")


def test_the_report_is_there_too(links: Links, run: Path) -> None:
    (run / "report.html").write_text("what was flown")
    assert answer(links, "/report.html") == (200, None, "what was flown")


@pytest.mark.parametrize("name", ["evil.example", "127.0.0.1", "localhost:1", ""])
def test_a_request_by_another_name_of_this_computer_is_refused(links: Links, run: Path, name: str) -> None:
    (run / "report.html").write_text("what was flown")
    assert answer(links, "/report.html", Host=name) == (403, None, "Use the address that floaty prints.\n")
    assert answer(links, "/report.html", Host=f"localhost:{links.server_port}")[0] == 200


@pytest.mark.long
def test_idle_connections_delay_nobody(links: Links) -> None:
    idle = [socket.create_connection((HOST, links.server_port)) for _ in range(20)]
    assert answer(links, "/")[0] == 404
    for one in idle:
        one.close()


def test_a_port_that_is_taken_is_one_line(links: Links, run: Path) -> None:
    with pytest.raises(LabError, match=f"port {links.server_port}, which is taken"):
        Links(run, str, links.server_port)


def test_a_recording_is_served_with_the_time_at_an_instant(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved, save = [], Blueprint.save
    monkeypatch.setattr(Blueprint, "save", lambda layout, *to: saved.append(to[0]) or save(layout, *to))
    recording = ServedRecording(run)
    assert set(saved) == {"floaty"}, "the layout is that of the recording's application"
    assert (run / "flight.rrd").is_file()
    at = recording.at(0.25)
    assert at.startswith("rerun+http://127.0.0.1:")
    assert at.endswith("#when=from_release@+0.250s")
    assert recording.at(-0.5) == at.replace("+0.250", "-0.500")
    port = int(at.split(":")[2].partition("/")[0])
    assert allowed_origins(port) == ["http://127.0.0.1:9090", "http://localhost:9090"]


def allowed_origins(port: int) -> list[str]:
    """Those of some pages that rerun's server on a port lets read from it."""
    allowed = []
    for origin in ("http://127.0.0.1:9090", "http://localhost:9090", "http://evil.example", "null"):
        asker = http.client.HTTPConnection(HOST, port, timeout=10)
        asker.request("OPTIONS", "/", headers={"Origin": origin, "Access-Control-Request-Method": "POST"})
        response = asker.getresponse()
        response.read()
        allowed += [origin] if response.headers["Access-Control-Allow-Origin"] in (origin, "*") else []
        asker.close()
    return allowed
