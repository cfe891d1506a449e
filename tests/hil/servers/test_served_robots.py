"""What a server shows of its first robot, and where several start."""

import os
import re
import select
import socket
from contextlib import closing
from itertools import pairwise
from struct import pack

import numpy as np
import pyarrow as pa
import pytest

from firmware_py.config import parameters_of
from hil.board import image_firmware
from hil.board.clock import Paced, Readers
from hil.board.image_firmware import ChipImage
from hil.config import load_config
from hil.emulator.crazyflie.bootloader import CHUNK, LOAD_BUFFER, PAGE_SIZE, WRITE_FLASH
from hil.emulator.events import EventQueue
from hil.emulator.stm32f405.chip import build_machine
from hil.errors import LabError
from hil.laboratory.files.recorder import stored_in
from hil.laboratory.lockstep import image_at
from hil.laboratory.robot import Robot, Site, Streams
from hil.servers import served_robot
from hil.servers.motive import Streaming
from hil.servers.serial_server import Address
from hil.servers.served_robot import UDP_RETRY_US, ServedRobot
from hil.servers.server import Endpoints, Server, Service, open_motive
from hil.servers.shared_room import SharedRoom
from hil.world.scene import VisualModel
from support.stm32_firmware import build, flash_binary, image_with
from support.watching import Watcher


