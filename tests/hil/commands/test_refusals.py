"""A wrong argument, option, link or file ends a command in one line that names it and what is allowed, with exit code 2.

Nothing is written, nothing flies. `TABLE` has the words of `floaty` and what the line contains.
"""

import os
import re
import shlex
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import libusb_package
import pytest
from cflib.crtp.radiodriver import RadioManager

from hil.commands.app import app
from hil.errors import LabError
from hil.live import rerun_screen
from hil.servers.dongle_plugin import Backend
from support.command import Cli
from support.paths import ROOT
from support.serving import CAMERAS, free_port

NEEDS = [
    one
    for path in sorted((ROOT / "hil/commands").glob("*.py"))
    for one in re.findall(r'require\("([^"]+)", "([\w-]+)"', path.read_text("utf-8"))
]

TABLE = r"""
fly hovver | experiment 'hovver': unknown; did you mean hover?
fly hover --duration -1 | --duration -1
fly hover --duration nan | --duration nan
fly hover --duration soon | 'soon' is not a valid float
fly hover --seed -1 | -1
fly hover --profile flaoty | did you mean floaty?
fly hover --profile nowhere/x.toml | No such file
fly hover --out /proc/floaty/run | --out /proc/floaty/run: cannot be written
fly hover --seeds 2 --view | --seeds 2
fly hover --seeds 2 --perfetto | --seeds 2
fly hover --resume | --workers, --cluster and --resume are for several --seeds
fly hover --gdb 3333 | --gdb 3333: needs one flight with an image as --board
fly hover --gdb 0 | --gdb 0: needs one flight with an image as --board
fly hover --bogus | No such option
fly hover --robots 2 --view | --robots 2: --view: not for robots that fly together
fly hover --robots 2 --seeds 2 --baseline b | --baseline b: is for one seed
fly hover --robots 2 --resume --baseline b | --robots 2: --seeds, --workers, --cluster, --resume, --baseline: not for robots
fly hover --robots 2 --link udp://127.0.0.1:1 | --link udp://127.0.0.1:1: --robots is for flights in lockstep
fly hover --link RADIO --seeds 2 | --seeds is for flights in lockstep
fly hover --link udp://127.0.0.1:1 --board python | only c flies over a link
fly hover --link RADIO --board python | only c flies over a link
fly hover --link mavlink --board FILE | speaks CRTP over its radio, not MAVLink
fly hover --link mavlink:pty --board FILE | speaks CRTP over its radio, not MAVLink
fly hover --link mavlink --set serial.baud=9600 | 9600 baud: 50 poses/s need
fly hover --link mavlink --set serial.baud=9600 | lower station.corrections_hz or raise serial.baud
fly hover --profile crazyflie | --board FILE: the image, an ELF file
fly hover --profile crazyflie --board no.elf | --board no.elf
fly hover --board no-such-board | expected c, python, cortex-m4, an image of a Crazyflie's firmware: an ELF file, a .bin or
fly hover --board FILE | no vector table at 0x08004000: the stack pointer there
fly | Missing argument 'EXPERIMENT': `floaty list` names them
flyy | flyy: no such command; did you mean fly?
zzzzzz | zzzzzz: no such command; see floaty --help

fly hover --set controler.gain_z=1 | did you mean controller?
fly hover --set tunnel.sped=3 | tunnel.sped = 3: unknown key (did you mean speed?)
fly hover --set controller.gain_y=nan | controller.gain_y = nan: input should be a finite number
fly hover --set controller.gain_y=inf | controller.gain_y = inf
fly hover --set controller.gain_y=1e9 | controller.gain_y = 1000000000.0: input should be less than or equal to 20
fly hover --set tunnel.speed=0 | tunnel.speed = 0: input should be greater than 0; still air is tunnel.fan_factor = 0
fly hover --set tunnel.speed=-1 | tunnel.speed = -1: input should be greater than 0
fly hover --set servo.trim[1]=99999 | servo.trim[1] = 99999: input should be less than or equal to 12000
fly hover --set servo.trim[7]=0 | no element [7]
fly hover --set mocap.period_us=400000 | mocap.period_us = 400000: no pose
fly hover --set mocap.period_us=400000 | than tracker.reacquire_us = 400000
fly hover --profile crazyflie --set mocap.period_us=500000 | tracker.reacquire_us
fly hover --set controller.gain_y | expected section.key=value
fly hover --set gain_y=1 | expected section.key=value
fly hover --set controller.gain_y.deeper=1 | gain_y is a value, not a section
fly hover --set predictor.horizon=13 | predictor.horizon = 13
fly hover --set serial.baud=1200 | serial.baud = 1200: input should be greater than or equal to 9600
fly hover --set serial.bauds=115200 | did you mean baud?
fly hover --set serial.uplink_bit_error_rate=2 | less than or equal to 1
fly hover --set swarm.wake=0 | --set swarm.wake=0: has no effect on one robot
fly hover --set quadrotor.mass=0.03 | --set quadrotor.mass=0.03: has no effect on the robot of profile floaty
fly hover --set " quadrotor.mass=0.03" | has no effect on the robot of profile floaty
fly hover --profile crazyflie --board empty.elf --set controller.gain_z=3 | has no effect on the robot of profile crazyflie
fly hover --profile crazyflie --board empty.elf --set actuators.tau=0.1 | has no effect on the robot of profile crazyflie
fly take-off-landing --profile crazyflie --board empty.elf | experiment take-off-landing: plant.limits.below=1.15
fly airspeed-9 --profile crazyflie --board empty.elf | experiment airspeed-9: allocation.hover_angle=0.0000
fly identify --profile crazyflie --board empty.elf | has no effect on the robot of profile crazyflie
fly hover --profile crazyflie --set 'robot.decks=["flow3"]' | robot.decks[0] = 'flow3': input should be 'flow2' or 'multir
fly hover --profile crazyflie --set 'robot.decks=["flow2", "flow2"]' | ['flow2', 'flow2']: each deck at most once
fly hover --set plant.airspeed=nan | plant.airspeed = nan: input should be a finite number
fly hover --set tracker.gate=0 | tracker.gate = 0: input should be greater than or equal to 3
fly hover --set tracker.bridge_us=20000 | tracker.bridge_us
fly hover --set tracker.position_noise=0 | tracker.position_noise = 0
fly hover --set tracker.reaquire_us=1 | did you mean reacquire_us?
fly hover --set station.corrections_hz=0 | station.corrections_hz = 0
fly hover --set station.link_latency_us=-1 | station.link_latency_us = -1

fly hover --fault mocap.dropot@3 | unknown kind 'mocap.dropot'; did you mean mocap.dropout?
fly hover --fault servo.stuck.5@3 | did you mean servo.stuck.
fly hover --fault flood@3 | unknown kind 'flood'; floaty list --faults
fly hover --fault mocap.dropout | expected KIND@START
fly hover --fault mocap.dropout@ | expected KIND@START
fly hover --fault mocap.dropout@1=1:2 | expected KIND@START
fly hover --fault mocap.dropout@soon | start, duration and size are numbers
fly hover --fault mocap.dropout@-1 | expected 0 or more after
fly hover --fault mocap.dropout@inf | expected 0 or more after
fly hover --fault mocap.dropout@nan | expected 0 or more after
fly hover --fault mocap.dropout@1:0 | expected more than 0, or inf
fly hover --fault mocap.dropout@1:nan | expected more than 0, or inf
fly hover --fault mocap.dropout@1=1.5 | size 1.5: expected 0..1
fly hover --fault push.x@1=nan | size nan: expected -20..20 N
fly hover --fault servo.stuck.1@1=0.5 | this kind has no size to choose
fly hover --fault motor.stop.1@1 | acts on a part of crazyflie only; this flight is one of floaty
fly hover --fault push.x@30 | the flight ends 30 s after the release, before it begins
fly hover --fault marker.swap@1 | fault marker.swap@1: needs --set markers.enabled=true
fly hover --fault serial.cut@1 | acts with --link mavlink only; this robot has no serial line

station --link udp://127.0.0.1:9 --duration nan | '--duration': nan is not in the range x>0
station --link udp://127.0.0.1:1 --tlog t.tlog | --tlog t.tlog: --link udp://127.0.0.1:1: only mavlink:
station --link udp://127.0.0.1:1 --out a --log b | --log b: --out a has a telemetry.csv
station --link udp://127.0.0.1:1 --mocap replay:/nowhere | --mocap replay:/nowhere: /nowhere: No such file or directory
station --link udp://127.0.0.1:1 --mocap kinect:h | --mocap kinect:h: expected optitrack:HOST
station --link udp://127.0.0.1:1 --set capture.system=optitrak | = 'optitrak': input should be 'optitrack', 'vicon'
station --link udp://127.0.0.1:1 --set capture.system=qualisys --set capture.port=1 | capture.system = qualisys: qualisys:
station --link RADIO --mocap vicon | --mocap vicon: expected optitrack:HOST
station loop --link RADIO | experiment 'loop': unknown
station --link RADIO --log /nowhere/a.csv | --log /nowhere/a.csv: there is no folder /nowhere
station --mocap CAMERAS --link RADIO | Cannot find a Crazyradio Dongle
station --mocap CAMERAS --link radio://0/80/3M/E7E7E7E7E7 | radio://0/80/3M/E7E7E7E7E7: expected radio://
station --mocap CAMERAS --link udp://127.0.0.1 | udp://127.0.0.1: expected radio://
station --mocap CAMERAS --link carrier-pigeon://coop | expected radio://
station --mocap CAMERAS --link mavlink:/nowhere/tty | mavlink:/nowhere/tty: No such file or directory
station --mocap CAMERAS --link mavlink:/dev/null | mavlink:/dev/null: not a serial port
station --mocap CAMERAS --link mavlink:/dev/null,fast | baud rate 'fast': expected 9600..3000000
station --mocap CAMERAS --link mavlink:/dev/null,NINES | 9': expected 9600..3000000
station --mocap CAMERAS --link mavlink:/dev/null,300 | baud rate '300': expected 9600..3000000
station --mocap CAMERAS --link mavlink:/dev/null,9600 | 9600 baud: 50 poses/s need 2.64 kB/s
station --mocap CAMERAS --link mavlink: | mavlink:: expected mavlink:DEVICE[,BAUD]
station --mocap CAMERAS --link mavlink | mavlink: expected mavlink:DEVICE[,BAUD]
station --mocap CAMERAS --link mavlink:carrier-pigeon://coop | expected mavlink:DEVICE[,BAUD]
station --mocap CAMERAS --link mavlink:socket://127.0.0.1:0 | expected mavlink:DEVICE[,BAUD]
station --mocap CAMERAS --link mavlink:socket://127.0.0.1 | expected mavlink:DEVICE[,BAUD]
station --mocap CAMERAS --link mavlink:socket://127.0.0.1:99999 | expected mavlink:DEVICE[,BAUD]
station --mocap CAMERAS --link mavlink:socket://127.0.0.1:9 | mavlink:socket://127.0.0.1:9: Connection refused
station --mocap CAMERAS --link mavlink:rfc2217://127.0.0.1:9 | mavlink:rfc2217://127.0.0.1:9: Connection refused
param list --link usb://1 | usb://1: expected radio://
param set extCtrl.y_P --link udp://127.0.0.1:1 | extCtrl.y_P: expected NAME=VALUE with a number
param set =1 --link udp://127.0.0.1:1 | =1: expected NAME=VALUE with a number
param set extCtrl.y_P= --link udp://127.0.0.1:1 | extCtrl.y_P=: expected NAME=VALUE with a number
param set extCtrl.y_P=two --link udp://127.0.0.1:1 | extCtrl.y_P=two: expected NAME=VALUE with a number

serve --gdb 3333 | --gdb 3333: needs one board and an image as --board
serve --gdb 0 | --gdb 0: needs one board and an image as --board
serve --baud 9600 | --baud: now --set serial.baud=N
serve --natnet | --natnet: now --set capture.natnet=3.1
serve --natnet-port | --natnet-port: now --set capture.port=PORT
serve --multicast | --multicast: now --set capture.multicast=true
serve --up | --up: now --set capture.axes=z-up
station --trajectory | --trajectory: now floaty station EXPERIMENT
view --web | --web: now --view web
serve --set radio.uplink_loss=2 | radio.uplink_loss = 2
serve --set quadrotor.mass=0.03 | quadrotor.mass=0.03: has no effect on the robot of profile floaty
serve --boards 11 | 11
serve --profile crazyflie | profile crazyflie: its robot flies with the Crazyflie's own firmware
serve --profile crazyflie --board x.elf --station corrections | --station corrections: the Crazyflie's own firmware
serve --board x.elf | x.elf: No such file
serve --udp 65530 --boards 10 | --udp 65530
serve --state FILE --udp 0 --no-motive | File exists
serve --mavlink usb | --mavlink usb: expected pty
serve --mavlink '' | --mavlink :
serve --mavlink udp:70000 | --mavlink udp:70000: port 70000
serve --mavlink udp:x | --mavlink udp:x:
serve --mavlink udp:0 | --mavlink udp:0:
serve --mavlink udp:127.0.0.1:x | --mavlink udp:127.0.0.1:x:
serve --mavlink tcp:-1 | --mavlink tcp:-1:
serve --mavlink tcp:65535 --boards 2 | --mavlink tcp:65535:
serve --mavlink tcp:65536 | --mavlink tcp:65536:
serve --mavlink udp:² | --mavlink udp:²:
serve --mavlink tcp:NINES | --mavlink tcp:9999
serve --mavlink pty:/no/folder --no-motive | mavlink pty /no/folder: No such file
serve --mavlink pty --set mavlink.system=255 --boards 2 | mavlink.system = 256

deploy export app | deploy export: now floaty deploy write DIR
deploy write app --profile crazyflie | own firmware, not with the app
deploy flash --uri radio://0/11/2M/E7E7E7E7AA cf2.bin | Cannot find a Crazyradio Dongle
deploy flash --uri udp://127.0.0.1:19850 cf2.bin | udp://127.0.0.1:19850: expected radio://
deploy flash --uri radio://0/11/2M/E7E7E7E7AA nowhere.bin | nowhere.bin: No such file
deploy flash --uri radio://0/11/2M/E7E7E7E7AA cf2.elf | cf2.elf: not an image for the board
deploy flash cf2.bin | Missing option '--uri'
deploy check hovver | did you mean hover?
deploy check hover --all | hover and --all: one or the other
deploy check --fault push.y@1=2 | for which EXPERIMENT?
deploy check hover --targets plain,c | 'c' is none of plain, c-O0, c-O2, cortex-m4
deploy check hover --duration 0 | --duration
deploy check hover --profile flaoty | did you mean floaty?
deploy check hover --source nowhere.c | nowhere.c
deploy check hover --elf nowhere.elf | nowhere.elf: No such file
deploy check hover --source a.c --elf a.elf | one or the other
deploy check hover --elf FILE | not an ELF file
deploy check hover --elf PYTHON | a 64-bit ELF file
deploy check hover --targets plain --elf cf2.elf | --elf cf2.elf: nothing to check it with

design --angle nan | '--angle': nan is not in the range 0<=x<=70
design --json --speed 9.5 | --speed: does not change what --json prints, the model of the profile
design --json --length 2 --out o | --length, --out: does not change what --json prints
design --speed 9 optimise | --speed: before optimise, which does not read it
design --write mine.toml.txt | --write mine.toml.txt: a profile's name ends in .toml
design --profile crazyflie | floaty design takes robots of flat plates; this one's body is crazyflie
drag-model --profile crazyflie | floaty drag-model takes robots of flat plates; this one's body is crazyflie
tune --profile nobody | neither the name of a profile
tune --profile lqr | tune makes gains for the built-in control law
tune --profile lqr --repeat 1 | tune makes gains for the built-in control law
tune --profile crazyflie | not for the Crazyflie's own firmware
tune --out gains.txt | --out gains.txt: a profile's name ends in .toml
tune --out FILE/gains.toml | is not a folder)
tune --repeat 0 | --repeat
tune --board abacus | --board abacus: no such file; expected c, python
tune --vary controller.gain_y=-3..-1 --board abacus | --board abacus: no such file; expected c, python
tune --runs /proc/floaty | --runs /proc/floaty: cannot be written
tune --vary controller.gain_y=-3..-1 --metric rsm_z | --metric rsm_z: did you mean rms_z?
tune --vary controller.gain_y=-3..-1 --experiment hoover | experiment 'hoover': unknown
tune --vary controller.gain_y=-3..-1 --out found.txt | a profile's name ends in .toml
tune --vary logic.gain=1..2 | --vary logic.gain=1..2: logic.gain is no number of profile floaty
tune --vary controller.gain_y | --vary controller.gain_y: expected KEY=LOW..HIGH
tune --vary controller.gain_y=2..1 | expected KEY=LOW..HIGH
tune --vary controller.gain_y=a..b | expected KEY=LOW..HIGH
tune --vary controller.gain_y=nan..1 | expected KEY=LOW..HIGH
tune --vary predictor.enabled=0..1 | predictor.enabled is no number
tune --vary controller=0..1 | expected KEY=LOW..HIGH
tune --vary tunnel.speed=0..11 | tunnel.speed = 0.0:
paper --only fly-to-the-moon | --only fly-to-the-moon: no row matches; there are hover
paper --seeds 0 | --seeds
paper --only hover --out /proc/floaty | --out /proc/floaty: cannot be written
study | `floaty list` names them
study latensy | study 'latensy': unknown; did you mean latency?
campaign nowhere.toml | campaign nowhere.toml: No such file
campaign tabel | campaign 'tabel': neither the name of a campaign (did you mean table?) nor a path
campaign table --shrink 1000 | --shrink 1000: the campaign has flights 0..999
campaign table --workers 2 --cluster tcp://a:1 | --workers 2: not together with --cluster
policy net.pt --out law | net.pt: .pt: expected a file .onnx or

report nowhere | nowhere
report '\x1b]0;x\x07' | \x1b]0;x\x07
view nowhere | nowhere
view FILE | expected a run folder
runs | runs runs: no run folder there; `floaty fly hover` makes one
runs elsewhere | runs elsewhere: no run folder there; `floaty fly hover` makes one
"""
ROWS = [line.split(" | ") for line in TABLE.splitlines() if line]
PLACES = {
    "RADIO": "radio://0/80/2M/E7E7E7E7E7", "CAMERAS": CAMERAS, "NINES": "9" * 5000, "FILE": __file__,
    "PYTHON": os.path.realpath(sys.executable), r"\x1b]0;x\x07": "\x1b]0;x\x07",
}  # fmt: skip


