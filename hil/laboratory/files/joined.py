"""Joins tables of one file or several on the clock of the first: its rows, and of the others the newest values."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hil.errors import LabError
from hil.laboratory.files.tables import Table, Values

TIME = {"s": 1e6, "ms": 1e3, "us": 1.0, "µs": 1.0, "ns": 1e-3}
CLOCK = r"t|time|timestamp|time\.stamp|seconds?|tick|time\.from\.the\.release|elapsed(?:\.time)?"


@dataclass(frozen=True, slots=True)
class Source:
    """A column of a file, as a map names it."""

    name: str
    unit: str
    sign: float

    @staticmethod
    def of(text: str) -> Source:
        """Return the source of "NAME [UNIT]", the sign of a minus in front."""
        found = re.fullmatch(r"\s*(-?)\s*(.*?)\s*(?:[\[(]([^\[\]()]*)[\])])?\s*", text, re.DOTALL)
        assert found is not None
        return Source(found[2], (found[3] or "").strip(), -1.0 if found[1] else 1.0)


@dataclass(slots=True)
class Joined:
    """The columns of all files on the clock of the first table."""

    t_us: Values
    columns: dict[str, Values]  # by the names of `Source`
    units: dict[str, str]  # of names with one
    clock: str
    notes: list[str] = field(default_factory=list)


def join(what: str, tables: Sequence[Table], clock: str | float | None) -> Joined:
    """Return all columns on the rows of the first table: of the others the newest value, none before their first."""
    joined = Joined(np.empty(0), {}, {}, "")
    for number, table in enumerate(tables):
        source = _clock_of(what, table, clock if isinstance(clock, str) else None, number == 0)
        times = _values(table, source.name) * TIME[source.unit]
        known = np.where(np.isfinite(times), times, -np.inf)
        advances = known > np.maximum.accumulate(np.concatenate(([-np.inf], known[:-1])))
        if not advances.all():
            still = int((~advances).sum())
            rows_are = "1 row is" if still == 1 else f"{still} rows are"
            joined.notes.append(f"{rows_are} left out: {source.name} does not advance there")
        times = times[advances]
        if not len(times):
            raise LabError(f"{what}: {source.name}: no row with a time")
        rows = np.arange(len(times))
        if number == 0:
            joined.t_us, joined.clock = times, f"{source.name} [{source.unit}]"
        else:
            rows = np.searchsorted(times, joined.t_us, "right") - 1
        for title, values in table.columns.items():
            one = Source.of(title)
            if one.name == source.name:
                continue
            if infinite := int(np.isinf(values).sum()):
                joined.notes.append(f"left out: {one.name}: infinite in {infinite} of {len(values)} rows")
                values = np.where(np.isinf(values), np.nan, values)
            key = one.name if one.name not in joined.columns else f"{one.name}.{number + 1}"
            joined.columns[key] = np.where(rows >= 0, values[advances][np.maximum(rows, 0)], np.nan)
            joined.units[key] = one.unit
        if table.left_out:
            joined.notes.append(f"columns without numbers are left out: {', '.join(table.left_out)}")
        joined.notes += table.notes
    return joined


def _values(table: Table, name: str) -> Values:
    return next(values for title, values in table.columns.items() if Source.of(title).name == name)


def _clock_of(what: str, table: Table, wanted: str | None, is_first: bool) -> Source:
    """Return the source of a table's times, with its unit; only the first table must have the wanted one.

    Without a stated unit it is the one in which a usual step is 0.5 ms to 0.5 s. Raises `LabError`.
    """
    titles = {Source.of(title).name: title for title in table.columns}
    named = wanted is not None and (is_first or Source.of(wanted).name in titles)
    found = (
        wanted if named else next((titles[one] for one in titles if re.fullmatch(CLOCK, words_of(one))), None)
    )
    if found is None or Source.of(found).name not in titles:
        like, names = f" like {found!r}" if found else "", ", ".join([*titles][:12])
        raise LabError(f'{what}: no column of times{like} among {names}; name it in a map: t = "NAME [ms]"')
    source = Source.of(found)
    if source.unit:
        scale_of(what, "t", source, TIME)
        return source
    steps = np.diff(_values(table, source.name))
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    unit = next((unit for unit, scale in TIME.items() if 500.0 <= step * scale <= 5e5), "s")
    return replace(source, unit=unit)


def words_of(name: str) -> str:
    """Return a name in lower case with a dot between its words, without a unit at its end."""
    name = re.sub(r"_(?:m|cm|mm|rad|deg|s|ms|us|ns|v|mv)$", "", name.strip())
    return re.sub(r"[\s_/:.]+", ".", name.lower())


def unit_in(name: str) -> str:
    """Return the unit that a name ends with, as in x_mm; empty without one."""
    found = re.search(r"_(m|cm|mm|rad|deg|mv)$", name, re.IGNORECASE)
    return found[1].lower().replace("mv", "mV") if found else ""


def scale_of(what: str, column: str, source: Source, units: Mapping[str, float]) -> float:
    if source.unit not in units:
        allowed = ", ".join(filter(None, units)) or "none"
        raise LabError(f"{what}: {column} = {source.name!r}: unit {source.unit!r}; expected {allowed}")
    return units[source.unit]
