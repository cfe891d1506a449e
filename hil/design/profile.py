"""A design as a flyable profile: its geometry, its design point, its own model on board, and gains for it."""

from collections.abc import Mapping
from dataclasses import asdict
from math import degrees
from typing import Any

from pydantic import BaseModel

from hil.design.linear import Point
from hil.world.config import GeometryConfig


def profile_text(point: Point, gains: Mapping[str, float], about: str, length: float = 1.0) -> str:
    """Return a TOML profile based on `floaty`; the tunnel grows with a robot `length` times as long, never shrinks."""
    found = point.linear
    model = asdict(found.constants)
    sections: dict[str, Mapping[str, Any]] = {
        "geometry": changes(point.geometry, GeometryConfig()),
        "plant": {"variant": "plate", "airspeed": point.speed, "hover_angle": point.opening},
        "tunnel": {"speed": point.speed} | ({"profile_radius": 0.45 * length} if length > 1.0 else {}),
        "model": {name: float(f"{value:.5g}") for name, value in model.items()},
        "controller": gains,
        "allocation": {"hover_angle": float(f"{point.opening:.6g}"), "opening_min": point.low, "opening_max": point.high},
    }  # fmt: skip
    written = (
        f"{about}\nWritten by floaty design; hover at {degrees(point.opening):.2f} deg and {point.speed:.2f} m/s, C_D = "
        f"{point.coefficient:.4f}. Plate model on board; gains by hil/design/gains.py."
    )
    return toml_text(written, "floaty", sections)


def toml_text(about: str, base: str, sections: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a profile based on another one, with comments first; omit sections without keys."""
    lines = [*(f"# {line}" for line in about.splitlines()), f'base = "{base}"']
    for name, values in sections.items():
        if values:
            lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def changes(section: BaseModel, base: BaseModel) -> dict[str, Any]:
    """Return the values of a section that differ from another profile's."""
    own, usual = section.model_dump(), base.model_dump()
    return {key: value for key, value in own.items() if value != usual[key]}


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)
