"""What robots of a swarm do to one another between two turns, where they stand, and what their common result says."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS, find_experiment
from hil.laboratory.lockstep import ModelledLine
from hil.laboratory.swarms.flying import SHOWN_US, SLICE_US, Crowd, _fly_in_turn
from hil.laboratory.swarms.folder import other_swarm_in, swarm_folder, swarm_reserved
from hil.laboratory.swarms.request import SwarmRequest, places_of, swarm_of
from hil.laboratory.swarms.result import SWARM, Nearest, SwarmResult, folder_name, write_swarm
from hil.world.config import SwarmConfig

ORIGINS = ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0), (-4.0, 5.0, -6.0))
RELEASE_US = 2_000_000


class Line(ModelledLine):
    """A line that notes what its board hears; `say` sends to the other boards."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, bytes]] = []

    def join(self, to_peers: Any) -> None:
        self.say = to_peers

    def hear_peer(self, now_us: int, packet: bytes) -> None:
        self.heard.append((now_us, packet))


class Flown:
    """A robot at a place in its own frame that notes what the others do to it."""

    def __init__(self, p: tuple[float, float, float], turn: Rotation, lift: float) -> None:
        self.advanced: list[int] = []
        self.winds: list[tuple[float, ...]] = []
        self.touches: list[list[float]] = []
        self.line, self.over = Line(), False
        body = SimpleNamespace(
            advance=self.advanced.append, q_WB=turn.as_quat(scalar_first=True), lift=lift, p_WB=np.array(p),
            state=np.array([*p, 0.1, 0.2, 0.3]), tunnel=SimpleNamespace(set_wake=lambda *wind: self.winds.append(wind)),
        )  # fmt: skip
        self.body = body
        self.robot = SimpleNamespace(body=body, touch=self.touches.append, free=True)
        self.flight = SimpleNamespace(robot=self.robot, line=self.line, release_us=RELEASE_US)


def crowd_of(*flown: Flown, still_air: bool = True, **settings: float) -> tuple[Crowd, Any]:
    config: Any = SimpleNamespace(**{**SwarmConfig(wake=1.5).model_dump(), **settings})
    request: Any = SimpleNamespace(config=config, origins=ORIGINS[: len(flown)], still_air=still_air)
    crowd = Crowd(request, list(flown))  # type: ignore[arg-type]
    return crowd, crowd._neighbourhood.near


def test_every_robot_is_in_the_room_with_its_place_speed_and_the_lift_along_its_own_axis() -> None:
    turns = Rotation.random(3, rng=np.random.default_rng(5))
    lifts = (0.2, 1.2, -0.3)
    flown = [Flown((0.1 * n, 0.2 * n, 0.3), turns[n], lifts[n]) for n in range(3)]
    crowd, near = crowd_of(*flown)
    crowd.exchange(4_000)
    for n, one in enumerate(flown):
        assert near.p_WB[n] == pytest.approx(one.body.p_WB + ORIGINS[n])
        assert near.v_WB[n] == pytest.approx([0.1, 0.2, 0.3])
        assert near.lift_W[n] == pytest.approx(turns[n].apply([0.0, 0.0, lifts[n]]))
        assert one.advanced == [4_000]
    assert (near.wake, crowd_of(*flown, still_air=False)[1].wake) == (1.5, 0.0)


