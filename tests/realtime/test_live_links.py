"""Laws of every link to a board in real time, each against a served robot that is held at its place.

What the links say on the wire is judged in `tests/conformance/test_links.py`; here it is how they live: opening, silence,
closing, and who waits for whom.
"""

import time
from collections.abc import Callable, Iterator

import pytest

from firmware_py.wire.supervisor import State
from firmware_py.wire.telemetry import Sample
from ground_station.clock import clock_us
from ground_station.config import LinkSettings
from ground_station.errors import LinkError
from ground_station.links.live_link import SILENCE_TIMEOUT_US, LiveLink
from ground_station.links.schemes import find_link
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal
from support.plugged_dongle import plug
from support.serving import PATIENCE_S, Served, serve

SETTINGS = LinkSettings(50.0, 2_000, 921_600, b"")
HOME = Goal((0.0, 0.0, 0.0), 0.0)
ENDS: dict[str, tuple[str, ...]] = {
    "radio": ("--radio", "--radio-port", "0"),
    "udp": ("--udp", "0"),
    "mavlink pty": ("--mavlink", "pty"),
    "mavlink tcp": ("--mavlink", "tcp:0"),
}


def uri_of(served: Served, end: str) -> str:
    """What `floaty station --link` would be told."""
    if end == "radio":
        plug(served)
        return served.radio_uris[0]
    if end == "udp":
        return served.udp_uris[0]
    return "mavlink:" + served.line("mavlink ")[0].replace("tcp:", "socket://")


@pytest.fixture(scope="module", params=ENDS)
def uri(request: pytest.FixtureRequest) -> Iterator[str]:
    """An end of a served board."""
    with serve(*ENDS[request.param]) as served:
        yield uri_of(served, request.param)


@pytest.fixture
def link(uri: str) -> Iterator[LiveLink]:
    """A link to it, not open yet."""
    link = find_link(uri, SETTINGS)
    yield link
    link.close()


def wait_until(reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def samples(link: LiveLink) -> list[Sample]:
    return [sample for now_us, data in link.received() for sample in link.receive(now_us, data)]


def fresh(x_m: float, age_us: int = 20_000) -> MocapFrame:
    return MocapFrame(clock_us() - age_us, (x_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), True)


def test_an_open_link_receives_the_board_s_state(link: LiveLink) -> None:
    link.open(lambda: False)
    link.start_telemetry(clock_us())
    heard: list[Sample] = []
    wait_until(lambda: bool(heard.extend(samples(link)) or len(heard) > 40))
    stamps = [sample.timestamp_ms for sample in heard if sample.block is heard[0].block]
    assert stamps == sorted(set(stamps))
    wait_until(lambda: link.supervisor_state == State.WAITING)
    link.check()


def test_poses_fly_the_board_and_silence_ends_it(link: LiveLink) -> None:
    """A muted link sends nothing: the board's failsafe is what the station means by it."""
    link.open(lambda: False)
    link.start_telemetry(clock_us())

    def flying() -> bool:
        link.send(clock_us(), fresh(0.0), HOME)
        time.sleep(0.02)
        samples(link)
        return link.supervisor_state == State.FLYING

    wait_until(flying)
    assert link.sent > 0
    sent = link.sent
    link.mute()
    assert link.supervisor_state is None
    link.send(clock_us(), fresh(0.0), HOME)
    wait_until(lambda: bool(samples(link) or True) and link.supervisor_state == State.FAILSAFE)
    assert link.sent <= sent + 1


def test_a_link_may_be_closed_twice_and_opened_again(link: LiveLink) -> None:
    link.close()
    for _ in range(2):
        link.open(lambda: False)
        link.start_telemetry(clock_us())
        wait_until(lambda: bool(samples(link)))
        link.close()
        link.close()


@pytest.mark.parametrize("end", ENDS)
def test_a_board_that_has_gone_is_a_lost_link_in_one_line(end: str) -> None:
    with serve(*ENDS[end]) as served:
        link = find_link(uri_of(served, end), SETTINGS)
        link.open(lambda: False)
    begin_s = time.monotonic()
    message = ""
    while not message:
        try:
            link.check()
            time.sleep(0.02)
        except LinkError as error:
            message = str(error)
        assert time.monotonic() - begin_s < SILENCE_TIMEOUT_US * 1e-6 + 10.0
    link.close()
    assert message.startswith(f"{link.uri}: lost: ")
    assert "\n" not in message
