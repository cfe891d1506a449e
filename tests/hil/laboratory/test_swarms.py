"""Robots that fly together in lockstep: the same bits as alone, what they do to one another, trajectories of Crazyswarm2."""

import json
import math
import os
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from firmware_py.compiling import bound
from firmware_py.core.subset import i32
from firmware_py.firmware import Firmware
from hil.api import column, fly, fly_swarm, load_run
from hil.board.board_firmware import PowerOn, PythonBoard
from hil.emulator.crazyflie import syslink
from hil.errors import LabError
from hil.laboratory import lockstep
from hil.laboratory.experiments import find_experiment, find_experiments
from hil.laboratory.experiments.trajectories import BEGIN_S, in_csv
from hil.laboratory.swarms import flying
from hil.laboratory.swarms.request import swarm_of
from hil.testing.flights import Flights
from hil.world.neighbours import AIR_DENSITY, Neighbours, interact

ELF = os.environ.get("FLOATY_STOCK_ELF", "")
APART = ("swarm.spacing=1.5",)


def test_robots_apart_fly_bit_for_bit_as_alone(floaty: Flights, tmp_path: Path) -> None:
    swarm = floaty.fly_swarm("hover", 2, duration_s=0.5, overrides=APART, seed=3)
    alone = [
        fly("hover", tmp_path / f"{seed}", duration_s=0.5, overrides=APART, seed=seed) for seed in (3, 4)
    ]
    assert [one.hash for one in swarm.robots] == [one.hash for one in alone]
    assert swarm.metrics["distance_min"] == pytest.approx(1.5 * math.sqrt(2.0), abs=0.1)
    written = json.loads((swarm.folder / "swarm.json").read_text())
    assert written["hash"] == swarm.hash
    assert [one["hash"] for one in written["robots"]] == [one.hash for one in swarm.robots]
    with pytest.raises(LabError, match="in it, but in robot-1, robot-2; expected a run folder"):
        load_run(swarm.folder)
    pages = [swarm.folder / place / "report.html" for place in ("", "robot-1", "robot-2")]
    assert swarm.write_report() == pages[0]
    assert [page.is_file() for page in pages] == [True] * 3


class Talker(PythonBoard):
    """Sends one packet to the other boards at its first one from the ground, and prints theirs."""

    def boot(self, start: PowerOn) -> Firmware:
        firmware, sent = super().boot(start), []
        received = firmware.radio_received

        def hear(data: bytes, broadcast: bool = False) -> None:
            if broadcast:
                start.board.debug_write(f"peer says {data[2:].decode()}")
                return
            if not sent:
                sent.append(data)
                start.board.radio_command(syslink.PEER_BROADCAST, b"\x03hello")
            received(data)

        firmware.radio_received = hear
        return firmware


def test_boards_hear_what_the_others_send(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flying, "executor_of", lambda request, stack: Talker())
    request = swarm_of([find_experiment("hover")] * 3, duration_s=0.2, overrides=APART)
    result = flying.fly_swarm(request, tmp_path)
    for one in result.robots:
        events = (one.folder / "events.jsonl").read_text().splitlines()
        assert sum("peer says hello" in line for line in events) == 2


@pytest.mark.long
def test_ctrl_c_ends_each_robot_that_still_flies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(now_us: int, end_us: int) -> None:
        raise KeyboardInterrupt

    booted: list[Firmware] = []
    numbers: list[int] = []
    config = lockstep.factory_config
    monkeypatch.setattr(
        lockstep, "factory_config", lambda number, radio: numbers.append(number) or config(number, radio)
    )

    class Board(PythonBoard):
        def boot(self, start: PowerOn) -> Firmware:
            booted.append(PythonBoard().boot(start))
            if len(booted) == 1:
                booted[0].radio_received = lambda *_: 1 / 0
            return booted[-1]

    monkeypatch.setattr(flying, "executor_of", lambda request, stack: Board())
    request = swarm_of([find_experiment("hover")] * 3, duration_s=0.2, overrides=APART)
    result = flying.fly_swarm(request, tmp_path, stop)
    assert [one.outcome for one in result.robots] == ["error", "interrupted", "interrupted"]
    assert numbers == [1, 2, 3], "each with an address of its own"
    texts = [(one.folder / "events.jsonl").read_text() for one in result.robots]
    assert ["interrupted by the user" in text for text in texts] == [False, True, True]


def neighbours(*places: tuple[float, float, float], **settings: float) -> Neighbours:
    """Return robots of 30 g at places, after one computation."""
    block = Neighbours.allocate()
    near = block.fields
    near.count = i32(len(places))
    near.wake_radius, near.wake_spread, near.stiffness = 0.065, 0.1, 150.0
    for name, value in settings.items():
        setattr(near, name, value)
    for i, place in enumerate(places):
        near.flies[i], near.p_WB[i], near.lift_W[i] = 1.0, place, (0.0, 0.0, 0.2943)
    bound(interact, block)()
    return near