def test_a_contact_and_a_wake_end_once_and_the_least_distance_stays() -> None:
    upright = Rotation.identity()
    flown = [Flown(p, upright, 0.3) for p in ((0.0, 0.0, 1.0), (-0.9, -2.0, -2.0), (99.0, 0.0, 0.0))]
    crowd, _ = crowd_of(*flown)  # the second is 0.1 m beside the first
    flown[2].robot.free = False
    crowd.exchange(RELEASE_US)
    assert crowd.nearest is None  # before all are free
    assert flown[0].touches[0][0] < 0.0 < flown[1].touches[0][0]
    assert flown[2].touches == flown[2].winds == []
    flown[2].robot.free = True
    flown[1].body.p_WB = np.array((-0.88, -2.0, -2.0))
    crowd.exchange(RELEASE_US + 500_000)
    flown[1].body.p_WB = np.array((40.0, 0.0, 0.0))
    for _ in range(2):
        crowd.exchange(RELEASE_US + 900_000)
    for one in flown[:2]:
        assert len(one.touches) == len(one.winds) == 3  # both contacts, and their end
        assert one.touches[-1] == [0.0, 0.0, 0.0]
        assert one.winds[-1] == (0.0, 0.0, 0.0)
    nearest = crowd.nearest
    assert nearest is not None
    assert (nearest.distance, nearest.robots, nearest.at_s) == (pytest.approx(0.12), (1, 2), 0.5)
    assert str(nearest) == "robots 1 and 2, 0.50 s after the release"


def test_a_wake_alone_and_a_contact_alone_are_felt() -> None:
    upright = Rotation.identity()
    for below, wake, touch in (((0.0, 0.0, 0.3), True, False), ((0.1, 0.0, 1.0), False, True)):
        origin = np.array(ORIGINS[1])
        flown = [Flown((0.0, 0.0, 1.0), upright, 0.3), Flown(tuple(np.array(below) - origin), upright, 0.3)]
        crowd, _ = crowd_of(*flown)
        crowd.exchange(RELEASE_US)
        assert any(map(any, flown[1].winds)) == wake
        assert any(map(any, flown[1].touches)) == touch


def test_packets_go_to_all_others_that_still_fly_once() -> None:
    flown = [Flown((float(n), 0.0, 0.0), Rotation.identity(), 0.3) for n in range(3)]
    crowd, near = crowd_of(*flown)
    flown[0].line.say(5, b"first")
    crowd.exchange(10)
    flown[2].over = True
    flown[1].line.say(12, b"second")
    flown[2].line.say(13, b"third")
    crowd.exchange(20)
    third = (20, b"third")
    heard = [[(20, b"second"), third], [(10, b"first"), third], [(10, b"first")]]
    assert [one.line.heard for one in flown] == heard
    assert (near.flies[:3].tolist(), flown[2].advanced) == ([1.0, 1.0, 0.0], [10])


def test_places_are_a_v_with_even_robots_on_the_left_or_the_first_of_the_profile() -> None:
    assert places_of(SwarmConfig(spacing=0.5), 5) == [
        (0.0, 0.0, 0.0), (-0.5, 0.5, 0.0), (-0.5, -0.5, 0.0), (-1.0, 1.0, 0.0), (-1.0, -1.0, 0.0),
    ]  # fmt: skip
    given = SwarmConfig(places=ORIGINS)
    assert [places_of(given, count) for count in (2, 3)] == [[*ORIGINS[:2]], [*ORIGINS]]
    with pytest.raises(LabError, match=r"3 places, expected one for each of 4 robots"):
        places_of(given, 4)


def test_robots_have_seeds_in_turn_their_own_homes_and_the_longest_duration() -> None:
    hover, step = find_experiment("hover"), EXPERIMENTS["yaw-step"]
    swarm = swarm_of(
        [hover, replace(step, duration_s=hover.duration_s + 0.25), hover],
        seed=7,
        overrides=("tunnel.fan_factor=0", "swarm.spacing=0.1"),
    )
    assert [one.seed for one in swarm.robots] == [7, 8, 9]
    assert [one.duration_s for one in swarm.robots] == [hover.duration_s + 0.25] * 3
    homes = np.array([one.config.flight.home for one in swarm.robots])
    assert swarm.still_air
    assert homes - homes[0] == pytest.approx(np.array(places_of(swarm.config, 3)))
    assert swarm.origins == ((0.0, 0.0, 0.0),) * 3
    blown = swarm_of([hover] * 16)
    assert (blown.still_air, [*blown.origins]) == (False, places_of(blown.config, 16))
    for count in (1, 17):
        with pytest.raises(LabError, match=f"--robots {count}: expected 2 to 16"):
            swarm_of([hover] * count)


