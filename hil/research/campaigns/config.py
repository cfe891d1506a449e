"""The contents of a campaign's TOML file: experiments, varied values, when to stop, and limits on a flight's time.

Every mistake is a `LabError` of one line that names the key, its value and what is allowed.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails

from hil.board.cores.boards import BOARDS, C
from hil.config import DEFAULT_PROFILE, keys_at, read_toml
from hil.errors import LabError, hint
from hil.laboratory.bodies import MEASURED
from hil.world.config import ConstantName

Value = bool | int | float | str
Sampling = Literal["random", "sobol", "latin", "saltelli", "morris"]
DESIGNS = ("saltelli", "morris")  # the indices need all their points, so they cannot stop early
STOP = re.compile(r"failure rate known to (?:±|\+-)\s*(\d+(?:\.\d+)?)\s*%")
# Pydantic's names for the forms of a value, in the location of an error.
FORM = re.compile(r"(float|Distribution)$|(tuple|literal|function-\w+)\[")
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="strings")


class Distribution(_Part):
    """One number's distribution: exactly one of the four."""

    uniform: tuple[Finite, Finite] | None = Field(None, description="[low, high]")
    log_uniform: tuple[Finite, Finite] | None = Field(None, description="[low, high], above 0")
    normal: tuple[Finite, Finite] | tuple[Finite, Finite, Finite, Finite] | None = Field(
        None, description="[mean, deviation], or [mean, deviation, low, high] cut there"
    )
    choice: tuple[Value, ...] | None = Field(None, description="each as likely as the others", min_length=1)

    @model_validator(mode="after")
    def _is_one(self) -> Distribution:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of {', '.join(type(self).model_fields)}")
        for bounds in (self.uniform, self.log_uniform, self.normal and self.normal[2:]):
            if bounds and not bounds[0] < bounds[1]:
                raise ValueError("expected low < high")
        if self.log_uniform and self.log_uniform[0] <= 0.0:
            raise ValueError("log_uniform: expected bounds above 0")
        if self.normal and self.normal[1] <= 0.0:
            raise ValueError("normal: expected a deviation above 0")
        return self


Number = float | Distribution


class SampledFault(_Part):
    """A fault of every flight, or of a share of them."""

    kind: str = Field(description="as `floaty list --faults` shows it")
    probability: float = Field(1.0, gt=0, le=1, description="that it occurs in a flight")
    start_s: Number = Field(description="after the release [s]")
    duration_s: Number | None = Field(None, description="[s]; default: the kind's")
    size: Number | None = Field(None, description="in the kind's unit; default: the kind's")


class TableConfig(_Part):
    """Constants of the paper's Table, each within its ±; applied as `plant.constant_factors`."""

    constants: Literal["all"] | tuple[ConstantName, ...] = Field("all", description="by name")
    distribution: Literal["uniform", "normal"] = Field(
        "uniform", description="over value ± uncertainty, or with the uncertainty as its deviation"
    )

    @property
    def names(self) -> tuple[str, ...]:
        """The constants, in the Table's order; the plant does not vary z_vz."""
        known = get_args(ConstantName)
        chosen = known if self.constants == "all" else self.constants
        return tuple(name for name in MEASURED if name in chosen)


class FlightLimits(_Part):
    """Limits that abort a flight; its row has the limit as its error."""

    wall_s: float = Field(120.0, gt=0, le=86_400, description="real time; the process is ended at twice this")
    simulated_s: float = Field(3_600.0, gt=0, le=100_000, description="simulated time, from the boot on")