@pytest.fixture(autouse=True)
def _short_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' firmware is ready sooner than a Crazyflie's."""
    monkeypatch.setattr(image_firmware, "WARM_UP_US", 20_000)


@pytest.mark.long
def test_rows_of_a_served_robot_describe_its_look_and_go_on_after_a_restart_with_home_as_the_goal() -> None:
    watcher = Watcher()
    config = load_config(overrides=["flight.home=[0.1,-0.2,1.2]"])
    server = Server(Service(config), lambda text: None, watcher)
    server.lab.events.at(500_000, server.robot.boot)
    server.lab.end_at(1_000_000)
    server.lab.run()
    server.close()
    rows = pa.Table.from_batches(watcher.batches)
    ran_us = rows.column("cpu.KALMAN").to_numpy()
    assert (np.diff(ran_us) < 0).sum() == 1, "of the firmware that runs"
    assert [{*rows.column(f"goal.{axis}").to_pylist()} for axis in "xyz"] == [{0.1}, {-0.2}, {1.2}]
    look = VisualModel.read(stored_in(watcher.batches[0].schema.metadata, "look"))
    own = server.robot.body.look
    assert [part.name for part in look.parts] == [part.name for part in own.parts]
    assert len(look.outline) == len(own.outline) > 0


def test_no_end_of_a_server_blocks_where_nothing_has_arrived() -> None:
    server = Server(Service(load_config(), mavlink=True), print)
    readers = server.clock.readers
    opened = server.open(Endpoints(0, 0, (Address("tcp"),)))
    ends = (
        open_motive(Streaming(0, (4, 1), True), server.robot, server.clock),
        Address("pty").open(readers, max, print),
    )
    with socket.create_connection(("127.0.0.1", opened.dongles)):
        while len(readers) < 6:
            readers[select.select(readers, [], [], 20.0)[0][0]](0)
        files = [one if isinstance(one, int) else one.fileno() for one in readers]
        assert [os.get_blocking(file) for file in files] == [False] * 6
    for one in (*ends, server):
        one.close()


def test_an_image_of_an_unsupported_release_is_not_served() -> None:
    pytest.importorskip("unicorn")
    image = image_at(str(build(flags=("-g", '-DDEVICE_TYPE="CF21"'))), None)
    with pytest.raises(LabError, match=r"^--board: the image has no log variable supervisor.info"):
        Server(Service(load_config("crazyflie"), executor=image), lambda text: None)


def test_firmware_without_the_app_is_reported() -> None:
    pytest.importorskip("unicorn")
    lines: list[str] = []
    Server(Service(load_config(), executor=image_at(str(build()), None)), lines.append).close()
    assert [line for line in lines if "the image lacks Floaty's app" in line]


@pytest.mark.long
def test_constants_that_stay_the_images_are_said_and_it_is_polled_while_a_client_on_udp_listens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(served_robot, "APP_PARAMETER", "test.gain")
    config, said, polled = load_config(), list[str](), list[int]()
    layout = parameters_of(config).memory.dtype
    image = image_with(floaty_parameters=layout.itemsize)
    monkeypatch.setattr(Robot, "polled", lambda robot, now_us: polled.append(now_us))
    server = Server(Service(config, executor=ChipImage.flashed(image, build_machine())), said.append)
    (line,) = [line for line in said if "has its own" in line]
    assert line.startswith(f"the image has its own {layout.names[0]} = ")
    port = int(server.open(Endpoints(udp=0)).udp.rpartition(":")[2])
    server.lab.end_at(10_000)
    server.lab.run()
    assert polled == []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.sendto(b"\x30\x01", ("127.0.0.1", port))
        server.run(lambda: len(polled) > 3)
    assert {later - earlier for earlier, later in pairwise(polled)} == {served_robot.POLL_PERIOD_US}
    server.close()


def test_a_flashed_image_starts_at_the_next_start_and_one_that_cannot_run_is_named() -> None:
    """As a flashing tool writes it: page by page, through the boot loader."""
    pytest.importorskip("unicorn")
    first, second = (
        build(flags=flags) for flags in (("-g",), ("-g", "-DUSUAL_PLACES", "-fno-strict-aliasing"))
    )
    lines: list[str] = []
    site = Site(load_config(), EventQueue(), Streams.of_seed(1), lambda *_: None, image_at(str(first), None))
    served = ServedRobot(1, site, lines.append)
    loader, before = served.nrf51.bootloader, served.robot.executor
    assert bytes(loader.stm32.flash[0x4000:]).startswith(flash_binary(first))

    def flash(image: bytes) -> None:
        padded = image + b"\xff" * (-len(image) % PAGE_SIZE)
        for page in range(len(padded) // PAGE_SIZE):
            for at in range(0, PAGE_SIZE, CHUNK):
                data = padded[page * PAGE_SIZE + at : (page + 1) * PAGE_SIZE][:CHUNK]
                loader.answer(pack("<3BHH", 0xFF, 0xFF, LOAD_BUFFER, 0, at) + data)
            assert loader.answer(pack("<3BHHH", 0xFF, 0xFF, WRITE_FLASH, 0, 16 + page, 1))
        served.stop(0)
        lines.clear()
        served.start(1)

    flash(flash_binary(first))
    assert (lines, served.robot.executor) == ([], before), "the same image keeps its symbols"
    flash(flash_binary(second))
    assert isinstance(served.robot.executor, ChipImage)
    assert served.robot.executor.image.code.startswith(flash_binary(second))
    assert re.match(r"flashed image: no symbols: tasks, log variables", lines[0])
    assert lines[-1] == "board 1: starts the flashed image"
    flash(bytes(PAGE_SIZE))
    (line,) = lines
    assert re.match(
        r"board 1: the flashed image cannot run: flashed image: no vector table at 0x08004000", line
    )
    assert served.robot.firmware.flashed is not None
    served.close()


def on_udp(lines: list[str]) -> tuple[ServedRobot, Readers, int]:
    """A robot on simulated time with its UDP port; what it reports."""
    readers: Readers = {}
    site = Site(load_config(), EventQueue(), Streams.of_seed(1), lambda *_: None)
    served = ServedRobot(1, site, lines.append)
    return served, readers, int(served.serve_udp(0, readers).rpartition(":")[2])


def test_a_udp_port_that_was_taken_meanwhile_is_waited_for_each_time() -> None:
    lines: list[str] = []
    expected: list[str] = []
    served, readers, port = on_udp(lines)
    events = served.robot.events
    for _ in range(2):
        served.stop(events.now_us)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
            thief.bind(("127.0.0.1", port))
            served.start(events.now_us)
            events.run(events.now_us + 2 * UDP_RETRY_US)
            assert not readers
        events.run(events.now_us + UDP_RETRY_US)
        assert len(readers) == 1
        taken = f"board 1: udp port {port}: Address already in use; trying again"
        expected += [taken, f"board 1: udp port {port} is open again"]
        assert lines == expected
    served.close()


def test_a_new_client_on_the_radio_ends_the_session_on_udp() -> None:
    served, readers, port = on_udp([])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.sendto(b"\xf0", ("127.0.0.1", port))
        ((source, read),) = readers.items()
        assert select.select([source], [], [], 20.0)[0]
        read(0)
        assert served.udp is not None
        assert served.udp.has_session(0)
        served.nrf51.hear(0, b"\xf0")  # goes on
        assert served.udp.has_session(0)
        served.nrf51.hear(0, b"\xff\x05\x01")  # switches safelink on: a new one
        assert not served.udp.has_session(0)
    served.close()


# Where several robots of one server start


@pytest.mark.long
@pytest.mark.parametrize(("spacing", "sides"), [(0.0, (0.0, 0.0, 0.0, 0.0)), (0.5, (0.0, 0.5, -0.5, 1.0))])
def test_robots_of_one_room_start_side_by_side(spacing: float, sides: tuple[float, ...]) -> None:
    config = load_config("floaty", [f"flight.spacing={spacing}"])
    room = SharedRoom(config, len(sides))
    for number, side in enumerate(sides, 1):
        server = Server(Service(config, number), lambda line: None, room=room)
        assert server.robot.body.p_WB.tolist() == [0.0, side, 1.15]
        room.pauses[number - 1] = number
        assert server.clock.stood_still_us == number


@pytest.mark.long
@pytest.mark.parametrize(("sent", "calls"), [(None, []), ("corrections", [False]), ("poses", [True])])
def test_the_built_in_station_sends_what_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, sent: str | None, calls: list[bool]
) -> None:
    flown: list[bool] = []
    monkeypatch.setattr("hil.servers.server.fly_built_in", lambda robot, absolute: flown.append(absolute))
    with closing(Server(Service(load_config()), lambda line: None)) as server:
        server.open(Endpoints(udp=0, station=sent))
    assert flown == calls


def test_each_robot_has_a_seed_and_a_radio_chip_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds, of_seed = list[int](), Streams.of_seed
    monkeypatch.setattr(Streams, "of_seed", lambda seed: seeds.append(seed) or of_seed(seed))
    config, chips = load_config(), set[bytes]()
    for number in (1, 2, 3):
        with closing(Server(Service(config, number, seed=5), print, room=SharedRoom(config, 3))) as server:
            chips.add(server.served.nrf51._chip)
    assert len(chips) == 3
    assert [seeds[0], *seeds[-2:]] == [5, 6, 7]
    assert set(seeds) == {5, 6, 7}


@pytest.mark.parametrize("watcher", [None, Watcher()], ids=["alone", "watched"])
def test_only_a_robot_that_is_watched_has_rows_and_a_load_that_a_fault_may_add(
    watcher: Watcher | None,
) -> None:
    config = load_config(overrides=["flight.home=[0.1,-0.2,1.2]"])
    with closing(Server(Service(config), print, watcher)) as server:
        assert (server.robot._thief is None, server._shown is None) == (watcher is None, watcher is None)
        if server._shown is not None and watcher is not None:
            server._shown.row(20_000)
            server._shown.pass_rows()
            (row,) = pa.Table.from_batches(watcher.batches).to_pylist()
            assert [row[f"goal.{axis}"] for axis in ("x", "y", "z", "yaw")] == [0.1, -0.2, 1.2, 0.0]
            assert (row["t"], "cpu.THIEF" in row) == (20_000, True)


def test_a_radio_port_that_is_taken_is_named() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        closing(Server(Service(load_config()), print)) as server,
    ):
        port = taken.getsockname()[1]
        with pytest.raises(LabError, match=f"^radio port {port}: Address already in use"):
            server.open(Endpoints(radio=port))


@pytest.mark.parametrize("number", [1, 2])
def test_that_time_stood_still_is_said_once_for_all_robots(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    said, config = list[str](), load_config()
    monkeypatch.setattr(Paced, "notices", lambda clock: ["slow"])
    with closing(Server(Service(config, number), said.append, room=SharedRoom(config, 2))) as server:
        server.run(lambda: server.lab.now_us > 0)
    assert ("slow" in said) is (number == 1)