@pytest.fixture(autouse=True)
def without_a_dongle(monkeypatch: pytest.MonkeyPatch, empty_folder: Path) -> None:
    """A folder with images, and a computer without a Crazyradio."""
    Path("cf2.bin").write_bytes(struct.pack("<II", 0x2002_0000, 0x0800_41C1) + bytes(2000))
    Path("cf2.elf").write_bytes(b"\x7fELF" + bytes(500))
    Path("empty.elf").touch()
    monkeypatch.setattr(libusb_package, "get_libusb1_backend", lambda: Backend("127.0.0.1:9"))
    monkeypatch.setattr(RadioManager, "_radios", [])


@pytest.fixture(autouse=True)
def nothing_is_written(without_a_dongle: None) -> Iterator[None]:
    before = {path: path.read_bytes() for path in Path().rglob("*")}
    yield
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(("words", "told"), ROWS, ids=[row[0] for row in ROWS])
def test_bad_input_is_one_line_and_exit_code_two(cli: Cli, words: str, told: str) -> None:
    arguments = shlex.split(words)
    for name, place in PLACES.items():
        arguments = [
            word.replace(name, place) if name != "CAMERAS" or word == name else word for word in arguments
        ]
    assert told in cli.refusal(*arguments)


def parameters(command: click.Command, *names: str) -> Iterator[tuple[tuple[str, ...], click.Parameter]]:
    """Return every option and argument of a command and of its commands."""
    context = click.Context(command)
    for name in command.list_commands(context) if isinstance(command, click.Group) else ():
        inner = command.get_command(context, name)
        assert inner is not None
        yield from parameters(inner, *names, name)
    yield from ((names, one) for one in command.params)


