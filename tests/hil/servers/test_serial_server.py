"""The ends of a served serial line: bytes pass both ways, nobody who comes, leaves or sleeps holds the server up."""

import os
from pathlib import Path
from typing import Any

import pytest
import serial

from hil.errors import LabError
from hil.servers.serial_server import UDP_PORT, Address, parse_addresses
from support.line_clients import OpenEnd, TcpClient


def test_several_tcp_clients_all_exchange_bytes_with_the_board() -> None:
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


@pytest.mark.long
def test_a_tcp_client_that_does_not_read_takes_nothing_from_another() -> None:
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


def test_one_client_s_message_is_not_split_by_another() -> None:
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


def test_the_link_to_a_pty_is_made_and_removed(tmp_path: Path) -> None:
    path = tmp_path / "floaty"
    bench = OpenEnd(Address("pty", path=path).open)
    assert bench.end.master == str(path)
    with serial.Serial(str(path), 921_600) as client:
        client.write(b"through the link")
        bench.serve_until(lambda: bench.received == b"through the link")
    bench.close()
    assert not os.path.lexists(path)


@pytest.mark.parametrize(("taken", "forgets"), [(None, True), (0, True), (4, True), (5, False)])
def test_what_a_pty_cannot_take_whole_empties_it(
    taken: int | None, forgets: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = OpenEnd(Address("pty").open)
    forgotten: list[bool] = []
    monkeypatch.setattr(bench.end, "_forget_unread", lambda: forgotten.append(True))

    def write(file: int, data: bytes) -> int:
        if taken is None:
            raise BlockingIOError
        return taken

    monkeypatch.setattr(os, "write", write)
    bench.end.send(b"12345")
    monkeypatch.undo()
    assert forgotten == [True] * forgets
    bench.close()


def test_the_link_of_a_killed_server_is_replaced_but_nothing_else(tmp_path: Path) -> None:
    stale, file, other = tmp_path / "stale", tmp_path / "file", tmp_path / "other"
    stale.symlink_to("/dev/pts/99999")
    OpenEnd(Address("pty", path=stale).open).close()
    file.write_text("mine")
    other.symlink_to(file)
    opened = len(os.listdir("/proc/self/fd"))
    for path in (file, other, tmp_path / "no" / "folder"):
        with pytest.raises(LabError, match=f"mavlink pty {path}: "):
            Address("pty", path=path).open({}, lambda now_us, data: None, print)
    assert len(os.listdir("/proc/self/fd")) == opened
    assert file.read_text() == "mine"
    assert other.is_symlink()


def test_a_port_in_use_is_named() -> None:
    bench = OpenEnd(Address("tcp").open)
    port = int(bench.end.master.rpartition(":")[2])
    with pytest.raises(LabError, match=f"mavlink tcp 127.0.0.1:{port}: Address already in use"):
        Address("tcp", port=port).open({}, lambda now_us, data: None, print)
    bench.close()


@pytest.mark.parametrize(
    ("text", "host", "ends"),
    [
        ("pty", "127.0.0.1", ["pty", "pty"]), ("pty:/tmp/a:b", "127.0.0.1", ["pty:/tmp/a:b", "pty:/tmp/a:b-2"]),
        ("udp", "127.0.0.1", ["udp:14550", "udp:14551"]), ("udp:1234", "127.0.0.1", ["udp:1234", "udp:1235"]),
        ("udp:10.0.0.7:1234", "10.0.0.7", ["udp:1234", "udp:1235"]), ("tcp", "127.0.0.1", ["tcp:5760", "tcp:5761"]),
        ("tcp:0", "127.0.0.1", ["tcp:0", "tcp:0"]), ("tcp:localhost:", "localhost", ["tcp:5760", "tcp:5761"]),
        ("tcp:65535", "127.0.0.1", ["tcp:65535"]), ("tcp:65534", "127.0.0.1", ["tcp:65534", "tcp:65535"]),
    ],
)  # fmt: skip
def test_addresses_count_up_to_the_last_port(text: str, host: str, ends: list[str]) -> None:
    addresses = parse_addresses(text, len(ends))
    assert {end.host for end in addresses} == {host}
    where = [end.path or "" if end.kind == "pty" else end.port for end in addresses]
    assert [f"{end.kind}:{place}".rstrip(":") for end, place in zip(addresses, where, strict=True)] == ends


@pytest.mark.parametrize("kind", ["pty", "udp", "tcp"])
def test_a_closed_end_keeps_no_descriptor(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "line" if kind == "pty" else None
    address = Address(kind, port=UDP_PORT if kind == "udp" else 0, path=path)
    before, readers = os.listdir("/proc/self/fd"), dict[Any, Any]()
    end = address.open(readers, max, print)
    assert len(os.listdir("/proc/self/fd")) > len(before)
    for _ in range(2):
        end.close()
        assert (os.listdir("/proc/self/fd"), readers, list(tmp_path.iterdir())) == (before, {}, [])
