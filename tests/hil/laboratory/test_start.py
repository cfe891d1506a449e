"""What a flight loads: packages that it does not need would be most of its start."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from hil.laboratory.request import Bench
from support.paths import ROOT

NEEDLESS = ["firmware_py.export.kernels", "pandas", "prompt_toolkit", "pyarrow.dataset", "scipy"]
FLY = f"""
import sys
from hil.commands.app import main
sys.argv = ["floaty", "fly", "hover", "--duration", "0.2", "--out", sys.argv[1]]
try:
    main()
finally:
    print([name for name in {NEEDLESS} if name in sys.modules])
"""


@pytest.mark.long
def test_a_flight_with_its_report_loads_nothing_needless(tmp_path: Path) -> None:
    assert all(map(importlib.util.find_spec, NEEDLESS))
    for folder in ("compiles", "loads"):  # what the first flight on a machine compiles, all others load
        command = [sys.executable, "-c", FLY, tmp_path / folder]
        ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert "/loads/log.parquet" in ran.stdout
    assert ran.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("link", "board", "asked"),
    [
        ("radio", "c", []),
        ("mavlink", "python", ["--link mavlink, mavlink: pymavlink"]),
        ("mavlink:pty", "c", ["--link mavlink:pty, mavlink: pymavlink serial"]),
        ("udp://127.0.0.1:1", "c", ["--link udp://127.0.0.1:1, radio: cflib"]),
        ("radio", "radio://0/80", ["--board radio://0/80, radio: cflib"]),
        ("radio", "cortex-m4", ["--board cortex-m4, deploy: unicorn elftools ziglang"]),
        ("mavlink", "cf2.bin", ["--link mavlink, mavlink: pymavlink", "--board cf2.bin, deploy: unicorn cffi elftools"]),
    ],
)  # fmt: skip
def test_a_flight_needs_the_packages_of_its_link_and_its_board_and_no_other(
    link: str, board: str, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[str] = []

    def require(what: str, extra: str, *packages: str) -> None:
        found.append(f"{what}, {extra}: {' '.join(packages)}")

    monkeypatch.setattr("hil.laboratory.request.require", require)
    Bench(link, board)._require_packages()
    assert found == asked
