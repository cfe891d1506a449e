"""An image over a real link: the ground station's process connects, sets what the experiment wants, and flies it."""

import os
from pathlib import Path

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")
pytest.importorskip("cflib")

from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.recorder import load_events
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.servers.linked import linked_flight

ELF = os.environ.get("FLOATY_CF2_ELF", "")


@pytest.mark.skipif(
    not ELF, reason="FLOATY_CF2_ELF names no build of the Crazyflie firmware: no image was flown"
)
def test_a_station_sets_what_the_experiment_wants_and_flies_the_image(tmp_path: Path) -> None:
    """How well it flies hangs on whether the machine keeps up with the wall clock, which is told."""
    request = Request.of(find_experiment("yaw-step"), duration_s=2.0, board=ELF, link="udp://127.0.0.1:19853")
    result = fly(request, tmp_path, flight_of=linked_flight)
    assert result.outcome in ("completed", "lost"), result.cause
    texts = [event["text"] for event in load_events(tmp_path)]
    assert "set RandConsts.openMin -0.192, was 0" in texts
    assert "set extCtrl.limU3 0.6, was 0.46" in texts
    assert texts.index("set RandConsts.openMin -0.192, was 0") < texts.index("released")
