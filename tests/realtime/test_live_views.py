"""`--view` in real time: what is shown where, what is typed there, and that a viewer that is gone changes nothing."""

import json
import os
import signal
import subprocess
import time
import urllib.parse
import urllib.request
from pathlib import Path

import pytest

from hil.experiments import EXPERIMENTS
from hil.laboratory.faults import parse
from hil.laboratory.recorder import load_events, load_log
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live.window import COMMAND, LOOPBACK, free_port, is_open
from hil.pictures.report import write_report
from support.foxglove_client import FoxgloveClient
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


def wait_for_begin(folder: Path) -> None:
    """Wait until what is judged has begun."""
    deadline = time.monotonic() + PATIENCE_S
    while not any(event["text"] == "hover begins" for event in load_events(folder)):
        assert time.monotonic() < deadline
        time.sleep(0.1)


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


@pytest.mark.parametrize("blow", [signal.SIGSTOP, signal.SIGKILL])
def test_a_viewer_that_stands_still_or_is_closed_leaves_the_flight_alone(blow: int, tmp_path: Path) -> None:
    folder, port = tmp_path / "run", free_port(0)
    viewer = subprocess.Popen(
        [*COMMAND, "--port", str(port), "--serve-grpc"], env={**os.environ, "CI": "1"}, start_new_session=True
    )
    try:
        while not is_open(LOOPBACK, port):
            assert viewer.poll() is None
            time.sleep(0.1)
        with (
            serve("--udp", "0", motive=True) as lab,
            station(
                lab,
                lab.udp_uris[0],
                "--out",
                folder,
                "--view",
                f"connect:{LOOPBACK}:{port}",
                "--duration",
                "8",
            ) as typed,
        ):
            typed.wait_for("^connected", PATIENCE_S)
            wait_for_begin(folder)
            os.killpg(viewer.pid, blow)
            assert typed.process.wait(timeout=120) in (0, 1, 130)
    finally:
        os.killpg(viewer.pid, signal.SIGKILL)
        viewer.wait()
    log = load_log(folder)
    assert log.num_rows > 400
    assert result_of(folder)["outcome"] in ("completed", "interrupted")
    sent = log.column("link.sent").to_numpy()
    assert sent[-1] - sent[100] > 0.7 * 0.5 * (log.num_rows - 100)  # every 20 ms


def test_a_parameter_is_changed_from_foxglove(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with (
        serve("--udp", "0", motive=True) as lab,
        station(lab, lab.udp_uris[0], "--out", folder, "--view", "foxglove") as typed,
    ):
        client = FoxgloveClient(typed.wait_for("^view ", PATIENCE_S).split()[1])
        typed.wait_for("^connected", PATIENCE_S)
        known: dict[str, float] = {}
        deadline = time.monotonic() + PATIENCE_S
        while "extCtrl.z_P" not in known:
            assert time.monotonic() < deadline
            client.send(op="getParameters", parameterNames=[], id="all")
            known = {one["name"]: one["value"] for one in client.receive("parameterValues")["parameters"]}
        client.send(op="setParameters", parameters=[{"name": "extCtrl.z_P", "value": 2.5}], id="wish")
        typed.wait_for("^set extCtrl.z_P 2.5, was", PATIENCE_S)
        client.close()
        assert typed.interrupt() in (0, 1, 130)
    operated = [event["text"] for event in load_events(folder) if event["source"] == "operator"]
    assert len(operated) == 1
    assert operated[0].startswith("set extCtrl.z_P 2.5, was ")
