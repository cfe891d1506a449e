"""A link, a server or an image that cannot work ends a command in one line with exit code 2, before anything moves."""

import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import libusb_package
import pytest
from cflib.crtp.radiodriver import RadioManager

from hil.servers.dongle_plugin import Backend
from support.command import Cli
from support.serving import CAMERAS, free_port

RADIO = "radio://0/80/2M/E7E7E7E7E7"
NOBODY = "radio://0/11/2M/E7E7E7E7AA"
EXPECTED = "expected mavlink:DEVICE[,BAUD]"


@pytest.fixture(autouse=True)
def without_a_dongle(monkeypatch: pytest.MonkeyPatch, empty_folder: Path) -> None:
    """An empty folder, and a computer without a Crazyradio."""
    monkeypatch.setattr(libusb_package, "get_libusb1_backend", lambda: Backend("127.0.0.1:9"))
    monkeypatch.setattr(RadioManager, "_radios", [])


@pytest.mark.parametrize(
    ("link", "message"),
    [
        (RADIO, "Cannot find a Crazyradio Dongle"),
        ("radio://0/80/3M/E7E7E7E7E7", "radio://0/80/3M/E7E7E7E7E7: expected radio://"),
        ("udp://127.0.0.1", "udp://127.0.0.1: expected radio://"),
        ("carrier-pigeon://coop", "expected radio://"),
        ("mavlink:/nowhere/tty", "mavlink:/nowhere/tty: No such file or directory"),
        ("mavlink:/dev/null", "mavlink:/dev/null: not a serial port"),
        ("mavlink:/dev/null,fast", "baud rate 'fast': expected 9600..3000000"),
        (f"mavlink:/dev/null,{'9' * 5000}", "9': expected 9600..3000000"),
        ("mavlink:/dev/null,300", "baud rate '300': expected 9600..3000000"),
        ("mavlink:/dev/null,9600", "9600 baud: 50 poses/s need 2.64 kB/s"),
        ("mavlink:", f"mavlink:: {EXPECTED}"),
        ("mavlink", f"mavlink: {EXPECTED}"),
        ("mavlink:carrier-pigeon://coop", EXPECTED),
        ("mavlink:socket://127.0.0.1:0", EXPECTED),
        ("mavlink:socket://127.0.0.1", EXPECTED),
        ("mavlink:socket://127.0.0.1:99999", EXPECTED),
        ("mavlink:socket://127.0.0.1:9", "mavlink:socket://127.0.0.1:9: Connection refused"),
        ("mavlink:rfc2217://127.0.0.1:9", "mavlink:rfc2217://127.0.0.1:9: Connection refused"),
    ],
)
def test_a_station_refuses_a_link_that_cannot_work(cli: Cli, link: str, message: str) -> None:
    assert message in cli.refusal("station", "--link", link, "--mocap", CAMERAS)


def test_a_station_refuses_a_port_on_which_no_board_listens(cli: Cli) -> None:
    uri = f"udp://127.0.0.1:{free_port()}"
    assert uri in cli.refusal("station", "--link", uri, "--mocap", CAMERAS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["station", "--link", RADIO, "--mocap", "vicon"], "--mocap vicon: expected optitrack:HOST"),
        (["station", "loop", "--link", RADIO], "experiment 'loop': unknown"),
        (["station", "--link", RADIO, "--log", "/nowhere/a.csv"], "--log /nowhere/a.csv: there is no folder /nowhere"),
        (["fly", "hover", "--link", RADIO, "--seeds", "2"], "--seeds is for flights in lockstep"),
        (["serve", "--set", "radio.uplink_loss=2"], "radio.uplink_loss = 2"),
        (["serve", "--boards", "11"], "11"),
        (["serve", "--profile", "crazyflie"], "profile crazyflie: its robot flies with the Crazyflie's own firmware"),
        (
            ["serve", "--profile", "crazyflie", "--board", "x.elf", "--station", "corrections"],
            "--station corrections: the Crazyflie's own firmware",
        ),
        (["fly", "hover", "--profile", "crazyflie"], "--board FILE: the image, an ELF file"),
        (["fly", "hover", "--profile", "crazyflie", "--board", "no.elf"], "--board no.elf"),
        (["serve", "--board", "x.elf"], "x.elf: No such file"),
        (["serve", "--set", "quadrotor.mass=0.03"], "quadrotor.mass=0.03: has no effect on the robot of profile floaty"),
        (["serve", "--udp", "65530", "--boards", "10"], "--udp 65530"),
        (["serve", "--mavlink", "usb"], "--mavlink usb: expected pty"),
        (["serve", "--mavlink", "udp:70000"], "--mavlink udp:70000: port 70000"),
        (["serve", "--mavlink", "pty:/no/folder", "--no-motive"], "mavlink pty /no/folder: No such file"),
        (["serve", "--mavlink", "pty", "--set", "mavlink.system=255", "--boards", "2"], "mavlink.system = 256"),
        (["deploy", "flash", "--uri", NOBODY, "cf2.bin"], "Cannot find a Crazyradio Dongle"),
        (["deploy", "flash", "--uri", "udp://127.0.0.1:19850", "cf2.bin"], "udp://127.0.0.1:19850: expected radio://"),
        (["deploy", "flash", "--uri", NOBODY, "nowhere.bin"], "nowhere.bin: No such file"),
        (["deploy", "flash", "--uri", NOBODY, "cf2.elf"], "cf2.elf: not an image for the board"),
        (["deploy", "flash", "cf2.bin"], "Missing option '--uri'"),
    ],
)  # fmt: skip
def test_impossible_links_are_refused(cli: Cli, arguments: list[str], message: str) -> None:
    Path("cf2.bin").write_bytes(struct.pack("<II", 0x2002_0000, 0x0800_41C1) + bytes(2000))
    Path("cf2.elf").write_bytes(b"\x7fELF" + bytes(500))
    assert message in cli.refusal(*arguments)


@pytest.fixture
def taken() -> Iterator[str]:
    """A UDP port of the loopback interface that another program has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        yield str(held.getsockname()[1])


def test_a_server_names_the_port_that_another_program_has(cli: Cli, taken: str) -> None:
    said = cli.refusal("serve", "--no-motive", "--udp", taken)
    assert said == f"floaty: udp port {taken}: Address already in use\n"
    said = cli.refusal("serve", "--no-motive", "--boards", "2", "--udp", str(int(taken) - 1))
    assert said == f"floaty: robot 2: udp port {taken}: Address already in use\n"
    said = cli.refusal("serve", "--udp", "0", "--set", f"capture.port={taken}")
    assert said.startswith(
        f"floaty: natnet port {taken}: Address already in use; --set capture.port=0 takes a free one"
    )
