"""The output of `floaty fly`: one flight's verdicts, or a row per seed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.table import Table

from ground_station.latency import budget_line
from hil.board.clock import process_age_s
from hil.commands.options import console, right, say, wide_console

if TYPE_CHECKING:
    from hil.laboratory.files.result import Result
    from hil.laboratory.swarms.result import SwarmResult
    from hil.research.campaigns.jobs import Row

SEED_COLUMNS = (
    ("rms x y z [cm]", ("rms_x", "rms_y", "rms_z"), 100.0, 2),
    ("max x y z [cm]", ("max_x", "max_y", "max_z"), 100.0, 1),
    ("< 6 cm x y z [%]", ("within_6cm_x", "within_6cm_y", "within_6cm_z"), 100.0, 1),
    ("in box [%]", ("in_box",), 100.0, 1),
    ("attitude max [deg]", ("attitude_max",), math.degrees(1.0), 1),
)


def print_seeds(rows: list[Row]) -> None:
    """Print one row per seed and the summary."""
    if not rows:
        return
    job = rows[0].job
    headings = right("seed", *(column[0] for column in SEED_COLUMNS), "hash", "verdict")
    table = Table(*headings, title=f"{job.experiment}, profile {job.options['profile']}")
    for row in rows:
        table.add_row(
            str(row.seed),
            *_cells(row.metrics),
            row.hash[:12],
            "ok" if row.passed else row.error or f"fails: {', '.join(row.failed)}",
        )
    wide_console(140).print(table)
    completed = [row.metrics for row in rows if row.outcome == "completed"]
    lost = sum(row.outcome == "lost" for row in rows)
    passed = sum(row.passed for row in rows)
    say(f"{len(rows)} seeds: {passed} hold all limits, {lost} lost")
    if completed:
        shares, rms = (
            " ".join(
                f"{axis} {100.0 * sum(metrics[name + axis] for metrics in completed) / len(completed):.{digits}f}"
                for axis in "xyz"
            )
            for name, digits in (("within_6cm_", 1), ("rms_", 2))
        )
        say(f"mean of the completed: rms {rms} cm; < 6 cm {shares} % of the time")


def _cells(metrics: Mapping[str, float]) -> list[str]:
    return [
        " ".join(f"{metrics.get(name, math.nan) * scale:.{digits}f}" for name in names)
        for _, names, scale, digits in SEED_COLUMNS
    ]


def print_result(result: Result) -> None:
    """Print one flight's verdicts and files."""
    from hil.laboratory.files.recorder import SETTINGS, load_events

    title = f"{result.request.title}, profile {result.request.profile}"
    table = Table("metric", *right("value", "limit", "verdict"), title=title)
    for row in result.rows:
        table.add_row(*row)
    console.print(table)
    cause = f": {result.cause}" if result.cause else ""
    speed = "" if math.isnan(result.real_time_factor) else f"{result.real_time_factor:.0f} times real time; "
    taken_s = process_age_s()
    taken = "" if math.isnan(taken_s) else f"{taken_s:.1f} s from start to end; "
    say(f"{result.outcome}{cause}; {speed}{taken}hash {result.hash[:16]}")
    for event in load_events(result.folder):
        if event["source"] == SETTINGS:
            say(f"  {event['text']}")
    if result.ages:
        say(budget_line(result.ages))
    if result.usage is not None:
        for name, load in result.usage.entries.items():
            if load.calls:
                say(f"  {result.request.bench.board} {name:11} {load}")
    for name in ("report.html", "flight.rrd", "flight.perfetto-trace", "log.parquet"):
        if (result.folder / name).is_file():
            hint = f"   (floaty view {result.folder})" if name == "flight.rrd" else ""
            say(f"  {result.folder / name}{hint}")


def print_swarm(result: SwarmResult) -> None:
    """Print one row per robot of those that flew together, their common limits and their files."""
    headings = right("robot", "seed", *(column[0] for column in SEED_COLUMNS), "hash", "verdict")
    table = Table(*headings, title=f"{result.request.title}, profile {result.request.robots[0].profile}")
    for number, one in enumerate(result.robots, 1):
        failed = ", ".join(verdict.metric for verdict in one.failed)
        how = "ok" if one.passed else one.cause or f"fails: {failed}"
        table.add_row(str(number), str(one.request.seed), *_cells(one.metrics), one.hash[:12], how)
    wide_console(150).print(table)
    for verdict in result.verdicts:
        say(f"{verdict}: {verdict.mark}; {result.nearest or 'they did not fly together'}")
    passed = sum(one.passed for one in result.robots)
    say(f"{result.outcome}; {passed} of {len(result.robots)} robots hold all limits; hash {result.hash[:16]}")
    for name in ("report.html", "flight.rrd", "swarm.json"):
        if (result.folder / name).is_file():
            hint = f"   (floaty view {result.folder})" if name == "flight.rrd" else ""
            say(f"  {result.folder / name}{hint}")
