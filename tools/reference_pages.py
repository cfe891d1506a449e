"""The pages of the reference that are tables of the code: profile keys, log columns, kinds of faults, the command line.

mkdocs-gen-files runs this while `make docs` builds the site. `pages` returns their text, so that a test reads what is built.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

sys.path.insert(
    0, str(Path(__file__).parent.parent)
)  # mkdocs runs the file in its own process, from any folder

from hil.config import LabConfig, load_config
from hil.laboratory.fault_kinds import KINDS

# What the groups of columns mean; a group without a sentence, or a sentence without a group, ends the build.
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


def pages() -> dict[str, str]:
    """Return the text of each page by its place in the documentation."""
    return {
        "reference/cli.md": command_line(),
        "reference/profile.md": profile_keys(),
        "reference/log.md": log_columns(),
        "reference/faults.md": fault_kinds(),
    }


def command_line() -> str:
    return (
        "# Command line\n\nWritten from the commands themselves; `floaty COMMAND --help` prints the same.\n\n"
        "::: mkdocs-click\n    :module: hil.commands.app\n    :command: app\n    :prog_name: floaty\n"
        "    :depth: 1\n    :style: plain\n    :list_subcommands: true\n"
    )


def profile_keys() -> str:
    lines = [
        "# Profile keys\n",
        "A profile is everything about a flight that is not the experiment: what is flashed, and the world around it.",
        "Each key can be overridden with `--set SECTION.KEY=VALUE`. The values are those of the profile `floaty`, which",
        "flies when none is named. Written from the models themselves and that profile.",
    ]
    config = load_config()
    for name, field in LabConfig.model_fields.items():
        section = getattr(config, name)
        lines += ["", f"## {name}", ""]
        if not isinstance(section, BaseModel):
            lines.append(cell(field.description or ""))
            continue
        lines += [
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
        "A fault is written `KIND@START:DURATION=SIZE`, the start in seconds after the release; duration and size may be",
        "left out. The outcome is that of the hover with the default profile, size and duration, 6 s after it begins.",
        "Written from the table that flies, as `floaty list --faults` is.",
        "",
        "| kind | meaning | default | from, to | lasts | hover | needs |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, kind in KINDS.items():
        size, bounds = (
            (f"{kind.size:g} {kind.unit}", f"{kind.low:g}, {kind.high:g}") if kind.sized else ("", "")
        )
        lasts = f"{kind.duration_s:g} s" if math.isfinite(kind.duration_s) else "to the end"
        needs = f"`{kind.needs}`" if kind.needs else ""
        lines.append(
            f"| `{name}` | {cell(kind.meaning)} | {size} | {bounds} | {lasts} | {kind.outcome} | {needs} |"
        )
    return "\n".join(lines) + "\n"


def cell(text: str) -> str:
    """One line, which may stand in a table."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


if __name__ == "<run_path>":  # mkdocs-gen-files calls it so
    import mkdocs_gen_files

    for place, text in pages().items():
        with mkdocs_gen_files.open(place, "w") as file:
            file.write(text)
