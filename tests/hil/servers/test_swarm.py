"""Robots of one server, each in a separate process: dongles, UDP, typed lines, failures and shutdown, at any pace."""

import socket
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest

from firmware_py.firmware import Firmware
from hil.board.board_firmware import PowerOn, PythonBoard
from hil.config import load_config
from hil.emulator.crazyflie import syslink
from hil.errors import LabError
from hil.laboratory.faults import parse
from hil.servers.dongle_plugin import CONTROL, VARIABLE, WRITE, Connection, frame
from hil.servers.dongle_server import AHEAD
from hil.servers.server import Endpoints, Server, Service
from hil.servers.shared_room import SharedRoom
from hil.servers.swarm import Swarm
from support.serving import PATIENCE_S, Served, serve

SET_CHANNEL, SET_ADDRESS, SET_RATE, SET_ACKS = 1, 2, 3, 16  # vendor requests
NULL = b"\xff"
EVERYBODY = bytes.fromhex("FFE7E7E7E7")
ACKNOWLEDGED, NOT_ACKNOWLEDGED = 1, 0
MOVED = 37


class Dongle(Connection):
    """A client's dongle, tuned as cflib does before every packet."""

    def __init__(self, served: Served) -> None:
        host, port = served.environment[VARIABLE].split(":")
        super().__init__(host, int(port))

    def request(self, number: int, value: int, data: bytes = b"") -> None:
        self.control(bytes((number, value, 0)) + data)

    def send(self, last: int, packet: bytes = NULL, channel: int = 80) -> int:
        """Send a packet to the address that ends so; return the status that comes back."""
        self.request(SET_CHANNEL, channel)
        self.request(SET_ADDRESS, 0, b"\xe7" * 4 + bytes((last,)))
        self.request(SET_RATE, 2)
        self.write(packet)
        return self.read(PATIENCE_S)[0] & 1


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve("--boards", "2", "--radio", "--radio-port", "0", "--udp", "0") as served:
        yield served


def others(served: Served) -> list[int]:
    """The processes of the robots 2, 3, ...."""
    pid = served.process.pid
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_one_dongle_reaches_every_robot_by_its_address_and_nobody_by_another(served: Served) -> None:
    with closing(Dongle(served)) as dongle:
        for _ in range(3):
            assert [dongle.send(last) for last in (0xE7, 0x02, 0x03)] == [1, 1, 0]
        dongle.request(SET_ACKS, 0)
        for _ in range(2 * AHEAD):  # none of them is awaited
            dongle.write(NULL)
        dongle.request(SET_ACKS, 1)
        assert dongle.send(0xE7) == ACKNOWLEDGED


def test_a_robot_that_a_client_moves_is_found_on_its_new_channel(served: Served) -> None:
    with closing(Dongle(served)) as dongle, closing(Dongle(served)) as other:
        assert other.send(0x02) == ACKNOWLEDGED
        dongle.send(0x02, bytes((0xFF, 3, 1, MOVED)))
        served.wait_for(r"board 2: a client moved the radio to radio://0/37/2M/E7E7E7E702", PATIENCE_S)
        for client in (dongle, other):
            assert client.send(0x02) == NOT_ACKNOWLEDGED
            assert client.send(0x02, channel=MOVED) == ACKNOWLEDGED
        served.type("2 restart")
        served.type("2 status")
        served.wait_for(r"robot 2: .*; radio://0/80/2M/E7E7E7E702", PATIENCE_S)
        assert other.send(0x02) == ACKNOWLEDGED


@pytest.mark.long
def test_a_packet_to_all_reaches_all_and_none_answers(served: Served) -> None:
    with closing(Dongle(served)) as dongle:
        dongle.request(SET_CHANNEL, 80)
        dongle.request(SET_RATE, 2)
        dongle.request(SET_ADDRESS, 0, EVERYBODY)
        dongle.request(SET_ACKS, 0)
        dongle.write(bytes((0xFF, 3, 1, MOVED)))
        for uri in ("radio://0/37/2M/E7E7E7E7E7", "radio://0/37/2M/E7E7E7E702"):
            served.wait_for(f"a client moved the radio to {uri}", PATIENCE_S)
        served.forget()
        dongle.request(SET_CHANNEL, MOVED)
        dongle.write(bytes((0xFF, 3, 1, 80)))
        for number in (1, 2):
            served.wait_for(f"board {number}: a client moved the radio back", PATIENCE_S)
    served.forget()


