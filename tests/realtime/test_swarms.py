"""`floaty serve --boards 3`, a process per robot: Python boards side by side, and images that cflib's swarm flies."""

import os
import time
from pathlib import Path

import cflib.crtp
import numpy as np
import pytest
from cflib.crazyflie.swarm import CachedCfFactory, Swarm
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

from support.cflib_client import CflibClient
from support.plugged_dongle import plug
from support.serving import PATIENCE_S, serve
from support.watcher import watched

ELF = os.environ.get("FLOATY_STOCK_ELF", "")
NAMES = ("floaty", "floaty2", "floaty3")
LEGS = ((0.6, 0.0), (0.0, 0.6), (-0.6, 0.0), (0.0, -0.6))  # a square [m], in world axes
LEG_S, UP_S = 2.0, 3.0
START_S = 1.0  # from arming to the take-off
OFF = 0.15  # at the end of a leg at most [m]


@pytest.mark.alone  # three boards, their station and three watchers
def test_three_robots_fly_side_by_side_and_a_push_moves_the_one_it_is_typed_for(tmp_path: Path) -> None:
    arguments = ("--boards", "3", "--radio", "--radio-port", "0", "--station")
    with serve(*arguments, motive=True) as served:
        plug(served)
        for number in (1, 2, 3):
            served.wait_for(f"board {number}: released", PATIENCE_S)
        with watched(served, NAMES) as watchers:
            clients = [CflibClient(uri, tmp_path).ready() for uri in served.radio_uris]
            for client in clients:
                rows = client.rows(20, 10, "stateEstimate.y", "pm.vbat")
                assert all(3.0 < values["pm.vbat"] < 4.3 for _, values in rows)
            began_s = time.monotonic()
            served.type("2 push.y:0.3=0.3")
            served.wait_for(r"board 2: fault push\.y:0\.3=0\.3 ends", PATIENCE_S)
            moved = [np.ptp([f.p_WB[1] for t, f in one.frames if t > began_s]) for one in watchers]
            for client in clients:
                client.close()
        assert served.interrupt() == 0
    assert moved[1] > 3 * max(moved[0], moved[2])
    tracked = [np.mean([frame.valid for _, frame in one.frames]) for one in watchers]
    assert min(tracked) > 0.5  # a name that is another robot's, or nobody's, is never tracked
    assert not any("lost" in line for line in served.lines)


def square(scf: SyncCrazyflie) -> None:
    """What cflib's swarm examples do: up, four legs, down, with a sleep as long as each lasts."""
    scf.cf.supervisor.send_arming_request(True)
    time.sleep(START_S)
    commander = scf.cf.high_level_commander
    commander.takeoff(0.8, 2.0)
    time.sleep(UP_S)
    for x, y in LEGS:
        commander.go_to(x, y, 0.0, 0.0, LEG_S, relative=True)
        time.sleep(LEG_S)
    commander.land(0.0, 2.0)
    time.sleep(UP_S)
    commander.stop()


@pytest.mark.skipif(
    not ELF, reason="FLOATY_STOCK_ELF names no build of Bitcraze's firmware: no swarm was flown"
)
@pytest.mark.parametrize("link", ["radio", "udp"])
def test_three_images_fly_what_cflibs_swarm_commands_while_the_wall_clock_runs(
    link: str, tmp_path: Path
) -> None:
    ends = ("--radio", "--radio-port", "0") if link == "radio" else ("--udp", "0")
    with serve("--board", ELF, "--profile", "crazyflie", "--boards", "3", *ends, motive=True) as served:
        if link == "radio":
            plug(served)
        elif not cflib.crtp.CLASSES:
            cflib.crtp.init_drivers()
        for number in (1, 2, 3):
            served.wait_for(f"board {number}: STAB: Starting stabilizer loop", PATIENCE_S)
        uris = served.radio_uris if link == "radio" else served.udp_uris
        with (
            watched(served, NAMES) as watchers,
            Swarm(uris, CachedCfFactory(rw_cache=str(tmp_path))) as swarm,
        ):
            swarm.reset_estimators()
            began_s = time.monotonic()
            swarm.parallel_safe(square)
            ended_s = time.monotonic()
        assert served.interrupt() == 0
    for watcher, side in zip(watchers, (0.0, 0.5, -0.5), strict=True):
        goal, now_s = np.array((0.0, side, 0.8)), began_s + START_S + UP_S
        for x, y in LEGS:
            assert np.abs(watcher.near(now_s + 0.1) - goal)[:2].max() < OFF
            goal, now_s = goal + np.array((x, y, 0.0)), now_s + LEG_S
        assert np.abs(watcher.near(now_s + 0.1) - goal).max() < 2 * OFF
        assert np.abs(watcher.near(ended_s) - (0.0, side, 0.015)).max() < OFF
    assert not any("lost" in line for line in served.lines)
