"""A section of a profile, and how it declares a number: the default, the allowed interval, and meaning, unit and source."""

from ast import literal_eval
from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    """A strict, immutable part of the configuration."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


def number(default: Any, interval: str, meaning: str) -> Any:
    """Declare a number that lies in an interval like `(0, 5]`, open at a parenthesis and closed at a bracket."""
    low, high = map(literal_eval, interval[1:-1].split(", "))
    bounds = {"gt" if interval[0] == "(" else "ge": low, "lt" if interval[-1] == ")" else "le": high}
    return Field(default, description=meaning, **bounds)
