"""`--view` in real time: what is shown where, what is typed there, and that a viewer that is gone changes nothing."""

import json
import urllib.parse
import urllib.request
from pathlib import Path

from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.faults import parse
from hil.laboratory.files.recorder import load_log
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live.window import LOOPBACK, is_open
from hil.pictures.report import write_report
from support.html_page import Page
from support.serving import PATIENCE_S, Served, serve, started, station
from support.serving import free_port as free_udp_port


def page_of(lab: Served) -> str:
    """The address that it says, where a page is."""
    address = lab.wait_for("^view ", PATIENCE_S).split()[1]
    assert address.startswith(f"http://{LOOPBACK}:")
    assert b"rerun" in urllib.request.urlopen(address, timeout=20).read().lower()
    return address


def test_the_links_of_a_report_lead_into_the_recording(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    fly(Request.of(EXPERIMENTS["hover"], duration_s=1.0, faults=[parse("push.y@0.3=1")]), folder)
    (link,) = Page(write_report(folder).read_text(encoding="utf-8")).links
    with started("view", folder, "--view", "web") as viewer:
        page_of(viewer)
        with urllib.request.urlopen(link, timeout=20) as page:
            assert b"rerun" in page.read().lower()
            assert urllib.parse.unquote(page.url).endswith("#when=from_release@+0.300s")
        assert viewer.interrupt() == 0


def result_of(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text())


def test_server_and_station_are_seen_in_a_browser(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with serve("--udp", "0", "--view", "web", motive=True) as lab:
        page_of(lab)
        with station(lab, lab.udp_uris[0], "--out", folder, "--view", "web", "--duration", "6") as typed:
            address = page_of(typed)
            assert typed.process.wait(timeout=120) in (0, 1, 130)
        assert lab.interrupt() == 0
    assert load_log(folder).num_rows > 250
    assert result_of(folder)["not_shown"] == 0
    assert (folder / "flight.rrd").exists()
    assert not is_open(LOOPBACK, int(address.split(":")[2].split("/")[0]))  # it ends with the command


def test_a_linked_flight_is_seen_in_a_browser(tmp_path: Path) -> None:
    folder, link = tmp_path / "run", f"udp://127.0.0.1:{free_udp_port()}"
    with started(
        "fly", "hover", "--link", link, "--duration", "2", "--view", "web", "--out", folder
    ) as flight:
        page_of(flight)
        assert flight.process.wait(timeout=120) in (0, 1)
    assert result_of(folder)["not_shown"] == 0
