"""`floaty serve` with clients that do on every link what they like, for 20 s: it serves on, and Ctrl-C ends it in order."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

import numpy as np

from hil.servers.dongle_plugin import CONTROL, VARIABLE, WRITE, frame
from hil.servers.tcp_port import CLIENTS_MAX
from support.mavlink_client import STATION, codec
from support.random_requests import harmless_message, random_packet, spoilt
from support.serving import PATIENCE_S, Served, serve

DURATION_S = 20.0
PERIOD_S = 0.001
Address = tuple[str, int]
Act = Callable[[np.random.Generator, threading.Event], None]

CHANNEL_80, RATE_2M = bytes((1, 80, 0)), bytes((3, 2, 0))


@contextmanager
def tcp(address: Address) -> Iterator[socket.socket]:
    """A connection; that the server closes it is its right."""
    with socket.socket() as client, suppress(OSError):
        client.settimeout(1.0)
        with suppress(OSError):
            client.connect(address)
        yield client


def datagrams(address: Address, data: Callable[[np.random.Generator], bytes]) -> Act:
    def act(rng: np.random.Generator, stop: threading.Event) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            while not stop.wait(PERIOD_S):
                with suppress(OSError):
                    client.sendto(data(rng), address)

    return act


def stream(address: Address, data: Callable[[np.random.Generator], bytes], reads: bool) -> Act:
    """Write and read, or only write, as much as fits; connect again when closed."""

    def act(rng: np.random.Generator, stop: threading.Event) -> None:
        while not stop.is_set():
            with tcp(address) as client:
                client.setblocking(False)
                while not stop.wait(PERIOD_S):
                    with suppress(BlockingIOError):
                        client.send(data(rng) if reads else data(rng) * 100)
                    with suppress(BlockingIOError):
                        if reads and not client.recv(65536):
                            break

    return act


def knock(address: Address) -> Act:
    """Come and go, sometimes with a word of HTTP."""

    def act(rng: np.random.Generator, stop: threading.Event) -> None:
        while not stop.wait(0.01):
            with tcp(address) as client:
                client.sendall(b"POST / HTTP/1.1\r\n\r\n\xfd\x09" if rng.random() < 0.5 else b"")

    return act


def stay(address: Address) -> Act:
    """Keep idle connections, more than are kept."""

    def act(rng: np.random.Generator, stop: threading.Event) -> None:
        with ExitStack() as stack:
            for _ in range(2 * CLIENTS_MAX):
                stack.enter_context(tcp(address))
            stop.wait()

    return act


def radio_frames(rng: np.random.Generator) -> bytes:
    if rng.random() < 0.1:
        return WRITE + rng.bytes(2 + int(rng.integers(30)))
    return (
        frame(CONTROL, 1, CHANNEL_80)
        + frame(CONTROL, 2, RATE_2M)
        + frame(WRITE, 3, random_packet(rng) or b"\xff")
    )


def natnet(rng: np.random.Generator) -> bytes:
    return bytes((int(rng.integers(14)), 0)) + rng.bytes(int(rng.integers(60)))


def messages(rng: np.random.Generator) -> bytes:
    data = bytes(harmless_message(rng).pack(codec(*STATION)))
    return data if rng.random() < 0.7 else b"\xfd" + spoilt(rng, data)


def clients_of(served: Served) -> list[Act]:
    """Two of each kind on each link."""
    host, port = served.environment[VARIABLE].split(":")
    radio, motive = (host, int(port)), (host, int(served.motive.split(":")[2].partition(",")[0]))
    udp = [(host, int(uri.rpartition(":")[2])) for uri in served.udp_uris]
    lines = [(host, int(master.rpartition(":")[2])) for master in served.line("mavlink ")]
    return 2 * [
        *(datagrams(address, random_packet) for address in udp),
        datagrams(motive, natnet),
        *(
            act
            for address, data in ((radio, radio_frames), *((line, messages) for line in lines))
            for act in (
                stream(address, data, True),
                stream(address, data, False),
                knock(address),
                stay(address),
            )
        ),
    ]


def test_hostile_clients_on_every_link_stop_nothing() -> None:
    links = ("--radio", "--radio-port", "0", "--udp", "0", "--mavlink", "tcp:0")
    with serve("--boards", "2", *links, "--station", motive=True) as served:
        for number in (1, 2):
            served.wait_for(f"board {number}: released", PATIENCE_S)
        stop = threading.Event()
        threads = [
            threading.Thread(target=act, args=(np.random.default_rng(seed), stop))
            for seed, act in enumerate(clients_of(served))
        ]
        for thread in threads:
            thread.start()
        served.type("1" * 5000)
        served.wait_for("expected at most 200 characters", PATIENCE_S)
        threading.Event().wait(DURATION_S)
        for number in (1, 2):
            served.type(f"{number} status")
            served.wait_for(rf"robot {number}: free, flying", PATIENCE_S)
        stop.set()
        for thread in threads:
            thread.join(PATIENCE_S)
        assert served.interrupt() == 0
    text = "\n".join(served.lines)
    assert "Traceback" not in text
    assert "lost" not in text
    for reason in ("not of this protocol", f"more than {CLIENTS_MAX} clients"):
        assert reason in text
    assert len([line for line in served.lines if " port " in line]) < 8 * DURATION_S  # throttled
