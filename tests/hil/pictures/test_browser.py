"""The report in a real browser: every panel is drawn, all edges are aligned, zoom and cursor are shared; no network."""

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.faults import parse
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures.compare import compare, load_flown, write_comparison
from hil.pictures.report import write_report
from support.browser import BROWSER, browser
from support.html_page import Page

pytestmark = [pytest.mark.long, pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")]
SELDOM = ("close-up-1", "radio")  # a window of its own; a value in a second
ACT = """
<script>
addEventListener("load", async () => {
  document.documentElement.style.width = "WIDTHpx";
  dispatchEvent(new Event("resize"));
  document.querySelectorAll("details").forEach((part) => (part.open = true));
  const pause = () => new Promise((done) => setTimeout(done, 300));
  await pause();
  document.querySelector("#story a[data-begin='0.5']").click();
  await pause();
  const legends = [...document.querySelectorAll(".u-legend .u-value")].map((value) => value.textContent).join("");
  const marked = [...document.querySelectorAll("#close-up-1 tr.named")].map((one) =>
    [one.textContent.trim(), getComputedStyle(one.querySelector(".u-marker")).borderTopStyle]);
  const [over] = document.querySelectorAll("#errors .u-over"), box = over.getBoundingClientRect();
  const middle = { clientX: box.left + box.width / 2, clientY: box.top + 20, bubbles: true };
  over.dispatchEvent(new MouseEvent("mouseenter", middle));
  over.dispatchEvent(new MouseEvent("mousemove", middle));
  await pause();
  const shown = [...document.querySelectorAll(".plot")].flatMap((place) =>
    [...place.querySelectorAll(".uplot")].map((chart) => {
      const edge = chart.querySelector(".u-over").getBoundingClientRect();
      const time = chart.querySelector(".u-legend .u-series .u-value");
      return { place: place.id, left: edge.left, right: edge.right, time: time ? time.textContent : null };
    }));
  document.body.dataset.shown = JSON.stringify({ shown, legends, marked, width: document.body.scrollWidth });
});
</script>
</body>"""


def seen(page: Path, width: int, profile: Path) -> dict[str, Any]:
    """What the browser shows of a page after a click on the story's moment at 1 s and the cursor in the middle of a plot."""
    page.write_text(
        page.read_text(encoding="utf-8").replace("</body>", ACT.replace("WIDTH", str(width))),
        encoding="utf-8",
    )
    assert BROWSER is not None
    ran = subprocess.run(
        [
            BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
            f"--user-data-dir={profile}", "--window-size=1200,900", "--virtual-time-budget=4000", f"file://{page}",
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert "CONSOLE" not in ran.stderr
    told = re.search(r'data-shown="([^"]*)"', ran.stdout)
    assert told is not None
    content: dict[str, Any] = json.loads(told[1].replace("&quot;", '"'))
    return content


@pytest.mark.parametrize("width", [420, 1180])
def test_every_panel_is_drawn_with_aligned_edges_and_one_zoom_and_cursor(tmp_path: Path, width: int) -> None:
    folder = tmp_path / "run"
    faults = (parse("push.y@1=1"),)
    fly(Request.of(EXPERIMENTS["hover"], duration_s=3.0, faults=faults), folder)
    page = Page(write_report(folder).read_text(encoding="utf-8"))
    told = seen(folder / "report.html", width, tmp_path / "profile")
    panels = [name for name, plot in page.plots.items() for _ in plot["panels"]]
    assert [one["place"] for one in told["shown"]] == panels
    assert len({(one["left"], one["right"]) for one in told["shown"]}) == 1
    assert told["shown"][0]["right"] > width - 70
    assert told["width"] <= width, "nothing stands over the edge of the page"
    assert told["legends"] == "", "no value without a cursor"
    assert {how for name, how in told["marked"] if name in ("estimate", "command")} == {"dashed"}
    assert {how for name, how in told["marked"] if name in ("x", "flap 1")} == {"solid"}
    moved = [one["time"] for one in told["shown"] if one["place"] not in SELDOM and one["time"]]
    assert len(moved) > 10
    # the story's link shows 0.5 s before the moment to 1.5 s after it
    assert [float(time) for time in moved] == pytest.approx([1.5] * len(moved), abs=0.1)


def test_a_comparison_fits_a_phone_and_draws_every_panel(tmp_path: Path) -> None:
    for seed in (1, 2):
        fly(Request.of(EXPERIMENTS["hover"], duration_s=1.0, seed=seed), tmp_path / str(seed))
    a, b = (load_flown(tmp_path / str(seed)) for seed in (1, 2))
    page = write_comparison(tmp_path / "page", a, b, compare(a, b))
    with browser(tmp_path / "profile") as tab:
        for width in (390, 1180):
            tab.open(page.as_uri(), width)
            tab.until("document.querySelectorAll('.uplot canvas').length === 13")
            assert tab.value("document.documentElement.scrollWidth") <= width
        assert tab.errors == []
