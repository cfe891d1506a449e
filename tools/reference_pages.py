"""Generates the reference pages from the code: the command line, profile keys, variables, log columns, faults.

mkdocs-gen-files runs this while `make docs` builds the site. `pages` returns their text, so that a test can read it.
"""

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

sys.path.insert(
    0, str(Path(__file__).parent.parent)
)  # mkdocs runs the file in its own process, from any folder

from firmware_py.firmware import Firmware
from firmware_py.table import OF_PROFILE
from hil.board.pins import VirtualBoard
from hil.commands import app
from hil.config import LabConfig, load_config
from hil.laboratory.fault_kinds import KINDS

# The meaning of the groups of columns; a group without a sentence, or the reverse, ends the build.
GROUPS = {
    "t": "the simulated instant of the row",
    "truth": "what the plant does: the body's position and velocity, its attitude, its rates, the flaps' angles",
    "estimate": "what the flight core believes; position relative to the goal, flaps as deviations from the hover angle",
    "estimator": "what the estimator counts, its horizon, and the age of the pose that it fused last",
    "supervisor": "the supervisor's state, by the numbers of `firmware_py/wire/supervisor.py`",
    "control": "inputs u1 to u4 and flap angles that the control law asks for",
    "motor": "what the four servo timers are set to",
    "imu": "the last counts of gyro and accelerometer",
    "goal": "where the robot is meant to be",
    "flow": "the air at the body",
    "force": "force of the flow on the base plate and on each flap",
    "battery": "voltage of a cell, power and charge",
    "flight": "whether the robot flies freely: it is held before the release",
    "rtos": "the measurement queue: largest length, and measurements dropped",
    "late": "deadlines that each task missed",
    "cpu": "run time of each task",
    "link": "packets of the radio, and the sums of their latencies",
    "serial": "bytes and errors of the serial line",
    "tracker": "what the ground station's tracker makes of frames",
    "markers": "which markers the last exposure saw (bit 0: marker 1), points without a label, error of the fit",
    "fault": "how many faults are in force; only in flights with faults",
    "excite": "what is added to the inputs for identification; only in the experiments `identify` and its kin",
}

LEADS = {
    "cli": "`floaty COMMAND --help` prints the same text. More commands:",
    "profile": "A profile contains everything about a flight except the experiment: the constants on board and the world "
    "around it. Override a key with `--set SECTION.KEY=VALUE`. The tables show the values of the default profile, `floaty`. "
    "More keys:",
}
# Pages of a long reference: title, and commands or sections. One on no page, or on two, ends the build.
COMMANDS = {
    "cli": ("Command line", "list fly new check policy runs view report compare export import docs"),
    "cli-studies": ("Command line: studies", "replay paper study drag-model campaign identify tune design"),
    "cli-programs": ("Command line: programs and real flights", "serve station param"),
    "cli-boards": ("Command line: boards", "board deploy debug"),
}
SECTIONS = {
    "profile": ("Profile keys", "flight swarm limits controller model estimator predictor allocation excitation servo"),
    "profile-board": ("Profile keys: board and station", "supervisor box cpu mavlink logic station pilot tracker capture"),
    "profile-world": ("Profile keys: robot and tunnel", "robot geometry plant actuators quadrotor battery tunnel"),
    "profile-devices": ("Profile keys: sensors and links", "imu sensors mocap markers radio serial"),
}  # fmt: skip


def pages() -> dict[str, str]:
    """Return the text of each page by its path in the documentation."""
    return {
        **split(COMMANDS, list(app.COMMANDS), command_line),
        **split(SECTIONS, list(LabConfig.model_fields), profile_keys),
        **board_variables(),
        "reference/log.md": log_columns(),
        "reference/faults.md": fault_kinds(),
    }


def split(
    plan: Mapping[str, tuple[str, str]], names: list[str], part: Callable[[str], str]
) -> dict[str, str]:
    """Return the pages of a reference by path; the first one introduces it and lists the others."""
    if sorted(" ".join(shown for _, shown in plan.values()).split()) != sorted(names):
        raise ValueError(
            f"tools/reference_pages.py: {', '.join(plan)} do not show each of {', '.join(names)}"
        )
    (first, (whole, _)), *others = plan.items()
    links = [f"- [{title}]({name}.md): `{shown.replace(' ', '`, `')}`" for name, (title, shown) in others]
    leads = dict.fromkeys(plan, f"Continued from [{whole}]({first}.md).")
    leads[first] = "\n".join([LEADS[first], "", *links])
    return {
        f"reference/{name}.md": "\n\n".join([f"# {title}", leads[name], *map(part, shown.split())])
        for name, (title, shown) in plan.items()
    }


def command_line(name: str) -> str:
    """Return the block that shows a command, which mkdocs-click finds by its module."""
    file, function = app.COMMANDS[name].split(".")
    return (
        f"::: mkdocs-click\n    :module: hil.commands.{file}\n    :command: {function}\n"
        f"    :prog_name: floaty {name}\n    :depth: 1\n    :style: plain\n    :list_subcommands: true\n"
    )


def profile_keys(name: str) -> str:
    """Return a section of the profile as a table."""
    section = getattr(load_config(), name)
    if not isinstance(section, BaseModel):
        return f"## {name}\n\n{cell(LabConfig.model_fields[name].description or '')}\n"
    lines = [
        f"## {name}\n",
        cell((type(section).__doc__ or "").split("\n\n")[0]),
        "",
        "| key | value | allowed | meaning, unit, source |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| `{name}.{key}` | `{value}` | {allowed} | {text} |"
        for key, value, allowed, text in rows(section, "")
    ]
    return "\n".join(lines) + "\n"


