"""The ends of a served serial line: bytes pass both ways, nobody who comes, leaves or sleeps holds the server up."""

import os

import pytest
import serial

from hil.errors import LabError
from hil.servers.serial_server import Address, parse_addresses
from support.line_clients import OpenEnd, TcpClient


def test_several_tcp_clients_all_hear_the_board_and_are_heard():
    bench = OpenEnd(Address("tcp").open)
    first, second, third = (TcpClient(bench) for _ in range(3))
    for number, client in enumerate((first, second, third)):
        client.write(b"%d" % number)
        bench.serve_until(lambda number=number: bench.received.endswith(b"%d" % number))
    bench.end.send(b"for all")
    assert [client.exactly(7) for client in (first, second, third)] == [b"for all"] * 3
    second.close()
    bench.serve_until(lambda: len(bench.readers) == 3)  # the listener and two clients
    bench.end.send(b"for two")
    assert [client.exactly(7) for client in (first, third)] == [b"for two"] * 2
    bench.close()
    assert first.exactly(1) == b""
    first.close()
    third.close()


def test_a_tcp_client_that_does_not_read_takes_nothing_from_another():
    bench = OpenEnd(Address("tcp").open)
    asleep, awake = TcpClient(bench), TcpClient(bench)
    sent = b""
    for number in range(20_000):
        data = number.to_bytes(4, "big") * 70
        bench.end.send(data)
        sent += data
        if number % 100 == 99:
            assert awake.exactly(len(sent)) == sent
            sent = b""
    asleep.close()
    awake.close()
    bench.close()


def test_what_one_tcp_client_sent_at_once_is_not_torn_by_another():
    bench = OpenEnd(Address("tcp").open)
    first, second = TcpClient(bench), TcpClient(bench)
    long, short = bytes(range(256)) * 64, b"between"
    first.write(long)
    second.write(short)
    bench.serve_until(lambda: len(bench.received) == len(long) + len(short))
    assert bytes(bench.received) in (long + short, short + long)
    first.close()
    second.close()
    bench.close()


def test_the_link_to_a_pty_is_made_and_removed(tmp_path):
    path = tmp_path / "floaty"
    bench = OpenEnd(Address("pty", path=path).open)
    assert bench.end.master == str(path)
    with serial.Serial(str(path), 921_600) as client:
        client.write(b"through the link")
        bench.serve_until(lambda: bench.received == b"through the link")
    bench.close()
    assert not os.path.lexists(path)


def test_the_link_of_a_killed_server_is_replaced_but_nothing_else(tmp_path):
    stale, file, other = tmp_path / "stale", tmp_path / "file", tmp_path / "other"
    stale.symlink_to("/dev/pts/99999")
    OpenEnd(Address("pty", path=stale).open).close()
    file.write_text("mine")
    other.symlink_to(file)
    for path in (file, other, tmp_path / "no" / "folder"):
        with pytest.raises(LabError, match=f"mavlink pty {path}: "):
            Address("pty", path=path).open({}, lambda now_us, data: None)
    assert file.read_text() == "mine"
    assert other.is_symlink()


def test_a_port_in_use_is_named():
    bench = OpenEnd(Address("tcp").open)
    port = bench.end._listener.getsockname()[1]
    with pytest.raises(LabError, match=f"mavlink tcp 127.0.0.1:{port}: Address already in use"):
        Address("tcp", port=port).open({}, lambda now_us, data: None)
    bench.close()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("pty", [("pty", 0, None), ("pty", 0, None)]),
        ("pty:/tmp/a:b", [("pty", 0, "/tmp/a:b"), ("pty", 0, "/tmp/a:b-2")]),
        ("udp", [("udp", 14550, None), ("udp", 14551, None)]),
        ("udp:1234", [("udp", 1234, None), ("udp", 1235, None)]),
        ("udp:10.0.0.7:1234", [("udp", 1234, None), ("udp", 1235, None)]),
        ("tcp", [("tcp", 5760, None), ("tcp", 5761, None)]),
        ("tcp:0", [("tcp", 0, None), ("tcp", 0, None)]),
        ("tcp:localhost:", [("tcp", 5760, None), ("tcp", 5761, None)]),
    ],
)
def test_addresses_count_up(text, expected):
    addresses = parse_addresses(text, 2)
    found = [(end.kind, end.port, None if end.path is None else str(end.path)) for end in addresses]
    assert found == expected
    host = {"udp:10.0.0.7:1234": "10.0.0.7", "tcp:localhost:": "localhost"}.get(text, "127.0.0.1")
    assert [end.host for end in addresses] == [host, host]


@pytest.mark.parametrize(
    "text", ["", "usb", "udp:x", "udp:0", "udp:127.0.0.1:x", "tcp:-1", "tcp:65535", "udp:²"]
)
def test_other_addresses_are_refused_in_one_line(text):
    with pytest.raises(LabError, match=r"^--mavlink ") as caught:
        parse_addresses(text, 2)
    assert "\n" not in str(caught.value)
