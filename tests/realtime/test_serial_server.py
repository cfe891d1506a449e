"""The ends of a served serial line: bytes pass both ways, nobody who comes, leaves or sleeps holds the server up."""

import os
import socket

import pytest
import serial

from hil.errors import LabError
from hil.servers.serial_server import Address, parse_addresses
from support.line_clients import OpenEnd


def test_a_second_tcp_client_waits_for_the_first_to_leave():
    bench = OpenEnd(Address("tcp").open)
    where = bench.end._listener.getsockname()
    with socket.create_connection(where) as first, socket.create_connection(where) as second:
        first.sendall(b"1")
        second.sendall(b"2")
        bench.serve_until(lambda: bench.received == b"1")
        bench.end.send(b"for the first")
        assert first.recv(100) == b"for the first"
        first.close()
        bench.serve_until(lambda: bench.received == b"12")
        bench.end.send(b"for the second")
        assert second.recv(100) == b"for the second"
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
