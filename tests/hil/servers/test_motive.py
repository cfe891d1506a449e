"""A virtual Motive without clients of others: its axes, and how many it serves."""

import socket

import pytest

from ground_station.sources.natnet import MessageId, packet
from hil.clock import Readers
from hil.servers.motive import MAX_CLIENTS, Streaming, VirtualMotive, in_axes


def test_with_y_up_what_is_above_is_y_and_what_is_left_is_minus_z() -> None:
    p, q = in_axes("y", (1.0, 2.0, 3.0), (0.5, 0.1, 0.2, 0.3))
    assert p == (1.0, 3.0, -2.0)
    assert q == (0.5, 0.1, 0.3, -0.2)
    assert in_axes("z", (1.0, 2.0, 3.0), (0.5, 0.1, 0.2, 0.3)) == ((1.0, 2.0, 3.0), (0.5, 0.1, 0.2, 0.3))


@pytest.mark.parametrize("count", [MAX_CLIENTS, MAX_CLIENTS + 1])
def test_sixteen_clients_are_served_and_one_more_displaces_who_was_silent_longest(count: int) -> None:
    readers: Readers = {}
    motive = VirtualMotive(Streaming(0, (4, 1), multicast=False), {1: "floaty"}, readers)
    clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        (read,) = readers.values()
        for client in clients:
            client.bind(("127.0.0.1", 0))
            client.sendto(packet(MessageId.CONNECT, b""), ("127.0.0.1", motive.port))
            read(0)
        served = set(motive._clients)
        first = count - MAX_CLIENTS
        assert served == {client.getsockname() for client in clients[first:]}
    finally:
        motive.close()
        for client in clients:
            client.close()
