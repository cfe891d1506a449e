"""The launch clamp, on a robot that flies, fails and is put back at known instants."""

from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.wire.supervisor import State
from hil.emulator.events import EventQueue
from hil.servers.server import LaunchClamp


def clamped(**more: Any) -> tuple[Any, list[int], LaunchClamp]:
    signals = SimpleNamespace(supervisor=SimpleNamespace(state=State.WAITING))
    robot: Any = SimpleNamespace(
        events=EventQueue(), free=False, powered=True, body=SimpleNamespace(lost=None), caught=[], put=[],
        firmware=SimpleNamespace(signals=signals), config=SimpleNamespace(pilot=SimpleNamespace(enabled=False)),
    )  # fmt: skip
    robot.catch = lambda: robot.caught.append(robot.events.now_us)
    robot.put_back = robot.put.append
    vars(robot).update(more)
    released: list[int] = []

    def let_go(now_us: int) -> None:
        released.append(now_us)
        robot.free = True

    return robot, released, LaunchClamp(robot, let_go)


def flies(robot: Any, until_us: int, state: State = State.FLYING) -> None:
    robot.firmware.signals.supervisor.state = state
    robot.events.run(until_us)


@pytest.mark.parametrize("way", ["failsafe", "no power"])
def test_a_robot_is_released_once_it_has_flown_for_a_second_without_a_break(way: str) -> None:
    robot, released, _ = clamped()
    flies(robot, 495_000, State.WAITING)
    flies(robot, 1_450_000)
    robot.powered = way != "no power"
    flies(robot, 1_475_000, State.FAILSAFE if way == "failsafe" else State.FLYING)
    robot.powered = True
    flies(robot, 9_000_000)
    assert released == [2_480_000]


def test_a_lost_robot_is_put_back_a_second_later_and_flies_in_the_holder_anew() -> None:
    robot, released, clamp = clamped()
    flies(robot, 2_000_000)
    assert released == [1_010_000]
    clamp.put_back_later(2_000_000)
    robot.free, robot.body.lost = False, "floor"
    flies(robot, 2_995_000)
    assert (robot.caught, robot.put, released[1:]) == ([2_000_000], [], [])
    robot.body.lost = None
    flies(robot, 9_000_000)
    assert (robot.put, released[1:]) == ([3_000_000], [4_000_000])


def test_a_robot_that_stands_on_the_floor_is_released_at_once() -> None:
    robot, released, _ = clamped(config=SimpleNamespace(pilot=SimpleNamespace(enabled=True)))
    flies(robot, 100_000, State.WAITING)
    assert released == [10_000]
