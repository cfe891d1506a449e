"""What may be under way to a board in the loop, and what is sent again."""

from itertools import count

import pytest

from firmware_py.wire.core_port import SAMPLES, SAMPLES_MAX, Loop
from hil.board.sample_window import PACKETS, REPEAT_US, SAMPLES_MIN, WINDOW, SampleWindow


def report(used: int, waiting: int, lost: int = 0) -> Loop:
    return Loop(used & 0xFFFF, waiting, 2, 0, True, 0, 0, lost, *(0,) * 8)


def number(data: bytes | None) -> int | None:
    return None if data is None else SAMPLES.struct.unpack_from(data)[0]


def filled(samples: int, now_us: int = 0) -> tuple[SampleWindow, list[int]]:
    """A window after so many samples, a millisecond each, with the numbers of the packets."""
    window, numbers = SampleWindow(), []
    for at_ms in range(samples):
        window.put((at_ms, 0, 0))
        while (data := window.packet(at_ms * 1000)) is not None:
            numbers.append(number(data))
    return window, numbers


def test_packets_grow_with_those_in_flight_up_to_a_limit() -> None:
    window, numbers = filled(WINDOW)
    assert numbers == [0, 4, 9, 15]
    assert len(numbers) == PACKETS
    assert window.full
    assert window.batch == SAMPLES_MAX


def test_a_report_of_more_than_is_under_way_changes_nothing() -> None:
    window, _ = filled(5)
    assert window.on_report(report(1, 1), 0)
    for used, waiting in ((6, 0), (5, 1), (1, 5), (0, 2)):  # an older one, or another flight's
        assert not window.on_report(report(used, waiting), 0)
        assert (window.used, window.count, window.full) == (1, 5, False)
    assert window.on_report(report(5, 0), 0)


def test_a_window_is_full_until_the_board_has_taken_some() -> None:
    window, _ = filled(WINDOW - 1)
    assert not window.full
    window.put((0, 0, 0))
    assert window.full
    window.on_report(report(0, 15), 0)
    assert window.full
    assert window.on_report(report(1, 14), 0)
    assert not window.full


def test_acknowledgements_make_room_for_packets() -> None:
    window, _ = filled(WINDOW)
    assert window.packet(0) is None
    window.on_report(report(0, 9), 0)
    assert number(window.packet(0)) == 21
    assert number(window.packet(0)) is None


def test_behind_a_gap_all_is_sent_again() -> None:
    window, _ = filled(WINDOW)
    window.on_report(report(2, 2, lost=5), 0)
    assert window.repeated == PACKETS - 1
    assert [number(window.packet(0)) for _ in range(PACKETS)] == [4, 10, 16, 22]
    window.on_report(report(2, 2, lost=5), 0)
    assert window.repeated == PACKETS - 1


def test_without_news_all_is_sent_again_after_a_time() -> None:
    window, _ = filled(WINDOW)
    since_us = (SAMPLES_MIN - 1) * 1000
    assert window.packet(since_us + REPEAT_US - 1) is None
    assert number(window.packet(since_us + REPEAT_US)) == 0
    assert window.repeated == PACKETS
    window.on_report(report(0, 15), since_us + REPEAT_US)  # the first ones had arrived
    assert number(window.packet(since_us + REPEAT_US)) == 15
    told, _ = filled(WINDOW)
    told.on_report(report(0, 0), since_us + 1)  # a report without news
    assert number(told.packet(since_us + REPEAT_US)) == 0
    fed, _ = filled(WINDOW)
    fed.on_report(report(0, 9), since_us + 1)  # news, though it has taken none
    assert number(fed.packet(since_us + REPEAT_US)) == 21


def test_an_overtaken_acknowledgement_changes_nothing() -> None:
    window, _ = filled(18)
    assert window.on_report(report(10, 5), 0)
    assert not window.on_report(report(2, 3), 0)
    assert (window.used, window.packet(0)) == (10, None)


@pytest.mark.long
def test_numbers_go_on_behind_65535() -> None:
    window, samples = SampleWindow(), 70_000
    for now in range(samples):
        window.put((now % 7, 0, 0))
        if (data := window.packet(0)) is not None:
            assert number(data) == (now + 1 - SAMPLES_MIN) % 65536
            assert window.on_report(report(now + 1 - 2, 2), 0)
    assert window.used == samples - 2


def test_a_sample_is_packed_once_while_nothing_is_lost() -> None:
    window, ends = SampleWindow(), []
    clock = count()
    while window.count < 500:
        if not window.full:
            window.put((window.count % 5, 0, 0))
        if (data := window.packet(next(clock))) is not None:
            ends.append((number(data), number(data) + window.batch))
        if len(ends) > 2:
            window.on_report(report(ends[-3][1], 0), 0)
    assert [begin for begin, _ in ends[1:]] == [end for _, end in ends[:-1]]
    assert window.repeated == 0
