"""`floaty station`: the ground station for a board, real or virtual."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from firmware_py.extras import install_command
from hil.commands.options import profile_option, say, set_option, stop_signals
from hil.errors import LabError

if TYPE_CHECKING:
    from ground_station.program import GroundSettings
    from hil.config import LabConfig


@click.command()
@click.option(
    "--link", "uri", required=True, metavar="URI",
    help="radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:19850, or mavlink:DEVICE[,BAUD] with a DEVICE like /dev/ttyUSB0, "
    "COM3, socket://HOST:PORT, rfc2217://HOST:PORT.",
)  # fmt: skip
@click.option(
    "--mocap", metavar="SYSTEM",
    help="Where poses come from, on top of [capture] of the profile: optitrack:HOST[:PORT], also the Motive of `floaty "
    "serve`, vicon:HOST[:PORT], qualisys:HOST, vrpn:HOST[:PORT], each with [,body=NAME] [,z-up|,y-up], optitrack with "
    "[,multicast]; or replay:PATH, a file of --record, a telemetry.csv or a run folder, whose end ends the flight.",
)  # fmt: skip
@click.option(
    "--trajectory", default="hover", show_default=True, metavar="NAME", help="An experiment of `floaty list`."
)
@click.option(
    "--start", "start_s", type=click.FloatRange(0, 3600), default=1.0, show_default=True, metavar="S",
    help="When the trajectory begins, after the board first flies.",
)  # fmt: skip
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
    start_s: float,
    duration: float | None,
    log: Path | None,
    record: Path | None,
    profile: str,
    overrides: tuple[str, ...],
) -> int:
    """Fly a board, real or virtual: poses in, poses or corrections out at 50 Hz, telemetry shown and logged.

    Ctrl-C ends the flight: nothing more goes up, the board puts its flaps to hover, the link is closed.
    """
    from ground_station.errors import LinkError, MocapError
    from ground_station.program import Session, fly, run_until
    from hil.config import load_config
    from hil.experiments import find_experiment

    config = load_config(profile, overrides)
    experiment = find_experiment(trajectory)
    for option, path in (("--log", log), ("--record", record)):
        if path is not None and not path.parent.is_dir():
            raise LabError(f"{option} {path}: there is no folder {path.parent}")
    session = Session(uri, mocap, experiment.trajectory, start_s, log, record)
    stops = stop_signals()
    try:
        fly(settings_of(config), session, say, run_until(lambda: bool(stops), duration))
    except LinkError as error:
        raise LabError(f"--link {error}") from None
    except MocapError as error:
        raise LabError(str(error)) from None
    except OSError as error:
        raise LabError(f"{error.filename}: {error.strerror or error}") from None
    except ImportError as error:
        extra = "mavlink" if uri.startswith("mavlink") else "radio"
        raise LabError(f"--link {uri}: {error}: {install_command(extra)}") from None
    return 0


def settings_of(config: LabConfig) -> GroundSettings:
    """Return what a profile says of the ground station."""
    from ground_station.links.schemes import LinkSettings
    from ground_station.program import GroundSettings

    corrections_hz = min(config.station.corrections_hz, 1e6 / config.mocap.period_us)
    link = LinkSettings(
        corrections_hz, config.station.link_latency_us, config.serial.baud, bytes.fromhex(config.mavlink.signing_key)
    )  # fmt: skip
    period_us, home = config.mocap.period_us, config.flight.home
    return GroundSettings(config.station, config.tracker, config.capture, period_us, home, link)