@pytest.mark.long
def test_a_client_that_writes_and_never_reads_is_closed_in_one_line(served: Served) -> None:
    served.forget()
    host, port = served.environment[VARIABLE].split(":")
    with socket.socket() as deaf, suppress(ConnectionError), closing(Dongle(served)) as dongle:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        deaf.connect((host, int(port)))
        deaf.settimeout(PATIENCE_S)
        while True:
            deaf.sendall(frame(CONTROL, 1, bytes((SET_CHANNEL, 80, 0))) + frame(WRITE, 1, NULL))
            assert dongle.send(0xE7) == ACKNOWLEDGED
    served.wait_for("board 1: radio port .* was closed: it does not read its answers", PATIENCE_S)


def test_every_robot_answers_on_its_own_udp_port(served: Served) -> None:
    assert len(set(served.udp_uris)) == 2
    for uri in served.udp_uris:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.settimeout(PATIENCE_S)
            client.sendto(NULL, ("127.0.0.1", int(uri.rpartition(":")[2])))
            assert client.recv(64) == NULL


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("status", "robot 1: held, .*; radio://0/80/2M/E7E7E7E7E7"),
        ("2 status", "robot 2: held, .*; radio://0/80/2M/E7E7E7E702"),
        ("2 mocap.dropout:0.1", "robot 2 is held: what moves it has no effect before it is released"),
        ("2 push.w=2", "unknown kind 'push.w'"),
        ("3 status", r"robot 3: expected 1\.\.2"),
        ("1" * 5000, "1{20}…: expected at most 200 characters"),
        ("9" * 200, r"robot 9{200}: expected 1\.\.2"),
        ("2 3 status", "'3 status' is unknown; did you mean status?"),
    ],
)
def test_a_typed_line_goes_to_the_robot_whose_number_it_has(served: Served, line: str, answer: str) -> None:
    served.forget()
    served.type(line)
    served.wait_for(answer, PATIENCE_S)


@pytest.mark.long
def test_ctrl_c_ends_all_processes_in_order_and_keeps_every_robots_eeprom(tmp_path: Path) -> None:
    with serve("--boards", "2", "--udp", "0", "--state", str(tmp_path)) as served:
        pids = others(served)
        assert len(pids) == 1
        assert served.interrupt() == 0
        assert served.lines[-1].startswith("stopped; time stood still for")
        assert not any(Path(f"/proc/{pid}").exists() for pid in pids)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"board-{number}.eeprom" for number in (1, 2)]


@pytest.mark.long
def test_robots_do_not_outlive_a_server_that_is_killed() -> None:
    with serve("--boards", "2", "--udp", "0") as served:
        served.process.kill()
        served.process.stdout.read()  # until the last process has closed it


class Talker(PythonBoard):
    """Its firmware sends to its peers what a client sends to its application, and prints what it hears of them."""

    def boot(self, start: PowerOn) -> Firmware:
        firmware = super().boot(start)

        def received(data: bytes, broadcast: bool = False) -> None:
            if broadcast:
                start.board.debug_write(f"peer says {data[2:].decode()}")
            else:
                start.board.radio_command(syslink.PEER_BROADCAST, b"\x03" + data[1:])

        firmware.radio_received = received
        return firmware


