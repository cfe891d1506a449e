"""What the station says about poses that it does not use, in whole lines."""

import pytest

from ground_station.unused import GATHER_US, Event, Reason, UnusedPoses

START_US = 10_000_000


def lines(poses: UnusedPoses, until_us: int) -> list[str]:
    """Return the lines until an instant; used frames go on arriving."""
    said = []
    for now_us in range(START_US + 1000, until_us, GATHER_US // 4):
        poses.note(now_us, now_us - 8000, None)
        said += poses.due()
    return said


@pytest.fixture
def poses() -> UnusedPoses:
    poses = UnusedPoses()
    poses.note(START_US - 2_500_000, START_US - 2_508_000, None)
    return poses


@pytest.mark.parametrize(
    ("exposed_us", "line"),
    [
        (START_US - 8000, "motion capture: track restarted after 2.5 s"),
        (START_US + 3_992_000, "motion capture: track restarted after 2.5 s: the frames' clock jumped forward by 4.0 s"),
        (START_US - 3_008_000, "motion capture: track restarted after 2.5 s: the frames' clock jumped back by 3.0 s"),
    ],
)  # fmt: skip
def test_a_restart_after_silence_is_one_line(poses: UnusedPoses, exposed_us: int, line: str) -> None:
    poses.note(START_US, exposed_us, None, Event.RESTARTED)
    assert poses.due() == []  # more may follow
    assert lines(poses, START_US + 3 * GATHER_US) == [line]


def test_a_loss_is_reported_once_even_if_frames_are_used_again(poses: UnusedPoses) -> None:
    poses.note(START_US, START_US - 8000, (Reason.NOT_TRACKED, ()), Event.LOST)
    assert lines(poses, START_US + 3 * GATHER_US) == ["motion capture: track lost"]
    assert poses.summary() == f"1 unusable: 1 {Reason.NOT_TRACKED.word}"


@pytest.mark.parametrize(
    ("reason", "shown"),
    [(Reason.MISTIMED, (5.0,)), (Reason.DEVIATES, (7.0, 40.0)), (Reason.SCATTERED, (7.0, 40.0)), (Reason.LATE, (7.0,))],
)  # fmt: skip
def test_reasons_are_gathered_with_their_counts_and_the_latest_or_largest_values(
    poses: UnusedPoses, reason: Reason, shown: tuple[float, ...]
) -> None:
    for values in ((3.0, 40.0), (7.0, 30.0), (5.0, 20.0)):
        poses.note(START_US, START_US - 8000, (reason, values[: len(shown)]))
    poses.note(START_US + 1, START_US - 8000, (Reason.ABSENT, ()))
    (line,) = lines(poses, START_US + 3 * GATHER_US)
    first, second = line.removeprefix("motion capture: ").split("; ")
    assert first == f"3 poses {reason.line.format(*shown)}"
    assert second == f"1 pose {Reason.ABSENT.line}"
    assert poses.summary() == f"4 unusable: 3 {reason.word}, 1 {Reason.ABSENT.word}"
    assert lines(poses, START_US + 9 * GATHER_US) == []  # nothing is said twice
