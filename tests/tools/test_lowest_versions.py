"""The lowest versions that `pyproject.toml` admits fly, report, export, design and learn."""

import subprocess
import sys
from pathlib import Path

import pytest

from support.installed_wheel import run
from support.policies import network, write_onnx

ROOT = Path(__file__).parents[2]
EXTRAS = "radio,mavlink,view,identify,export,design,deploy,policy,campaign,learn"
UNREACHABLE = ("Failed to fetch", "network was disabled", "error sending request")
IMPORT_ALL = """
from importlib import import_module
from pkgutil import walk_packages
import firmware_py, ground_station, hil
for package in (firmware_py, ground_station, hil):
    for module in walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.startswith("hil.testing.") and not module.name.endswith("__main__"):
            import_module(module.name)
"""
LEARN = """
import gymnasium, hil.research.learn
env = gymnasium.make("floaty/Hover-v0", duration_s=0.5)
env.reset(seed=1)
env.step(env.action_space.sample())
"""
CAMPAIGN = """
experiments = ["hover"]
flights = 2
duration_s = 0.5
[parameters]
"actuators.tau" = { uniform = [0.04, 0.06] }
"""


def uv(*arguments: str | Path) -> None:
    """Run uv; skip where it reaches no index."""
    ended = subprocess.run(
        [sys.executable, "-m", "uv", *map(str, arguments)], capture_output=True, text=True, check=False
    )
    if any(sign in ended.stderr for sign in UNREACHABLE):
        pytest.skip(f"no package index: {ended.stderr.splitlines()[0]}")
    assert ended.returncode == 0, ended.stderr


@pytest.mark.long
@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="the lowest versions have wheels for Python 3.11")
@pytest.mark.parametrize("extras", ["", EXTRAS])
def test_the_lowest_versions_fly(extras: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    uv("venv", "--quiet", "--python", sys.executable, tmp_path / "lowest")
    python = tmp_path / "lowest" / "bin" / "python"
    project = f"{ROOT}[{extras}]" if extras else str(ROOT)
    uv("pip", "install", "--quiet", "--python", python, "--resolution", "lowest-direct", project)
    monkeypatch.setenv("FLOATY_CACHE_DIR", str(tmp_path / "compiled"))
    monkeypatch.chdir(tmp_path)

    def floaty(*arguments: str | Path, code: int = 0) -> str:
        return run(tmp_path, python, "-m", "hil.commands", *arguments, code=code).stdout

    link = ("--link", "mavlink", "--perfetto") if extras else ()
    assert "completed" in floaty("fly", "hover", "--duration", "1", "--out", "run", *link)
    floaty("report", "run")
    floaty("new", "mylaw")
    if not extras:
        return
    floaty("export", "run", "--csv", "--mcap", "--tlog", "--video", "--gif")
    floaty("policy", write_onnx(tmp_path / "net.onnx", network()), "--out", "law")
    floaty("design")
    floaty("identify", "run", code=2)  # no excitation: no constant to identify
    (tmp_path / "few.toml").write_text(CAMPAIGN)
    floaty("campaign", "few.toml", "--workers", "1")
    run(tmp_path, python, "-c", LEARN)
    run(tmp_path, python, "-c", IMPORT_ALL)
