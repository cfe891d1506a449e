"""`floaty serve` in this process: what it opens and says, whose exit code it has, and when it ends."""

import signal
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import click
import pytest

from ground_station import records, stops
from hil.commands import options, serve
from hil.errors import LabError
from hil.servers import server, usb_dongle
from support.command import Cli

ALONE = ("--no-motive", "--radio-port", "0")


@pytest.fixture
def _ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the server end at once, as by Ctrl-C."""
    monkeypatch.setattr(stops, "stop_signals", lambda: [signal.SIGINT])


def started(monkeypatch: pytest.MonkeyPatch, code: int) -> list[tuple[int, list[str]]]:
    """Return the programs that a server has started, each of which has ended with a code."""
    programs: list[tuple[int, list[str]]] = []

    def start(port: int, program: list[str]) -> Any:
        programs.append((port, list(program)))
        return Made(poll=lambda: code, wait=lambda: code)

    monkeypatch.setattr(usb_dongle, "start", start)
    monkeypatch.setattr(usb_dongle, "why_not", lambda: "")
    return programs


@pytest.mark.parametrize("code", [0, 5])
def test_a_server_with_a_program_on_its_bus_ends_with_it(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    programs = started(monkeypatch, code)
    monkeypatch.setattr(server.Paced, "stood_still_us", property(lambda clock: 12_400))
    assert cli("serve", *ALONE, "--usb", "--", "radio", "E7") == code
    lines = cli.out.splitlines()
    assert [line.split()[0] for line in lines if "12 ms" not in line] == ["radio", "use", "serving;"]
    port = int(lines[1].partition("FLOATY_DONGLE=127.0.0.1:")[2].split()[0])
    assert programs == [(port, ["radio", "E7"])]
    assert lines[-1] == "stopped; time stood still for 12 ms"


@pytest.mark.parametrize("station", [None, "poses", "corrections"])
@pytest.mark.parametrize("board", [None, "cf2.elf"])
@pytest.mark.parametrize("pilot", [False, True])
def test_the_built_in_station_sends_poses_to_a_crazyflie_s_own_firmware(
    station: str | None, board: str | None, pilot: bool
) -> None:
    asked: Any = Made(station=station, board=board, profile="crazyflie")
    config: Any = Made(pilot=Made(enabled=pilot))
    wrong = "--board FILE" if board is None else "takes poses" if station == "corrections" else ""
    with pytest.raises(LabError, match=wrong) if pilot and wrong else nullcontext():
        assert serve._station_of(asked, config) == ("poses" if pilot else station)


@pytest.mark.parametrize(("names", "expected"), [(None, "a.bin"), (Path("a.elf"), "a.elf")])
def test_a_debugger_gets_the_file_with_the_names(
    monkeypatch: pytest.MonkeyPatch, names: Path | None, expected: str
) -> None:
    @dataclass
    class Image:
        place: object
        debugger: object = None

    monkeypatch.setattr("hil.laboratory.lockstep.debugger", lambda gdb, elf, stack, why: (gdb, str(elf)))
    monkeypatch.setattr("hil.laboratory.lockstep.image_at", lambda board, elf: Image((board, elf)))
    asked: Any = Made(board="a.bin", elf=names, gdb=3333)
    with click.Context(serve.serve):
        assert serve._executor(asked) == Image(("a.bin", names), (3333, expected))


@pytest.mark.usefixtures("_ctrl_c")
def test_a_server_says_how_a_program_gets_the_bus_and_where_its_cameras_are(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs = started(monkeypatch, 5)
    assert cli("serve", "--usb", "--radio-port", "0", "--set", "capture.port=0") == 0
    (usb,) = [line for line in cli.out.splitlines() if line.startswith("usb ")]
    assert usb.endswith(" PROGRAM")
    assert "-m hil.servers.usb_dongle 127.0.0.1:" in usb
    (motive,) = [line for line in cli.out.splitlines() if line.startswith("motive ")]
    assert motive.split(":")[:2] == ["motive optitrack", "127.0.0.1"]
    assert motive.split(":")[2].isdecimal()
    assert programs == []
    monkeypatch.setattr(usb_dongle, "why_not", lambda: "no bus")
    assert cli.refusal("serve", "--usb") == "floaty: --usb: no bus\n"


def test_an_override_without_an_effect_is_refused_by_its_option(cli: Cli) -> None:
    refused = cli.refusal("serve", "--set", "quadrotor.mass=1")
    assert refused == "floaty: --set quadrotor.mass=1: has no effect on the robot of profile floaty\n"


@pytest.mark.parametrize(("words", "absolute", "plan", "endpoints"), [
    ("", True, (1, False, [], None), (19850, None, [], None, True)),
    ("--station --seed 7", False, (7, False, [], None), (19850, None, [], "corrections", True)),
    ("--station poses --no-motive --radio", True, (1, False, [], None), (None, 19840, [], "poses", False)),
    ("--radio --radio-port 5 --udp 6 --state x", True, (1, False, [], Path("x")), (6, 5, [], None, True)),
    ("--mavlink udp:7 --fault serial.cut@1", True, (1, True, ["serial.cut@1"], None), (None, None, 1, None, True)),
])  # fmt: skip
def test_a_server_is_planned_as_it_is_asked_for(
    cli: Cli,
    monkeypatch: pytest.MonkeyPatch,
    words: str,
    absolute: bool,
    plan: tuple[Any, ...],
    endpoints: tuple[Any, ...],
) -> None:
    """Clients send absolute poses, as does the station with poses; markers are for a Motive."""
    asked: list[Any] = []

    def swarm(*what: Any) -> Any:
        asked.extend(what)
        raise LabError("enough")

    monkeypatch.setattr("hil.servers.swarm.Swarm", swarm)
    assert cli.refusal("serve", *words.split()) == "floaty: enough\n"
    service, boards, ends, _ = asked
    assert (boards, service.config.predictor.absolute, service.config.markers.enabled) == (
        1,
        absolute,
        endpoints[-1],
    )
    assert (service.seed, service.mavlink, [str(one) for one in service.faults], service.state) == plan
    mavlink = len(ends.mavlink) or []
    assert (ends.udp, ends.radio, mavlink, ends.station, ends.motive) == endpoints


@pytest.mark.long
@pytest.mark.usefixtures("_ctrl_c")
@pytest.mark.parametrize(("settings", "options"), [
    (("multicast=true", "axes=z-up"), ",multicast,z-up"), (("axes=z-up",), ",z-up"), (("axes=y-up",), ""),
])  # fmt: skip
def test_the_cameras_options_are_those_of_their_stream(
    cli: Cli, settings: tuple[str, ...], options: str
) -> None:
    chosen = [word for setting in ("port=0", *settings) for word in ("--set", f"capture.{setting}")]
    assert cli("serve", "--udp", "0", *chosen) == 0
    (motive,) = [line for line in cli.out.splitlines() if line.startswith("motive ")]
    assert motive.partition(",")[2] == options.removeprefix(",")
    assert [line.split()[0] for line in cli.out.splitlines()] == ["udp", "motive", "serving;", "stopped;"]


class View:
    """A picture in whose panel lines were typed; it keeps the answers."""

    def __init__(self, *lines: str) -> None:
        self._lines, self.answers = [*lines], list[tuple[int, str]]()

    def lines(self) -> list[str]:
        lines, self._lines = self._lines, []
        return lines

    def answer(self, now_us: int, text: str) -> None:
        self.answers.append((now_us, text))

    def __getattr__(self, name: str) -> Any:
        return lambda *what, **more: None


@pytest.mark.long
def test_lines_of_the_panel_are_answered_at_the_terminal_and_in_the_picture(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = View("status", "2 status")
    monkeypatch.setattr(options, "open_live", lambda target, say: view)
    monkeypatch.setattr(stops, "stop_signals", lambda: Answers(view))
    assert cli("serve", "--udp", "0", "--no-motive") == 0
    said = [line for line in cli.out.splitlines() if line.startswith("robot ")]
    assert [line.split()[1] for line in said] == ["1:", "2:"]
    assert [text for _, text in view.answers] == said
    assert view.answers[0][0] > 0


class Answers(list[int]):
    """Ctrl-C once all lines of a picture's panel are answered."""

    def __init__(self, view: View) -> None:
        super().__init__()
        self._view = view

    def __bool__(self) -> bool:
        return len(self._view.answers) == 2


