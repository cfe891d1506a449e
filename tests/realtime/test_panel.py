"""The control panel in a real browser: its controls act on a flight, soon, and the console stays clean."""

import time
from pathlib import Path

import pytest

from hil.laboratory.files.recorder import load_events
from support.browser import BROWSER, Tab, browser
from support.serving import PATIENCE_S, Served, serve, started, station

pytestmark = [pytest.mark.realtime, pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")]
SHOWS = "document.getElementById('scene').naturalWidth > 0 && document.getElementById('status').dataset.time > 0.5"
TEXTS = "document.getElementById('texts').textContent"
SECONDS = "Number(document.getElementById('status').dataset.time)"


def opened(tab: Tab, program: Served, width: int = 1280) -> None:
    tab.open(program.wait_for("^view ", PATIENCE_S).split()[1], width)
    tab.until(SHOWS)


def click(tab: Tab, button: str) -> None:
    tab.value(f"document.querySelector({button!r}).click()")


def fill(tab: Tab, field: str, value: str) -> None:
    setting = f"Object.assign(document.getElementById({field!r}), {{ value: {value!r} }})"
    tab.value(f"{setting}.dispatchEvent(new Event('change'))")


def drag(tab: Tab) -> None:
    """Move the goal in the view from above by touch."""
    left, top, size = tab.value(
        "(() => { const view = document.getElementById('above'); view.scrollIntoView(); "
        "const box = view.getBoundingClientRect(); return [box.left, box.top, box.width]; })()"
    )
    for kind, share in (("touchStart", 0.5), ("touchMove", 0.49), ("touchMove", 0.475), ("touchEnd", None)):
        points = [] if share is None else [{"x": left + share * size, "y": top + share * size}]
        tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)


def says(tab: Tab, text: str) -> float:
    """How long it takes until the page shows a text [s]."""
    began = time.monotonic()
    tab.until(f"{TEXTS}.includes({text!r})")
    return time.monotonic() - began


def test_the_panel_of_a_flight_steers_disturbs_pauses_and_stops_it(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    options = ("--realtime", "--duration", "120", "--view", "web", "--out", folder)
    with started("fly", "hover", *options) as flight, browser(tmp_path / "profile") as tab:
        opened(tab, flight, 390)
        assert tab.value("document.documentElement.scrollWidth") <= 390
        tab.press("ArrowUp")
        says(tab, "operator: goal 0.020 0.000 1.150 0.000")
        fill(tab, "parameter", "controller.gain_y")
        assert "now -1.8" in tab.value("document.getElementById('bounds').textContent")
        fill(tab, "value", "1e9")
        click(tab, "#set")
        says(tab, "panel: controller.gain_y 1e9: expected -20..20")
        fill(tab, "value", "-1.7")
        click(tab, "#set")
        says(tab, "operator: set controller.gain_y -1.7")
        assert tab.until("document.getElementById('bounds').textContent.includes('now -1.7')")
        drag(tab)
        says(tab, "operator: goal 0.050 0.030 1.150 0.000")
        tab.value("navigator.getGamepads = () => [{ axes: [0, -1, 0, 0] }]")
        tab.until(f"/operator: goal 0.0[6-9]/.test({TEXTS})")
        tab.value("navigator.getGamepads = () => []")
        fill(tab, "fault", "push.y")
        fill(tab, "size", "99")
        click(tab, "#inject")
        says(tab, "panel: push.y 99: expected -20..20")
        fill(tab, "size", "0.5")
        click(tab, "#inject")
        says(tab, "operator: push.y=0.5")
        delays_s = []
        for note in ("one", "two", "three"):
            fill(tab, "note", note)
            click(tab, "#mark")
            delays_s.append(says(tab, f"operator: mark {note}"))
        assert min(delays_s) < 1.0, "from the click to the flight and back"
        click(tab, "[data-line=pause]")
        says(tab, "operator: pause")
        tab.until(
            f"new Promise((done) => {{ const at = {SECONDS}; setTimeout(() => done(at === {SECONDS}), 700); }})"
        )
        paused_s = tab.value(SECONDS)
        fill(tab, "step", "50")
        click(tab, "#one")
        tab.until(f"{SECONDS} > {paused_s}")
        assert tab.value(SECONDS) == pytest.approx(paused_s + 0.05, abs=0.006)
        click(tab, "[data-line=go]")
        tab.until(f"{SECONDS} > {paused_s + 0.5}")
        assert tab.errors == []
        click(tab, "#stop")
        assert flight.process.wait(timeout=60) == 130
    texts = [event["text"] for event in load_events(folder) if event["source"] == "operator"]
    assert texts[:2] == ["goal 0.020 0.000 1.150 0.000", "set controller.gain_y -1.7"]
    assert texts[texts.index("push.y=0.5") + 1] == "mark one"
    assert "interrupted by the user" in [event["text"] for event in load_events(folder)]


def test_server_and_station_have_the_commands_of_their_terminals(tmp_path: Path) -> None:
    with serve("--udp", "0", "--view", "web", motive=True) as lab, browser(tmp_path / "one") as tab:
        tab.open(lab.wait_for("^view ", PATIENCE_S).split()[1])
        with station(lab, lab.udp_uris[0], "--view", "web", "--duration", "60") as typed:
            tab.until(SHOWS)
            fill(tab, "fault", "mocap.dropout")
            fill(tab, "lasts", "0.1")
            click(tab, "#inject")
            says(tab, "fault mocap.dropout")
            assert tab.errors == []
            opened(tab, typed)
            tab.press("PageUp")
            says(tab, "goal 0 0 1.17 m")
            fill(tab, "parameter", "controller.gain_y")
            fill(tab, "value", "1e9")
            click(tab, "#set")
            says(tab, "panel: controller.gain_y 1e9: expected ")
            fill(tab, "value", "-1.7")
            click(tab, "#set")
            says(tab, "set controller.gain_y -1.7")
            assert tab.errors == []
