"""The documentation as a site: it builds without a warning, loads nothing from elsewhere, and is searched from the disk."""

import html
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from support.paths import ROOT

BROWSER = shutil.which("chromium")
pytestmark = pytest.mark.long
LOADED = re.compile(
    r"<(?:script|img|iframe|link|source)\b[^>]*?\b(?:src|href|srcset)=\"((?:https?:)?//[^\"]+)\""
)
IN_STYLES = re.compile(r"(?:url\(|@import )[\"']?((?:https?:)?//[^\"')]+)")
SEARCH = """
<script>
addEventListener("load", async () => {
  const field = document.querySelector(".md-search__input");
  field.focus();
  field.value = "WORDS";
  field.dispatchEvent(new Event("keyup"));
  const results = () => [...document.querySelectorAll(".md-search-result__link")].map((link) => link.getAttribute("href"));
  for (let wait = 0; wait < 40 && results().length === 0; wait++) await new Promise((done) => setTimeout(done, 250));
  document.body.dataset.seen = JSON.stringify({
    results: results(),
    shown: field.checkVisibility(),
    loaded: performance.getEntriesByType("resource").map((entry) => entry.name),
  });
});
</script>
</body>"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("documentation") / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    silent = {"NO_MKDOCS_2_WARNING": "1", "DISABLE_MKDOCS_2_WARNING": "true"}
    ran = subprocess.run(command, cwd=ROOT, env=os.environ | silent, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return folder


def test_the_reference_is_that_of_the_code(site: Path) -> None:
    reference = site / "reference"
    assert "--perfetto" in (reference / "cli.html").read_text(encoding="utf-8")
    assert "mocap.dropout" in (reference / "faults.html").read_text(encoding="utf-8")
    assert "controller.gain_y" in (reference / "profile.html").read_text(encoding="utf-8")
    assert "extCtrl.y_P" in (reference / "parameters.html").read_text(encoding="utf-8")
    assert "truth.qw" in (reference / "log.html").read_text(encoding="utf-8")
    assert "load_run" in (reference / "api.html").read_text(encoding="utf-8")


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    named = {
        (path.name, address)
        for pattern, kind in ((LOADED, "*.html"), (IN_STYLES, "*.html"), (IN_STYLES, "*.css"))
        for path in site.rglob(kind)
        for address in pattern.findall(path.read_text(encoding="utf-8"))
    }
    assert named == set()


@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")
@pytest.mark.parametrize("place", ["index.html", "howto/boards.html"])
def test_a_page_on_disk_finds_words_and_loads_only_files(site: Path, tmp_path: Path, place: str) -> None:
    page = site / place
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace("</body>", SEARCH.replace("WORDS", "watchdog reset")), encoding="utf-8")
    assert BROWSER is not None
    try:
        ran = subprocess.run(
            [
                BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
                f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1200,900", "--virtual-time-budget=15000",
                page.as_uri(),
            ],
            capture_output=True, text=True, timeout=120, check=True,
        )  # fmt: skip
    finally:
        page.write_text(text, encoding="utf-8")
    found = re.search(r'data-seen="([^"]*)"', ran.stdout)
    assert found is not None
    seen: dict[str, Any] = json.loads(html.unescape(found[1]))
    assert seen["shown"]
    assert any("howto/boards.html" in result for result in seen["results"])
    assert [name for name in seen["loaded"] if not name.startswith("file://")] == []
    assert "CONSOLE" not in ran.stderr, ran.stderr[-2000:]