def rows(section: BaseModel, prefix: str) -> Iterator[tuple[str, str, str, str]]:
    for key, field in type(section).model_fields.items():
        value = getattr(section, key)
        if isinstance(value, BaseModel):
            yield from rows(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", shown(value), allowed_of(field), cell(field.description or "")


def shown(value: object) -> str:
    if isinstance(value, BaseModel):
        return f"{{{', '.join(f'{key} = {shown(part)}' for key, part in value)}}}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(shown, value))}]"
    return cell("true" if value is True else "false" if value is False else repr(value))


def allowed_of(field: FieldInfo) -> str:
    words = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<", "min_length": "length ≥", "max_length": "length ≤"}
    bounds = [
        f"{sign} {getattr(note, name):g}"
        for note in field.metadata
        for name, sign in words.items()
        if getattr(note, name, None) is not None
    ]
    choices = [repr(one) for one in get_args(field.annotation) if isinstance(one, str)]
    return ", ".join(bounds) or " \\| ".join(choices)


def board_variables() -> dict[str, str]:
    """Return the tables of contents of a board that boots with the default profile: parameters and log variables."""
    firmware = Firmware(load_config(), VirtualBoard(lambda *_: None, lambda *_: True, lambda *_: None))
    keys = {parameter.name: key for key, parameter in OF_PROFILE.items()}
    scope = (
        "The table of the Python board, which boots with the profile `floaty`. The exported app has the variables of\n"
        "the core under the same names, unless its firmware has the name already."
    )
    parameters = [
        f"# Parameters of the board\n\n{scope}\n",
        "| parameter | type | unit | allowed | key of the profile | stored |",
        "|---|---|---|---|---|---|",
    ]
    for one in firmware.parameters:
        allowed = "read only" if one.write is None else f"{one.minimum:g} to {one.maximum:g}"
        key, stored = f"`{keys[one.name]}`" if one.name in keys else "", "yes" if one.persistent else ""
        parameters.append(
            f"| `{one.name}` | {one.scalar.name} | {cell(one.unit)} | {allowed} | {key} | {stored} |"
        )
    variables = [f"# Log variables of the board\n\n{scope}\n", "| variable | type | unit |", "|---|---|---|"]
    variables += [f"| `{one.name}` | {one.scalar.name} | {cell(one.unit)} |" for one in firmware.variables]
    return {
        "reference/parameters.md": "\n".join(parameters) + "\n",
        "reference/variables.md": "\n".join(variables) + "\n",
    }


def log_columns() -> str:
    """Fly a tenth of a second over each link and read the schemas of the logs."""
    from hil import fly

    columns: dict[str, tuple[str, str, str, list[str]]] = {}
    with TemporaryDirectory() as folder:
        for link in ("radio", "mavlink"):
            markers = ["markers.enabled=true"]
            run = fly(
                "identify",
                Path(folder) / link,
                duration_s=0.1,
                link=link,
                overrides=markers,
                faults=["push.y@0=0.1"],
            )
            for field in run.log.schema:
                words: Mapping[bytes, bytes] = field.metadata or {}
                unit, frame = words.get(b"unit", b"").decode(), words.get(b"frame", b"").decode()
                columns.setdefault(field.name, (str(field.type), unit, frame, []))[3].append(link)
    groups: dict[str, list[str]] = {}
    for name in columns:
        groups.setdefault(name.split(".")[0], []).append(name)
    if groups.keys() != GROUPS.keys():
        unlike = sorted(groups.keys() ^ GROUPS.keys())
        raise ValueError(f"tools/reference_pages.py: GROUPS and the log's columns differ in {unlike}")
    lines = [
        "# Log columns\n",
        "`log.parquet` has one row per 10 ms. Units and frames stand in the columns' metadata; counters are cumulative.",
        "The log of a [real flight](../howto/real-flights.md) has what its station knows: `cameras.*`, not `truth.*`.",
        "Read from the logs of two short flights, one over each link.",
    ]
    for group, names in groups.items():
        lines += ["", f"## {group}", "", f"{GROUPS[group][0].upper()}{GROUPS[group][1:]}.", ""]
        lines += ["| column | type | unit | frame | link |", "|---|---|---|---|---|"]
        for name in names:
            kind, unit, frame, links = columns[name]
            lines.append(f"| `{name}` | {kind} | {unit} | {frame} | {'' if len(links) == 2 else links[0]} |")
    return "\n".join(lines) + "\n"


def fault_kinds() -> str:
    lines = [
        "# Fault kinds\n",
        "Write a fault as `KIND@START:DURATION=SIZE`. START is in seconds after the release; DURATION and SIZE are",
        "optional. The columns show their defaults, and the allowed sizes in brackets. The column `hover` is the outcome",
        "of a hover with the default profile, 6 s after the fault begins; of the Crazyflie's motors, with the profile",
        "`crazyflie` and Bitcraze's firmware. `floaty list --faults` prints the same table.",
        "",
        "| kind | meaning | size | lasts | hover |",
        "|---|---|---|---|---|",
    ]
    for name, kind in KINDS.items():
        size = f"{kind.size:g} {kind.unit} ({kind.low:g} to {kind.high:g})" if kind.sized else ""
        lasts = f"{kind.duration_s:g} s" if math.isfinite(kind.duration_s) else "to the end"
        needs = f" (needs `{kind.needs}`)" if kind.needs else ""
        lines.append(f"| `{name}` | {cell(kind.meaning)}{needs} | {size} | {lasts} | {kind.outcome} |")
    return "\n".join(lines) + "\n"


def cell(text: str) -> str:
    """Return a text as one line for a table cell."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


if __name__ == "<run_path>":  # mkdocs-gen-files calls it so
    import mkdocs_gen_files

    for place, text in pages().items():
        with mkdocs_gen_files.open(place, "w") as file:
            file.write(text)