@pytest.mark.parametrize(("held", "asked", "other"), [
    (0, 2, "something else"), (12, 2, "another flight (of 12 robots)"), (2, 3, "another flight (of 2 robots)"),
])  # fmt: skip
def test_a_flight_of_another_number_of_robots_is_not_replaced(
    tmp_path: Path, held: int, asked: int, other: str
) -> None:
    request = swarm_of([find_experiment("hover")] * asked)
    assert other_swarm_in(tmp_path, request) == other_swarm_in(tmp_path / "none", request) == ""
    for number in range(1, held + 1):
        (tmp_path / f"robot-{number}").mkdir()
    (tmp_path / "swarm.json").touch()
    assert other_swarm_in(tmp_path, request) == other


def result_of(folder: Path, outcomes: tuple[str, ...], distance: float | None) -> SwarmResult:
    request: Any = SwarmRequest(
        (SimpleNamespace(config=SimpleNamespace(swarm=SwarmConfig())),) * 3, ORIGINS, True
    )  # type: ignore[arg-type]
    robots: Any = tuple(
        SimpleNamespace(
            outcome=outcome, passed=True, hash=hashed, folder=folder / f"robot-{n}", cause=f"why {n}",
            request=SimpleNamespace(experiment=SimpleNamespace(name=f"e{n}"), seed=n),
        )
        for n, (outcome, hashed) in enumerate(zip(outcomes, "bac", strict=True), 1)
    )  # fmt: skip
    return SwarmResult.of(
        request, folder, robots, None if distance is None else Nearest(distance, (1, 3), 0.5)
    )


@pytest.mark.parametrize(("outcomes", "worst"), [
    (("completed", "reset", "completed"), "reset"), (("lost", "reset", "completed"), "lost"),
    (("lost", "error", "reset"), "error"), (("interrupted", "error", "lost"), "interrupted"),
])  # fmt: skip
def test_the_worst_robot_gives_the_outcome(tmp_path: Path, outcomes: tuple[str, ...], worst: str) -> None:
    assert result_of(tmp_path, outcomes, 1.0).outcome == worst


@pytest.mark.parametrize(
    ("distance", "passed"), [(0.15, True), (0.1499, False), (None, False), (np.inf, False)]
)
def test_a_swarm_passes_from_its_least_distance_on_and_its_file_says_so(
    tmp_path: Path, distance: float | None, passed: bool
) -> None:
    result = result_of(tmp_path, ("completed",) * 3, distance)
    assert result.passed == passed
    write_swarm(result)
    written = json.loads((tmp_path / "swarm.json").read_text())
    known = distance if distance is not None and np.isfinite(distance) else None
    assert (written["passed"], written["metrics"]["distance_min"]) == (passed, known)
    assert written["limits"] == {"distance_min": 0.15}
    nearest = None if known is None else {"distance": distance, "robots": [1, 3], "at_s": 0.5}
    assert (written["outcome"], written["hash"], written["nearest"]) == ("completed", result.hash, nearest)
    assert written["robots"] == [
        {
            "folder": f"robot-{n}", "origin": list(ORIGINS[n - 1]), "experiment": f"e{n}", "seed": n,
            "outcome": "completed", "cause": f"why {n}", "passed": True, "hash": "bac"[n - 1],
        }
        for n in (1, 2, 3)
    ]  # fmt: skip
    swapped = replace(result, robots=result.robots[::-1])
    assert swapped.hash != result.hash


