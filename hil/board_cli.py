"""`floaty board serve`: boards in virtual tunnels for any Crazyflie program. `floaty station`: fly a board over cflib."""

import shlex
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hil.errors import LabError
from hil.options import profile_option, set_option

if TYPE_CHECKING:
    from ground_station.links.crazyradio import CrazyradioLink
    from ground_station.links.mavlink_serial import MavlinkSerialLink
    from ground_station.mocap import MocapSource
    from ground_station.sources.config import CaptureConfig
    from hil.config import LabConfig
    from hil.virtual_motive import Streaming

UDP_PORT = 19850  # where cflib looks for boards
RADIO_PORT = 19840
POSE_PORT = 19870
BOARDS_MAX = 10


@click.group()
def board() -> None:
    """Serve boards to other programs."""


@board.command()
@click.option(
    "--udp", type=click.IntRange(0, 65535), metavar="PORT", help="UDP port of the first board; 0: any."
)
@click.option("--radio", is_flag=True, help="Offer a virtual Crazyradio.")
@click.option(
    "--radio-port", type=click.IntRange(0, 65535), default=RADIO_PORT, show_default=True, metavar="PORT",
    help="Where the Crazyradio's server listens; 0: any.",
)  # fmt: skip
@click.option(
    "--mavlink",
    metavar="END",
    help="Lead out a serial line with MAVLink: pty, pty:PATH, udp[:[HOST:]PORT] (talks to a ground station that listens "
    "there), tcp[:[HOST:]PORT] (listens).",
)
@click.option(
    "--baud", type=click.IntRange(9600, 3_000_000), metavar="N",
    help="Bits per second of the serial line.  [default: the profile's]",
)  # fmt: skip
@click.option("--boards", type=click.IntRange(1, BOARDS_MAX), default=1, show_default=True, metavar="N")
@click.option(
    "--faults", metavar="NAME=VALUE,...",
    help="Faults of the radio: loss, bit_error_rate (0..1), jitter_us; with uplink_ or downlink_ for one direction.",
)  # fmt: skip
@click.option("--station", is_flag=True, help="Fly with the built-in ground station.")
@click.option(
    "--poses", type=click.IntRange(0, 65535), default=POSE_PORT, show_default=True, metavar="PORT",
    help="UDP port for the poses of the first board; 0: none.",
)  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(0, 2**62), default=1, show_default=True, help="Of everything random."
)
@profile_option
@set_option
def serve(
    udp: int | None,
    radio: bool,
    radio_port: int,
    mavlink: str | None,
    baud: int | None,
    boards: int,
    faults: str | None,
    station: bool,
    poses: int,
    seed: int,
    profile: str,
    overrides: tuple[str, ...],
    motive: "Streaming | None" = None,  # of `floaty lab serve`
) -> int:
    """Serve boards in virtual tunnels, in real time, until Ctrl-C.

    Without --udp, --radio or --mavlink the first board is on UDP. A board is held until it flies: corrections come
    from clients or, with --station, from within.
    """
    if udp is None and not radio and mavlink is None:
        udp = UDP_PORT
    for option, first in (("--udp", udp), ("--poses", poses)):
        if first is not None and first + boards - 1 > 65535:
            raise LabError(f"{option} {first}: there are no {boards} ports from there on")
    from hil.config import load_config

    if baud is not None:
        if mavlink is None:
            raise LabError(f"--baud {baud}: there is no serial line without --mavlink")
        overrides = (*overrides, f"serial.baud={baud}")
    config = load_config(profile, (*overrides, *_fault_overrides(faults)))
    from ground_station.mocap_udp import PosePublisher
    from hil.board_server import BoardServer
    from hil.cli import announce_compilation
    from hil.serial_server import parse_addresses

    ends = parse_addresses(mavlink, boards) if mavlink is not None else []
    announce_compilation()
    server = BoardServer(config, boards, seed, _say, mavlink=bool(ends))
    if radio:
        _say(radio_hint(server.serve_radio(radio_port), [board.uri for board in server.boards]))
    if udp is not None:
        _say(f"udp    {' '.join(server.serve_udp(udp))}")
    if ends:
        _say(f"mavlink {' '.join(server.serve_mavlink(ends))}")
    if motive is not None:
        port = server.serve_motive(motive).port
        _say(f"motive optitrack:127.0.0.1:{port}{',multicast' if motive.multicast else ''}")
    for number, served in enumerate(server.boards):
        if poses:
            served.publish(PosePublisher(poses + number).send)
        if station:
            served.fly()
    stops = _stop_signals()
    _say("serving; Ctrl-C ends")
    try:
        server.run(lambda: bool(stops))
    finally:
        server.close()
    if server.motive is not None and server.motive.malformed:
        _say(f"motive could not read {server.motive.malformed} packets")
    _say(f"stopped; time stood still for {server.clock.stood_still_us / 1000:.0f} ms")
    return 0