PARAMETERS = list(parameters(app))
TYPED = [  # options that take a number or one of some words
    (names, one)
    for names, one in PARAMETERS
    if isinstance(one, click.Option)
    and isinstance(one.type, click.Choice | type(click.INT) | type(click.FLOAT))
]


@pytest.mark.long
@pytest.mark.parametrize(("names", "option"), TYPED, ids=[" ".join((*n, o.opts[-1])) for n, o in TYPED])
def test_every_option_with_a_number_or_a_choice_names_itself_and_what_it_is_not(
    cli: Cli, names: tuple[str, ...], option: click.Option
) -> None:
    assert len(TYPED) > 40
    told = cli.refusal(*names, option.opts[-1], *["nonsense"] * option.nargs)
    assert option.opts[-1] in told
    assert "nonsense" in told


SEED = "--seed 1 0..4611686018427387904, --profile floaty"
DEFAULTS_AND_BOUNDS = f"""
fly: {SEED}, --seeds 1 1..10000, --link radio, --board c, --gdb 0..65535, --workers 1..1024
view: --view window
runs: folder runs
serve: {SEED}, --udp 0..65535, --radio-port 19840 0..65535, --gdb 0..65535, --boards 1 1..10
station: named hover, --start 1.0 0..3600, --duration 0.., --profile floaty
deploy check: {SEED}
debug: --at crash, --before 1.0 0.0..3600.0, --port 3333 0..65535
paper: --seeds 5 1..1000, --workers 1..1024
study: --seeds 5 1..1000, --workers 1..1024
campaign: --workers 1..1024, --shrink 0..
tune: {SEED}, --seeds 1 1..100, --repeat 1..10, --robots 100 0..1000, --metric distance, --experiment hover, --board c
tune: --duration 0.5..600.0, --flights 120 10..100000, --workers 1..1024
design optimise: {SEED}, --figure least-authority, --generations 25 1..500, --updrafts (8.0, 11.0) 1..60
design: --profile floaty, --speed 1..40, --angle 0..70, --length 1.0 0.1..10, --mass 1.0 0.01..100
drag-model: {SEED}
"""


