"""The hash of a lockstep flight changes only with a reason in CHANGELOG: what flies here flew the same bytes before.

A change of any constant, sign, order or random stream of core, tasks, services, board, links, station, cameras, world,
faults and log shows here first. If one is meant, give the reason in CHANGELOG, and write the hashes anew:

    PYTHONPATH=tests python tests/hil/laboratory/test_reference_flights.py
"""

import io
import json
import sys
import tempfile
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest

import hil
from support.command import floaty

HASHES = Path(__file__).parents[2] / "vectors" / "flight_hashes.json"
MARKERS = {"markers.enabled": True}
POSES = (
    "mocap.dropout@0.1:0.1=0.5",
    "mocap.outlier@0.2:0.1",
    "mocap.swap@0.4:0.1",
    "mocap.freeze@0.6:0.1",
    "mocap.latency@0.8",
)
RADIO = (
    "radio.loss@0", "radio.uplink_loss@0.2", "radio.downlink_loss@0.2", "radio.bit_errors@0.3", "radio.jitter@0.4",
)  # fmt: skip
IMU = ("imu.bias.p@0", "imu.bias.q@0.2=-4", "imu.bias.r@0.3=7", "imu.noise@0.4", "imu.saturation@0.6")
SERVOS = (
    "servo.stuck.1@0.5", "servo.slow.2@0.1", "servo.trim.3@0.2", "servo.trim.4@0.3=-3", "battery.sag@0.2=0.5",
    "cpu.load@0.1",
)  # fmt: skip
AIR = ("wind.side_x@0.1", "wind.side_y@0.2", "wind.fan@0.5", "wind.occlusion@0.6", "wind.gusts@0.3")
PUSHES = (
    "push.x@0.1", "push.y@0.2=-1", "push.z@0.3", "push.roll@0.4", "push.pitch@0.5=-0.01", "push.yaw@0.6",
)  # fmt: skip
FLIGHTS: dict[str, tuple[str, dict[str, Any]]] = {
    "hover": ("hover", {"duration_s": 2.0}),
    "another seed": ("hover", {"seed": 7}),
    "turn with flaps through zero": ("yaw-step", {}),
    "sine": ("height-sine", {"duration_s": 2.5}),
    "square": ("y-square", {"seed": 2, "duration_s": 3.0}),
    "chirp": ("identify-chirp", {"seed": 3}),
    "multisines": ("identify", {"seed": 4}),
    "overload": ("overload", {}),
    "take-off": ("take-off-landing", {"duration_s": 3.0}),
    "poses go wrong": ("hover", {"faults": POSES}),
    "the radio goes wrong": ("hover", {"faults": (*RADIO, "radio.cut@0.7:0.1")}),
    "the gyro goes wrong": ("hover", {"faults": (*IMU, "imu.freeze@0.8:0.05", "imu.silent@0.9:0.05")}),
    "servos and supply go wrong": ("hover", {"faults": SERVOS}),
    "the air goes wrong": ("hover", {"faults": AIR}),
    "pushes": ("hover", {"faults": PUSHES}),
    "markers": ("hover", {"overrides": MARKERS, "faults": ("marker.hidden@0.2=2", "marker.swap@0.4", "marker.noise@0.8")}),
    "serial line": ("hover", {"link": "mavlink", "faults": ("serial.bit_errors@0.2", "serial.cut@0.6:0.1")}),
    "plain Python": ("hover", {"board": "python", "duration_s": 0.2}),
    "original": ("hover", {"profile": "original"}),
    "lqr": ("hover", {"profile": "lqr"}),
    "another shape": ("hover", {"profile": "design-best"}),
    "as flown": ("yaw-sine-0.10", {"profile": "as-flown"}),
}  # fmt: skip


PROJECTS = {"own law": "", "own robot": "--robot", "tilt rotor": "--tilt-rotor"}  # of `floaty new`


def hash_of(name: str, folder: Path) -> Any:
    """Return the hash of a flight; of several robots, the list."""
    options: dict[str, Any] = {"duration_s": 1.0}
    if name == TOGETHER:
        return [one.result.hash for one in hil.fly_swarm("hover", 2, folder / "run", **options).robots]
    if name in PROJECTS:
        command = ["new", str(folder / "project"), *PROJECTS[name].split()]
        with redirect_stdout(io.StringIO()):
            assert floaty(*command) == 0
        return hil.fly(
            "hover", folder / "run", profile=str(folder / "project" / "profile.toml"), **options
        ).result.hash
    experiment, more = FLIGHTS[name]
    return hil.fly(experiment, folder / "run", **options | more).result.hash


TOGETHER = "two robots"
ALL = (*FLIGHTS, *PROJECTS, TOGETHER)


@pytest.mark.parametrize("name", ALL)
def test_a_flight_has_the_hash_that_it_had(name: str, tmp_path: Path) -> None:
    assert hash_of(name, tmp_path) == json.loads(HASHES.read_text())[name]


def test_the_flights_differ() -> None:
    known = json.loads(HASHES.read_text())
    assert known.keys() == set(ALL)
    assert len({known[name] for name in (*FLIGHTS, *PROJECTS)}) == len(known) - 1


if __name__ == "__main__":
    found = {}
    for one in ALL:
        with tempfile.TemporaryDirectory() as place:
            found[one] = hash_of(one, Path(place))
    HASHES.write_text(json.dumps(found, indent=2) + "\n")
    sys.stdout.write(f"{HASHES}: {len(found)} flights\n")
