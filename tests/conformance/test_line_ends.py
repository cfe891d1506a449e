"""Laws of every end of a served board's line: pty, UDP and TCP for MAVLink, UDP for CRTP packets."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from support.line_clients import ENDS, LineClient, OpenEnd
from support.serving import free_port

Pair = tuple[OpenEnd, Callable[[OpenEnd], LineClient]]
PACKETS = [bytes(range(start, start + 16)) for start in range(0, 256, 16)]


@pytest.fixture(params=ENDS)
def again(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], Pair]:
    """What opens an end, always at the same address, and what makes clients of it."""
    make, connect = ENDS[request.param]
    where = tmp_path / "line" if request.param == "pty" else free_port()
    return lambda: (make(where), connect)


@pytest.fixture
def pair(again: Callable[[], Pair]) -> Iterator[Pair]:
    """An end, and what makes clients of it."""
    open_end, connect = again()
    yield open_end, connect
    open_end.close()


def test_every_byte_passes_unchanged_once_and_in_order_both_ways(pair: Pair) -> None:
    open_end, connect = pair
    client = connect(open_end)
    for packet in PACKETS:
        client.write(packet)
    open_end.serve_until(lambda: len(open_end.received) >= 256)
    assert open_end.received == bytes(range(256))
    for packet in PACKETS:
        open_end.end.send(packet)
    assert client.exactly(256) == bytes(range(256))
    client.close()


def test_clients_come_and_go(pair: Pair) -> None:
    open_end, connect = pair
    open_end.end.send(b"nobody there")
    for number in range(3):
        client = connect(open_end)
        client.write(b"%d" % number)
        open_end.serve_until(lambda number=number: open_end.received.endswith(b"%d" % number))
        open_end.end.send(b"welcome")
        assert client.exactly(7) == b"welcome"
        client.close()
        open_end.end.send(b"nobody there")
    assert open_end.received == b"012"


@pytest.mark.long
def test_a_client_that_does_not_read_delays_no_other(pair: Pair) -> None:
    open_end, connect = pair
    client = connect(open_end)
    for _ in range(20_000):
        open_end.end.send(bytes(280))
    client.write(b"still here")
    open_end.serve_until(lambda: open_end.received == b"still here")
    client.close()


def test_closing_an_end_releases_its_address_and_its_readers(again: Callable[[], Pair]) -> None:
    for _ in range(3):
        open_end, connect = again()
        client = connect(open_end)
        client.write(b"here")
        open_end.serve_until(lambda open_end=open_end: open_end.received == b"here")
        open_end.close()
        assert open_end.readers == {}
        client.close()


def test_closing_an_end_twice_is_harmless(again: Callable[[], Pair]) -> None:
    closed, _ = again()
    closed.close()
    open_end, connect = again()  # with the same address, and the descriptors that have become free
    closed.close()
    client = connect(open_end)
    client.write(b"here")
    open_end.serve_until(lambda: open_end.received == b"here")
    client.close()
    open_end.close()