def test_a_server_of_three_has_cameras_for_each_and_closes_what_it_has_opened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said, done = list[str](), list[Any]()
    motive = Made(malformed=3, close=lambda: done.append("motive closed"))
    swarm: Any = Made(
        wait=lambda: [Made(dongles=8), Made(dongles=9)], terminals={}, close=lambda: done.append("swarm closed"),
        listen=lambda own, answer, cameras: done.append(cameras is motive),
    )  # fmt: skip
    own: Any = Made(
        lab=Made(now_us=0), run=lambda stopping: done.append(stopping()),
        open=lambda endpoints, ports: done.append(ports) or Made(dongles=7),
    )  # fmt: skip
    monkeypatch.setattr(serve, "_motive", lambda own, count, say: done.append(count) or motive)
    monkeypatch.setattr(
        serve, "_print_addresses", lambda robots, say: done.append([one.dongles for one in robots])
    )
    monkeypatch.setattr(serve.common, "close_live", lambda view, say: done.append("view closed"))
    monkeypatch.setattr("hil.servers.live_faults.LiveFaults", lambda *what: Made(listen=lambda stream: None))
    monkeypatch.setattr(stops, "stop_signals", list)
    asked: Any = Made(usb=False, program=())
    assert serve._run(own, swarm, server.Endpoints(motive=True), None, said.append, asked) == 0
    assert done == [[8, 9], [7, 8, 9], 3, True, False, "swarm closed", "view closed", "motive closed"]
    assert said == ["serving; Ctrl-C ends", "motive could not read 3 packets"]


@pytest.mark.long
@pytest.mark.usefixtures("_ctrl_c")
def test_the_cameras_track_every_robot_and_a_lost_output_is_told_by_the_exit_code(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: list[int] = []
    open_motive = server.open_motive

    def open_counted(streaming: Any, robot: Any, clock: Any, count: int = 1) -> Any:
        counts.append(count)
        return open_motive(streaming, robot, clock, count)

    monkeypatch.setattr(server, "open_motive", open_counted)
    monkeypatch.setattr(records, "is_writable", lambda stream: False)
    arguments = ("serve", "--set", "capture.port=0", "--boards", "2", "--udp", "0")
    assert (cli(*arguments), cli.out, counts) == (records.INCOMPLETE, "", [2])
    started(monkeypatch, 5)
    assert cli("serve", *ALONE, "--usb", "--", "radio") == 5
