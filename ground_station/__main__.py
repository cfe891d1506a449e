"""The ground station alone: `python -m ground_station --link URI` holds the robot at home.

It needs nothing of the laboratory. `floaty station` runs the same session and adds experiments, run folders and pictures.
"""

import argparse
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

from pydantic import ValidationError

from ground_station.config import GroundConfig
from ground_station.controls import ControlsError
from ground_station.lines import print_line
from ground_station.operator import Operator, fly_with
from ground_station.program import Session
from ground_station.records import INCOMPLETE, Records
from ground_station.trajectory import Goal, Hold, Trajectory


def main(arguments: list[str] | None = None) -> int:
    """Fly until Ctrl-C; return the exit code: 0, 2 with one line on the error, 3 for an incomplete record."""
    parser = argparse.ArgumentParser(
        "ground_station", description="Send poses to a board that hovers at home."
    )
    parser.add_argument(
        "--link", required=True, metavar="URI", help="radio://…, udp://HOST:PORT or mavlink:DEVICE[,BAUD]"
    )
    parser.add_argument(
        "--mocap", metavar="SYSTEM", help="such as optitrack:HOST, or replay:PATH; overrides [capture]"
    )
    parser.add_argument(
        "--settings", type=Path, metavar="FILE", help="TOML with [station], [tracker], [capture], home, …"
    )
    parser.add_argument("--duration", type=float, metavar="S", help="default: until Ctrl-C")
    parser.add_argument("--log", type=Path, metavar="FILE", help="telemetry as CSV")
    parser.add_argument("--record", type=Path, metavar="FILE", help="frames of motion capture as CSV")
    asked = parser.parse_args(arguments)
    try:
        tree = tomllib.loads(asked.settings.read_text("utf-8-sig")) if asked.settings is not None else {}
        settings = GroundConfig.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        return _refuse(f"--settings {asked.settings}: {key} = {first['input']!r}: {first['msg']}")
    except (OSError, ValueError) as error:
        return _refuse(f"--settings {asked.settings}: {error}")
    records = Records()
    session = Session(
        asked.link,
        asked.mocap,
        lambda home, _: Hold(home),
        log=asked.log,
        record=asked.record,
        records=records,
    )
    operator = Operator(_no_experiment, records.print_text, lambda _: None)
    failure, _ = fly_with(operator, settings, session, records.print_text, asked.duration)
    return _refuse(failure) if failure else INCOMPLETE if records.incomplete else 0


def _no_experiment(name: str) -> Callable[[Goal, int], Trajectory]:
    raise ControlsError(f"fly {name}: only `floaty station` has experiments; here: goal X Y Z [YAW]")


def _refuse(line: str) -> int:
    print_line(line, sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