@pytest.mark.parametrize("below", [0.05, 0.5, 2.0])
def test_a_wake_carries_the_momentum_of_the_thrust(below: float) -> None:
    rings = np.linspace(0.0, 1.5, 15)
    near = neighbours((0.0, 0.0, 3.0), *((r, 0.0, 3.0 - below) for r in rings), wake=1.0)
    speeds = -near.wake_W[1:16, 2]
    width = 0.065 + 0.1 * below
    assert speeds[1:4] == pytest.approx(speeds[0] * np.exp(-((rings[1:4] / width) ** 2)), rel=1e-6, abs=1e-9)
    momentum_flow = AIR_DENSITY * np.pi * width**2 * speeds[0] ** 2 / 2  # of a Gaussian profile
    assert momentum_flow == pytest.approx(0.2943)
    assert not neighbours((0.0, 0.0, 1.0), (0.0, 0.0, 1.5), wake=1.0).wake_W[1].any()  # above it


@pytest.mark.long
@pytest.mark.parametrize("seed", range(20))
def test_wakes_contacts_and_the_nearest_two_are_those_of_the_formulas_for_vectors(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 2 + seed % 4
    flies = np.r_[True, True, rng.random(count - 2) < 0.7]
    p, v, lift = rng.normal(0.0, 0.06, (count, 3)), rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    block = Neighbours.allocate()
    near = block.fields
    near.count, near.radius, near.stiffness, near.damping = i32(count), 0.07, 150.0, 2.0
    near.wake, near.wake_radius, near.wake_spread = 0.9, 0.065, 0.1
    near.flies[:count], near.p_WB[:count], near.v_WB[:count], near.lift_W[:count] = flies, p, v, lift
    wakes, touches, distances = np.zeros((count, 3)), np.zeros((count, 3)), {}
    for a, b in permutations(np.flatnonzero(flies).tolist(), 2):
        away, thrust = p[b] - p[a], np.linalg.norm(lift[a])
        distance, down = np.linalg.norm(away), -lift[a] / thrust
        distances[distance] = sorted((a, b))
        force = 150.0 * (0.14 - distance) - 2.0 * (v[b] - v[a]) @ away / distance
        touches[b] += (distance < 0.14) * max(force, 0.0) * away / distance
        width = 0.065 + 0.1 * (away @ down)
        speed = 0.9 * math.sqrt(2.0 * thrust / (AIR_DENSITY * math.pi)) / width
        aside = np.linalg.norm(np.cross(away, down))
        wakes[b] += (away @ down > 0.0) * speed * math.exp(-((aside / width) ** 2)) * down
    for _ in range(2):  # nothing is left of the time before
        bound(interact, block)()
    assert near.touch_W[:count] == pytest.approx(touches, abs=1e-9)
    assert near.wake_W[:count] == pytest.approx(wakes, abs=1e-9)
    assert (near.least, [near.one, near.other]) == (pytest.approx(min(distances)), distances[min(distances)])


@pytest.mark.skipif(
    not ELF, reason="FLOATY_STOCK_ELF names no build of Bitcraze's firmware: no swarm was flown"
)
def test_the_wake_of_a_stock_crazyflie_presses_the_one_below(tmp_path: Path) -> None:
    places = "swarm.places=[[0.0, 0.0, 0.6], [0.0, 0.02, 0.0]]"
    flown = [
        fly_swarm("hover", 2, tmp_path / wake, duration_s=10.0, profile="crazyflie", board=ELF,
                  overrides=(places, f"swarm.wake={wake}"))
        for wake in ("1", "0")
    ]  # fmt: skip
    lift = [
        np.mean(column(one.robots[1].free, *(f"rotor.thrust_{i}" for i in (1, 2, 3, 4)))[500:700].sum(1))
        for one in flown
    ]
    assert lift[0] > 1.05 * lift[1]


ROW = "2,1,0,0.5,0,0,0,0,0,0,1,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0.5,0,0,0,0,0,0,0"


def test_a_trajectory_of_crazyswarm_counts_from_the_robot(tmp_path: Path) -> None:
    path = tmp_path / "figure 8.csv"
    path.write_text(f"duration,x^0,x^1\n{ROW}\n1{ROW[1:]}\n")
    experiment = in_csv(path)
    assert experiment.name == "figure-8"
    pieces = experiment.trajectory.path  # type: ignore[attr-defined]
    assert pieces(0.0) == [0.0, 0.0, 0.0, 0.5]
    assert pieces(BEGIN_S + 1.5) == pytest.approx([0.5 * 1.5**2, 1.5, 0.0, 0.5])
    assert pieces(BEGIN_S + 2.5) == pytest.approx([0.125, 0.5, 0.0, 0.5])  # of the second piece
    assert pieces(99.0) == pieces(BEGIN_S + 3.0)
    for name in ("traj10.csv", "traj2.csv"):
        (tmp_path / name).write_text(ROW)
    assert [one.name for one in find_experiments(str(tmp_path), 3)] == ["figure-8", "traj2", "traj10"]
    path.write_text(f"{ROW}\n1,2,x\n")
    with pytest.raises(LabError, match=r"figure 8.csv:2: 3 values: expected 33 numbers"):
        in_csv(path)
