"""What a flight loads: packages that it does not need would be most of its start."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent.parent
FLY = """
import sys
from pathlib import Path
from hil.experiments import find_experiment
from hil.laboratory.recorder import load_log
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures.report import write_report
folder = Path(sys.argv[1]) / "run"
fly(Request.of(find_experiment("hover"), duration_s=0.2), folder)
write_report(folder)
print(sorted({"firmware_py.export.kernels", "pandas", "scipy"} & set(sys.modules)), len(load_log(folder).to_pandas()))
"""


@pytest.mark.long
def test_a_flight_and_its_report_load_neither_pandas_nor_scipy_nor_the_translator_of_kernels_again(
    tmp_path: Path,
) -> None:
    assert importlib.util.find_spec("pandas")
    assert importlib.util.find_spec("scipy")
    for folder in ("compiles", "loads"):  # what the first flight on a machine compiles, all others load
        command = [sys.executable, "-c", FLY, tmp_path / folder]
        ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["[]", "120"]