class Spec(_Part):
    """A campaign. Flight number i depends only on this and i."""

    experiments: tuple[str, ...] = Field(min_length=1, description="names, or FILE.py:NAME")
    profiles: tuple[str, ...] = Field((DEFAULT_PROFILE,), min_length=1)
    settings: tuple[str, ...] = Field((), description="section.key=value, of every flight")
    duration_s: float | None = Field(None, gt=0, description="free flight [s]; default: the experiment's")
    link: Literal["radio", "mavlink"] = "radio"
    board: str = Field(
        C, description=f"{', '.join(BOARDS)}, or the image of a Crazyflie's firmware, an ELF file"
    )
    flights: int = Field(ge=1, le=10_000_000)
    seeds: int = Field(1, ge=1, description="flights per point, profile and experiment")
    seed: int = Field(1, ge=0, le=2**61, description="of the sampling, and of the first flight")
    sampling: Sampling = "random"
    stop: str = Field("", description='"failure rate known to ±1 %": with 95 % confidence')
    parameters: dict[str, Distribution] = Field({}, description="by section.key of the profile")
    table: TableConfig | None = None
    faults: tuple[SampledFault, ...] = ()
    limits: FlightLimits = FlightLimits()

    @field_validator("stop")
    @classmethod
    def _says_when(cls, stop: str) -> str:
        match = STOP.fullmatch(stop)
        if stop and (match is None or not 0.0 < float(match[1]) < 50.0):
            raise ValueError('expected "failure rate known to ±1 %", above 0 and below 50')
        return stop

    @model_validator(mode="after")
    def _fits(self) -> Spec:
        if self.stop and self.sampling in DESIGNS:
            raise ValueError(f"stop: sampling {self.sampling} needs all its flights")
        if both := self.parameters.keys() & {name for name, _ in table_dimensions(self.table)}:
            raise ValueError(f"{min(both)}: is in both [parameters] and [table]")
        return self

    @property
    def half_width(self) -> float | None:
        """The half width of the failure rate's interval at which to stop; None: fly all."""
        match = STOP.fullmatch(self.stop)
        return float(match[1]) / 100.0 if match else None

    @property
    def cells(self) -> int:
        """Flights per point of the sampling."""
        return len(self.experiments) * len(self.profiles) * self.seeds

    @property
    def points(self) -> int:
        """Points of the sampling; the last one may have fewer flights."""
        return math.ceil(self.flights / self.cells)


def table_dimensions(table: TableConfig | None) -> list[tuple[str, Distribution]]:
    """Return the constants that vary within the Table's uncertainty, as factors on the tabulated values."""
    found = []
    for name in table.names if table else ():
        value, error = MEASURED[name]
        spread = error / abs(value)
        varies = (
            Distribution(uniform=(1.0 - spread, 1.0 + spread))
            if table and table.distribution == "uniform"
            else Distribution(normal=(1.0, spread, 0.0, 4.0))  # the range that the plant accepts
        )
        found.append((f"plant.constant_factors.{name}", varies))
    return found


def find_spec(campaign: str) -> Path:
    """Return the file of a campaign: a path that ends in .toml, or a shipped name. Raises `LabError`."""
    if campaign.endswith(".toml"):
        return Path(campaign)
    names = sorted(path.stem for path in Path(__file__).parent.glob("*.toml"))
    if campaign not in names:
        raise LabError(
            f"campaign {campaign!r}: neither the name of a campaign ({hint(campaign, names)}) nor a path that ends in .toml"
        )
    return Path(__file__).with_name(f"{campaign}.toml")


def read_spec(path: Path) -> Spec:
    """Return the campaign of a file; paths in it are relative to its folder. Raises a one-line `LabError`."""
    tree = read_toml("campaign", path)
    try:
        spec = Spec.model_validate(tree)
    except ValidationError as error:
        # A misspelt key explains a missing one, and the deepest error concerns the form that the user chose.
        found = min(error.errors(), key=lambda one: (one["type"] != "extra_forbidden", -len(one["loc"])))
        raise LabError(f"campaign {path}: {_explain(found)}") from None
    folder = path.parent.resolve()
    return spec.model_copy(
        update={
            "experiments": tuple(str(folder / one) if ".py" in one else one for one in spec.experiments),
            "profiles": tuple(str(folder / one) if one.endswith(".toml") else one for one in spec.profiles),
            "board": spec.board if spec.board in BOARDS else str(folder / spec.board),
        }
    )


def _explain(detail: ErrorDetails) -> str:
    """Return the error: the key, its value, what is allowed."""
    names = [str(part) for part in detail["loc"] if not FORM.match(str(part))]
    where, value = ".".join(names), detail["input"]
    if detail["type"] == "missing":
        return f"{where}: missing"
    if detail["type"] == "extra_forbidden":
        return f"{where} = {value!r}: unknown key; {hint(names[-1], keys_at(Spec, names[:-1]))}"
    message = detail["msg"].removeprefix("Value error, ").replace("valid tuple", "valid list")
    message = message[0].lower() + message[1:]
    return f"{where} = {value!r}: {message}" if where else message


def spec_text(spec: Spec) -> dict[str, Any]:
    """Return a campaign as JSON values."""
    return spec.model_dump(mode="json", exclude_none=True)