def test_options_have_their_defaults_and_bounds() -> None:
    """Those of a profile or a folder alone, as of `param` and `replay`, are not listed."""

    def words() -> Iterator[tuple[str, str]]:
        for names, option in PARAMETERS:
            low, high = (getattr(option.type, end, None) for end in ("min", "max"))
            bounds = "" if low is None else f" {low}..{'' if high is None else high}"
            known = not getattr(option, "is_flag", False) and isinstance(
                option.default, int | float | str | tuple
            )
            if (default := f" {option.default}" * (known and option.default != "")) or bounds:
                yield " ".join(names), f"{option.opts[0]}{default}{bounds}"

    listed = {
        (name, word)
        for line in DEFAULTS_AND_BOUNDS.strip().splitlines()
        for name, rest in [line.split(": ", 1)]
        for word in re.split(r", (?=--)", rest)
    }
    assert {one for one in words() if one[1] != "--profile floaty" or one[0] in dict(listed)} == listed


def test_a_name_that_is_no_text_is_one_line(cli: Cli) -> None:
    assert "b'runs/\\xff': expected a name in UTF-8" in cli.refusal("fly", "hover", "--out", "runs/\udcff")


@pytest.mark.parametrize(
    ("target", "told"),
    [("wbe", "expected nothing, web, "), ("connect:here", "expected nothing, web, connect:HOST:PORT or foxglove"),
     ("connect:127.0.0.1:0", "expected nothing, "),
     ("connect:127.0.0.1:65536", "expected nothing, "), ("connect:127.0.0.1:65535", "no viewer listens there ")],
)  # fmt: skip
def test_a_viewer_is_named_by_its_host_and_a_port(target: str, told: str) -> None:
    with pytest.raises(LabError, match=f"^--view {target}: {told}"):
        rerun_screen._there(target)