@pytest.mark.long
def test_a_peer_packet_of_one_board_reaches_those_of_all_other_processes() -> None:
    said: list[str] = []
    plan, endpoints = Service(load_config(), executor=Talker()), Endpoints(udp=0)
    with closing(Swarm(plan, 3, endpoints, said.append)) as swarm:
        others = swarm.wait()
        with closing(Server(plan, said.append, None, swarm.to_peers)) as server:
            ports = [int(robot.udp.rpartition(":")[2]) for robot in (server.open(endpoints), *others)]
            swarm.listen(server, said.append, None)
            for number, port in enumerate(ports, 1):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
                    client.sendto(b"\xd0from %d" % number, ("127.0.0.1", port))
                    expected = {f"board {n}: peer says from {number}" for n in (1, 2, 3) if n != number}
                    server.run(lambda expected=expected: expected <= set(said))
    heard = [line for line in said if "peer says" in line]
    assert len(heard) == 6


class Cameras:
    """A Motive that keeps what it gets."""

    def __init__(self) -> None:
        self.lost: list[int] = []
        self.streamed: set[int] = set()

    def lose(self, number: int) -> None:
        self.lost.append(number)

    def stream_frame(self, number: int, *frame: object) -> None:
        self.streamed.add(number)


@pytest.mark.long
def test_a_robot_whose_process_dies_is_named_and_lost_and_the_others_continue() -> None:
    said, motive = list[str](), Cameras()
    plan, endpoints = Service(load_config()), Endpoints(udp=0, motive=True)
    with closing(Swarm(plan, 3, endpoints, said.append)) as swarm:
        assert [robot.radio[-2:] for robot in swarm.wait()] == ["02", "03"]
        answers: list[str] = []
        with closing(Server(plan, lambda line: None, None, swarm.to_peers, swarm.room)) as server:
            swarm.listen(server, answers.append, motive)  # type: ignore[arg-type]
            swarm.room.rows[:] = 1.0
            server.run(lambda: motive.streamed == {2, 3})
            swarm._processes[3].kill()
            typing = swarm.terminals
            dead = "robot 3: its process has ended; the others continue"
            server.run(lambda: any(line.startswith("robot ") for line in said))
            assert [line for line in said if line.startswith("robot ")] == [dead]
            assert motive.lost == [3]
            assert [row.any() for row in swarm.room.rows] == [True, True, False]
            with pytest.raises(LabError, match=r"^robot 3: its process has ended$"):
                typing[3]("3 status")
            assert set(swarm.terminals) == {2}
            typing[2]("2 status")
            server.run(lambda: bool(answers))
            assert answers[0].startswith("robot 2: held, ")


@pytest.mark.long
@pytest.mark.parametrize("radius", [0.07, 0.0])
def test_robots_of_several_processes_that_touch_push_each_other_apart(radius: float) -> None:
    settings = ("flight.spacing=0.1", f"swarm.radius={radius}")
    standing = [parse(f"motor.stop.{motor}@0") for motor in (1, 2, 3, 4)]
    plan, endpoints = Service(load_config("crazyflie", settings), faults=standing), Endpoints(udp=0)
    said: list[str] = []
    with closing(Swarm(plan, 3, endpoints, said.append)) as swarm:
        swarm.wait()
        with closing(Server(plan, said.append, None, swarm.to_peers, swarm.room)) as server:
            swarm.listen(server, said.append, None)
            server.run(lambda: swarm.room.rows[:, 0].all() and server.lab.now_us > 500_000)
            y = np.sort(swarm.room.rows[:, 2])
            if radius == 0.0:
                assert y == pytest.approx((-0.1, 0.0, 0.1), abs=1e-3)
            else:
                assert np.diff(y).min() > 0.13
    swarm.room.rows[:] = 1.0  # no process writes any more
    swarm.room.leave(2)
    assert not swarm.room.rows[1].any()
    assert swarm.room.rows[[0, 2]].all()


@pytest.mark.long
@pytest.mark.parametrize(("profile", "share"), [("crazyflie", True), ("floaty", False)])
def test_robots_share_a_room_in_still_air_only(profile: str, share: bool) -> None:
    """Where fans blow, each robot flies at home in its own tunnel, so their places must not be compared."""
    config = load_config(profile)
    room = SharedRoom(config, 2)
    with closing(Server(Service(config), print, None, room=room)) as server:
        server.robot.release()
        server.run(lambda: server.lab.now_us > 20_000)
    assert room.rows[:, 0].tolist() == [float(share), 0.0]