@click.command()
@click.option(
    "--link", "uri", required=True, metavar="URI",
    help="radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:19850, or mavlink:DEVICE[,BAUD] with a DEVICE like /dev/ttyUSB0, "
    "COM3, socket://HOST:PORT, rfc2217://HOST:PORT.",
)  # fmt: skip
@click.option(
    "--mocap", metavar="SYSTEM",
    help="Where poses come from, on top of [capture] of the profile: virtual[:PORT], those that `floaty board serve` "
    "sends; optitrack:HOST[:PORT], vicon:HOST[:PORT], qualisys:HOST, vrpn:HOST[:PORT], each with [,body=NAME] "
    "[,z-up|,y-up], optitrack with [,multicast]; or replay:PATH, a file of --record, a telemetry.csv or a run folder, "
    "whose end ends the flight.",
)  # fmt: skip
@click.option(
    "--trajectory", default="hover", show_default=True, metavar="NAME", help="An experiment of `floaty list`."
)
@click.option(
    "--duration", type=click.FloatRange(min=0, min_open=True), metavar="S", help="[default: until Ctrl-C]"
)
@click.option(
    "--log", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Telemetry as CSV."
)
@click.option(
    "--record", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="Every frame of motion capture as CSV, for --mocap replay:FILE.",
)  # fmt: skip
@profile_option
@set_option
def station(
    uri: str,
    mocap: str | None,
    trajectory: str,
    duration: float | None,
    log: Path | None,
    record: Path | None,
    profile: str,
    overrides: tuple[str, ...],
) -> int:
    """Fly a board, real or virtual: poses in, poses or corrections out at 50 Hz, telemetry shown and logged.

    Ctrl-C ends the flight: nothing more goes up, the board puts its flaps to hover, the link is closed.
    """
    from hil.config import load_config
    from hil.experiments import find_experiment

    config = load_config(profile, overrides)
    experiment = find_experiment(trajectory)
    from ground_station.clock import clock_us
    from ground_station.errors import LinkError
    from ground_station.frame_rate import FrameRate
    from ground_station.live import LiveStation
    from ground_station.sources.record import RecordingSource
    from ground_station.sources.replay import ReplaySource
    from ground_station.station import GroundStation
    from ground_station.telemetry_log import TelemetryLog
    from ground_station.tracker import tracker_of
    from ground_station.trajectory import Goal

    link = _live_link(uri, config)
    tracker = tracker_of(
        config.tracker, config.mocap.period_us
    )  # takes a second, in which no frame should wait
    played = source = _open_source(mocap, config.capture)
    try:
        telemetry = TelemetryLog(log) if log else None
    except OSError as error:
        source.close()
        raise LabError(f"--log {log}: {error.strerror or error}") from None
    try:
        source = RecordingSource(source, record) if record else source
    except OSError as error:
        source.close()
        raise LabError(f"--record {record}: {error.strerror or error}") from None
    stops = _stop_signals()
    start_us = clock_us()
    goal = Goal(config.flight.home, 0.0)
    ground = GroundStation(link, experiment.trajectory(goal, start_us), telemetry, config.station, tracker)

    def stopping() -> bool:
        if isinstance(played, ReplaySource) and played.over:
            return True
        return bool(stops) or (duration is not None and clock_us() - start_us > duration * 1e6)

    rate = FrameRate(config.mocap.period_us, config.station.corrections_hz)
    try:
        LiveStation(link, ground, source, rate, _say, stopping).run()
    except LinkError as error:
        raise LabError(str(error)) from None
    finally:
        source.close()
        if telemetry is not None:
            telemetry.close()
    return 0


def _open_source(mocap: str | None, capture: "CaptureConfig") -> "MocapSource":
    """Return where poses come from, connected."""
    from ground_station.errors import MocapError
    from ground_station.sources.address import find_source

    try:
        source = find_source(mocap, capture)
        source.open()
    except MocapError as error:
        what = f"--mocap {mocap}" if mocap is not None else f"capture.system = {capture.system}"
        raise LabError(f"{what}: {error}") from None
    return source


def _live_link(uri: str, config: "LabConfig") -> "CrazyradioLink | MavlinkSerialLink":
    """Return the link of a URI, not open yet."""
    serial = uri.startswith("mavlink")
    try:
        if not serial:
            from ground_station.links.crazyradio import CrazyradioLink

            return CrazyradioLink(uri, config.station.link_latency_us)
        from ground_station.errors import LinkError
        from ground_station.links.mavlink import MavlinkLinkConfig
        from ground_station.links.mavlink_serial import MavlinkSerialLink
    except ImportError as error:
        from firmware_py.extras import install_command

        extra = "mavlink" if serial else "radio"
        raise LabError(f"--link {uri}: {error}: {install_command(extra)}") from None
    pose_hz = min(config.station.corrections_hz, 1e6 / config.mocap.period_us)
    key = bytes.fromhex(config.mavlink.signing_key)
    latency_us = config.station.link_latency_us
    settings = MavlinkLinkConfig(config.serial.baud, pose_hz, key, latency_us=latency_us)
    try:
        return MavlinkSerialLink(uri, settings)
    except LinkError as error:
        raise LabError(str(error)) from None


def _stop_signals() -> list[int]:
    """Return a list that gets the signals which ask for an orderly end."""
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: stops.append(received))
    return stops


def radio_hint(address: str, uris: list[str]) -> str:
    """Return what to type before a program's name so that it sees the dongle, and where the boards are."""
    folder = Path(__file__).parent / "dongle_site"
    return f"radio  {' '.join(uris)}\nuse    env PYTHONPATH={shlex.quote(str(folder))} FLOATY_DONGLE={address} PROGRAM"


FAULTS = {
    name: keys
    for fault in ("loss", "bit_error_rate", "jitter_us")
    for up, down in [(f"uplink_{fault}", f"downlink_{fault}")]
    for name, keys in ((fault, (up, down)), (up, (up,)), (down, (down,)))
}


def _fault_overrides(faults: str | None) -> tuple[str, ...]:
    """Return the overrides of the profile for --faults."""
    overrides: list[str] = []
    for fault in faults.split(",") if faults else ():
        name, equals, value = (part.strip() for part in fault.partition("="))
        if not equals or name not in FAULTS:
            raise LabError(f"--faults {fault}: expected NAME=VALUE with a name out of {', '.join(FAULTS)}")
        overrides += [f"radio.{key}={value}" for key in FAULTS[name]]
    return tuple(overrides)


def _say(text: str) -> None:
    print(text)
    sys.stdout.flush()