def test_a_station_refuses_a_port_on_which_no_board_listens(cli: Cli) -> None:
    uri = f"udp://127.0.0.1:{free_port()}"
    assert uri in cli.refusal("station", "--link", uri, "--mocap", CAMERAS)


@pytest.fixture
def taken() -> Iterator[str]:
    """A UDP port of the loopback interface that another program has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        yield str(held.getsockname()[1])


@pytest.mark.long
def test_a_server_names_the_port_that_another_program_has(cli: Cli, taken: str) -> None:
    said = cli.refusal("serve", "--no-motive", "--udp", taken)
    assert said == f"floaty: udp port {taken}: Address already in use\n"
    said = cli.refusal("serve", "--no-motive", "--boards", "2", "--udp", str(int(taken) - 1))
    assert said == f"floaty: robot 2: udp port {taken}: Address already in use\n"
    said = cli.refusal("serve", "--udp", "0", "--set", f"capture.port={taken}")
    assert said.startswith(
        f"floaty: natnet port {taken}: Address already in use; --set capture.port=0 takes a free one"
    )


@pytest.mark.parametrize(("words", "extra"), NEEDS)
def test_a_command_that_needs_an_extra_names_itself_and_an_extra_that_exists(words: str, extra: str) -> None:
    program, name, *options = words.split()
    assert program == "floaty"
    command = app.get_command(click.Context(app), name)
    assert command is not None
    assert {*options} <= {option for one in command.params for option in one.opts}
    assert re.search(rf"^{extra} = \[", (ROOT / "pyproject.toml").read_text("utf-8"), re.MULTILINE)
