"""What a flight loads: packages that it does not need would be most of its start."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

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