def test_a_swarm_is_named_by_its_first_robot_and_gets_the_first_folder_that_holds_no_other(
    tmp_path: Path,
) -> None:
    request = swarm_of([EXPERIMENTS["pushes"], EXPERIMENTS["hover"], EXPERIMENTS["pushes"]], seed=7)
    assert request.title == "pushes, hover, 3 robots, seeds 7 to 9"
    assert swarm_folder(request, tmp_path) == tmp_path / "pushes-7-x3"
    (tmp_path / "pushes-7-x3" / "notes").mkdir(parents=True)
    assert swarm_folder(request, tmp_path) == tmp_path / "pushes-7-x3-2"
    (tmp_path / "pushes-7-x3-2").mkdir()
    assert swarm_folder(request, tmp_path) == tmp_path / "pushes-7-x3-2", "an empty folder is free"
    for number in (1, 2):
        (tmp_path / "pushes-7-x3-2" / folder_name(number)).mkdir()
    (tmp_path / "pushes-7-x3-2" / SWARM).touch()
    assert swarm_folder(request, tmp_path) == tmp_path / "pushes-7-x3-3"
    with (
        pytest.raises(LabError, match=r"--out .*/pushes-7-x3: holds something else: choose another folder"),
        swarm_reserved(request, tmp_path / "pushes-7-x3"),
    ):
        raise AssertionError
    (tmp_path / "pushes-7-x3-2" / folder_name(3)).mkdir()
    (tmp_path / "pushes-7-x3-2" / folder_name(3) / "something").touch()
    assert other_swarm_in(tmp_path / "pushes-7-x3-2", request), "robot 3's folder holds something"


class Turn:
    """A robot that flies to its end, and notes what is asked of it."""

    def __init__(self, name: str, end_us: int, asked: list[tuple[Any, ...]]) -> None:
        self.flight, self.over = SimpleNamespace(end_us=end_us), False
        self._note = lambda *what: asked.append((name, *what))

    def begin(self) -> None:
        self._note("begins")

    def fly_to(self, now_us: int) -> None:
        self._note(now_us)
        self.over = now_us >= self.flight.end_us

    def interrupt(self) -> None:
        self._note("interrupted")


@pytest.mark.parametrize("stopped_us", [None, 2 * SLICE_US])
def test_robots_fly_in_turn_to_the_last_one_s_end_and_ctrl_c_ends_them_all(stopped_us: int | None) -> None:
    asked, shown = list[Any](), list[tuple[int, int]]()
    ends = {"a": SHOWN_US, "b": 2 * SHOWN_US, "c": SHOWN_US}

    def exchange(now_us: int) -> None:
        asked.append(("all", now_us))
        if now_us == stopped_us:
            raise KeyboardInterrupt

    started: Any = [Turn(name, end_us, asked) for name, end_us in ends.items()]
    crowd: Any = SimpleNamespace(exchange=exchange)
    _fly_in_turn(started, crowd, lambda now_us, end_us: shown.append((now_us, end_us)))
    last_us = stopped_us or 2 * SHOWN_US
    turns = [(name, now_us) for now_us in range(SLICE_US, last_us + 1, SLICE_US) for name in (*ends, "all")]
    ended = [(name, "interrupted") for name in ends if stopped_us]
    assert asked == [*((name, "begins") for name in ends), *turns, *ended]
    assert shown == [(now_us, 2 * SHOWN_US) for now_us in range(SHOWN_US, last_us + 1, SHOWN_US)]


@pytest.mark.parametrize("replaced", [False, True])
def test_the_folder_of_every_robot_is_locked_in_turn_and_replaced_if_all_are(
    replaced: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    locked: list[Any] = []
    monkeypatch.setattr(
        "hil.laboratory.swarms.folder.reserved", lambda *what: locked.append(what) or nullcontext()
    )
    with swarm_reserved(SimpleNamespace(robots=("a", "b")), tmp_path, replaced):  # type: ignore[arg-type]
        assert locked == [(one, tmp_path / folder_name(n), replaced) for n, one in enumerate("ab", 1)]
