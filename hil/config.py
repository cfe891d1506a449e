"""A profile: all of a flight except the experiment, as one TOML file checked by one typed model.

`base = "name"` at the top of a profile builds on another one. `--set section.key=value` overrides single values.
Every mistake becomes a `LabError` that names the key, its value and what is allowed.
"""

import json
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from pydantic import BaseModel, Field, ValidationError, field_validator
from pydantic_core import ErrorDetails

from firmware_py.config import FirmwareConfig, LogicConfig
from firmware_py.errors import FirmwareError
from firmware_py.export.errors import ExportError
from firmware_py.logic.laws import SHIPPED_LAWS
from firmware_py.logic.loading import load_logic
from firmware_py.section import Section, number
from ground_station.config import CaptureConfig, GroundConfig, PilotConfig, StationConfig, TrackerConfig
from hil.board.config import ImuConfig, MarkersConfig, MocapConfig, SensorConfig, SerialConfig
from hil.emulator.crazyflie.config import RadioConfig
from hil.errors import LabError, RefusedFileError, hint, shown
from hil.world.config import (
    BatteryConfig,
    GeometryConfig,
    PlantConfig,
    PlantServoConfig,
    SwarmConfig,
    TunnelConfig,
)
from hil.world.floaty.geometry import check
from hil.world.floaty.shape import check_hover
from hil.world.quadrotor import QuadrotorConfig

DEFAULT_PROFILE = "floaty"
Overrides = Sequence[str] | Mapping[str, Any]  # "section.key=value", or the values by "section.key"
_FOLDERS = (Path(__file__).parent.parent / "profiles", Path(__file__).parent / "profiles")


class FlightConfig(Section):
    """Place and time of the flight's begin."""

    home: tuple[float, float, float] = Field(
        (0.0, 0.0, 1.15), description="home goal and start, W [m]; paper: 115 cm above the tunnel's centre"
    )
    start_offset: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="start relative to home, W [m]"
    )
    spacing: float = number(
        0.0,
        "[0, 10]",
        "along y, between the starts of robots that `floaty serve --boards` has in one room [m]",
    )
    release_us: int = number(
        1_000_000, "[0, 60_000_000]", "the robot is held until then: gyro zero, first poses [us]"
    )

    def beside(self, number: int) -> "FlightConfig":
        """Return that of robot 1, 2, 3, ...: the first is in the middle, the others to the left and right of it in turn."""
        x, y, z = self.start_offset
        places = number // 2 if number % 2 == 0 else -(number // 2)
        return self.model_copy(update={"start_offset": (x, y + places * self.spacing, z)})


class RobotConfig(Section):
    """What flies."""

    body: str = Field(
        "floaty",
        description="floaty, crazyflie, or the file with a body of your own (`floaty docs your-own-robot`)",
    )
    decks: tuple[Literal["flow2", "multiranger"], ...] = Field(
        (),
        description="on the board, each once: flow2 (Flow deck v2), multiranger; the image's drivers use them",
    )

    @field_validator("decks")
    @classmethod
    def _each_once(cls, decks: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(decks)) < len(decks):
            raise ValueError("each deck at most once")
        return decks

    @property
    def has_plates(self) -> bool:
        """Whether it is a Floaty: four flaps in mirror symmetry, of flat plates, whose geometry the profile gives."""
        return self.body == "floaty"

    def need_plates(self, profile: str, command: str) -> None:
        """Raise `LabError` for a command that computes with flat plates when the profile's robot has none."""
        if not self.has_plates:
            raise LabError(
                f"profile {profile}: {command} takes robots of flat plates; this one's body is {self.body}"
            )


class LabConfig(FirmwareConfig):
    """The flashed firmware, and the world around it."""

    robot: RobotConfig = Field(default_factory=RobotConfig)
    geometry: GeometryConfig = Field(default_factory=GeometryConfig)
    plant: PlantConfig = Field(default_factory=PlantConfig)
    actuators: PlantServoConfig = Field(default_factory=PlantServoConfig)
    quadrotor: QuadrotorConfig = Field(default_factory=QuadrotorConfig)
    battery: BatteryConfig = Field(default_factory=BatteryConfig)
    tunnel: TunnelConfig = Field(default_factory=TunnelConfig)
    imu: ImuConfig = Field(default_factory=ImuConfig)
    sensors: dict[str, SensorConfig] = Field(
        default_factory=dict,
        description="of your own robot, by the name in its `sensed`: `noise` in its unit, `delay_us`, `dropout` (a share)",
    )
    mocap: MocapConfig = Field(default_factory=MocapConfig)
    markers: MarkersConfig = Field(default_factory=MarkersConfig)
    radio: RadioConfig = Field(default_factory=RadioConfig)
    serial: SerialConfig = Field(default_factory=SerialConfig)
    station: StationConfig = Field(default_factory=StationConfig)
    pilot: PilotConfig = Field(default_factory=PilotConfig)
    tracker: TrackerConfig = Field(default_factory=TrackerConfig)
    capture: CaptureConfig = Field(default_factory=CaptureConfig)
    flight: FlightConfig = Field(default_factory=FlightConfig)
    swarm: SwarmConfig = Field(default_factory=SwarmConfig)
    limits: dict[str, dict[str, float]] = Field(
        default_factory=dict, description="limits by experiment that replace the experiment's own"
    )

    @property
    def ground(self) -> GroundConfig:
        """The ground station's settings."""
        return GroundConfig(
            station=self.station,
            tracker=self.tracker,
            capture=self.capture,
            frame_period_us=self.mocap.period_us,
            home=self.flight.home,
            baud=self.serial.baud,
            signing_key=self.mavlink.signing_key,
        )

    def check_cameras(self) -> None:
        """Raise `LabError` for cameras that are too slow for a track or for the board."""
        limits = {
            "tracker.reacquire_us": self.tracker.enabled and self.tracker.reacquire_us,
            "supervisor.pose_timeout_us": not self.pilot.enabled and self.supervisor.pose_timeout_us,
        }
        for key, limit_us in limits.items():
            if limit_us and self.mocap.period_us >= limit_us:
                raise LabError(
                    f"mocap.period_us = {self.mocap.period_us}: no pose would be flown, expected less than "
                    f"{key} = {limit_us}"
                )

    def check_decks(self, is_image: bool) -> None:
        """Raise `LabError` for decks without the firmware that has drivers for them."""
        if self.robot.decks and not (is_image and self.pilot.enabled):
            raise LabError(
                f"robot.decks = {', '.join(self.robot.decks)}: the drivers are in the Crazyflie's own firmware; "
                "--profile crazyflie --board FILE"
            )

    def check_effect(self, start: str, overrides: Iterable[str], profile: str) -> None:
        """Raise `LabError`, whose text begins with `start`, for an override of a section that does not affect this robot."""
        for override in overrides:
            if not self.reads(override.partition(".")[0].strip()):
                raise LabError(f"{start}{override}: has no effect on the robot of profile {profile}")

    def reads(self, section: str) -> bool:
        """Whether a section affects this robot; a user's body may read them all."""
        if self.pilot.enabled:  # not Floaty's body or firmware
            return section not in {"geometry", "plant", "actuators", *FirmwareConfig.model_fields}
        return section != "quadrotor" or not self.robot.has_plates


def profile_names() -> list[str]:
    return sorted({path.stem for folder in _FOLDERS if folder.is_dir() for path in folder.glob("*.toml")})


def load_config(profile: str = DEFAULT_PROFILE, overrides: Iterable[str] = ()) -> LabConfig:
    """Return the configuration of a profile that flies: as `read_config`, with the modules of `[logic]` executed."""
    config = read_config(profile, overrides)
    check_logic(config)
    return config


def check_logic(config: LabConfig) -> None:
    """Execute the modules of `[logic]`. Raises `LabError` for those that cannot fly, a line for each refusal."""
    try:
        load_logic(config.logic)
    except ExportError as error:
        raise RefusedFileError(str(error)) from None
    except FirmwareError as error:
        raise LabError(str(error)) from None


def read_config(profile: str = DEFAULT_PROFILE, overrides: Iterable[str] = ()) -> LabConfig:
    """Return the configuration of a profile (a shipped name, or a path) with `section.key=value` overrides.

    Nothing that the profile names is executed.
    """
    tree = _read_profile(profile, ())
    for override in overrides:
        _apply(tree, override)
    _locate_files(tree, Path.cwd())
    try:
        config = LabConfig.model_validate(tree)
        check(config.geometry)
        check_hover(config.geometry, config.plant)
        config.check_cameras()
    except ValidationError as error:
        raise LabError("; ".join(_explain(tree, detail) for detail in error.errors()[:3])) from None
    except FirmwareError as error:
        raise LabError(str(error)) from None
    return config


def _locate_files(tree: dict[str, Any], folder: Path) -> None:
    """Make the paths in `[logic]` and `[robot]`, relative to this folder, absolute."""
    for name, model in (("logic", LogicConfig), ("robot", RobotConfig)):
        section: Any = tree.get(name)
        for key in model.model_fields.keys() & section.keys() if isinstance(section, dict) else ():
            value = section[key]
            if isinstance(value, str) and key == "controller" and value in SHIPPED_LAWS:
                section[key] = SHIPPED_LAWS[value]
            elif isinstance(value, str) and value and (name == "logic" or value.endswith(".py")):
                section[key] = str((folder / value).resolve())


def settings_of(overrides: Overrides) -> tuple[str, ...]:
    """Return overrides as "section.key=value". Raises `LabError` for an impossible value."""
    if not isinstance(overrides, Mapping):
        return tuple(overrides)
    return tuple(f"{name}={_toml_of(name, value)}" for name, value in overrides.items())


def _toml_of(name: str, value: Any) -> str:
    """Return a value as TOML, a text as a bare word if equivalent."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml_of(name, one) for one in value)}]"
    if isinstance(value, str):
        return value if _toml_value(value) == value == value.strip() else json.dumps(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    raise LabError(
        f"overrides: {name} = {shown(value)}: expected a number, text, True, False, or a list of them"
    )


def read_toml(kind: str, path: Path) -> dict[str, Any]:
    """Return the table of a TOML file of a kind ("profile"). Raises `LabError` when it cannot be read or is not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise LabError(f"{kind} {path}: {error.strerror or error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LabError(f"{kind} {path}: not TOML: {error}") from None


def base_name(profile: str) -> str:
    """Return the name of a profile as the base of another one, stored anywhere."""
    return Path(profile).resolve().as_posix() if profile.endswith(".toml") else profile


def _read_profile(profile: str, children: tuple[Path, ...]) -> dict[str, Any]:
    path = _find_profile(profile, children)
    tree = read_toml("profile", path)
    _locate_files(tree, path.parent)
    base = tree.pop("base", None)
    if base is None:
        return tree
    if not isinstance(base, str):
        raise LabError(f"profile {path}: base = {base!r}: expected the name or path of a profile")
    if path in children:
        raise LabError(f"profile {path}: base = {base!r} leads back to itself")
    return _merge(_read_profile(base, (*children, path)), tree)


def _find_profile(profile: str, children: tuple[Path, ...]) -> Path:
    if profile.endswith(".toml"):
        path = Path(profile)
        beside = children[-1].parent / path if children and not path.is_absolute() else path
        return (beside if beside.is_file() else path).resolve()
    for folder in _FOLDERS:
        if (folder / f"{profile}.toml").is_file():
            return (folder / f"{profile}.toml").resolve()
    raise LabError(
        f"profile {profile!r}: neither the name of a profile ({hint(profile, profile_names())}) "
        "nor a path that ends in .toml"
    )


def _merge(base: dict[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in change.items():
        below = merged.get(key)
        merged[key] = _merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _apply(tree: dict[str, Any], override: str) -> None:
    """Put `section.key=value` or `section.key[i]=value` into the tree; the value is TOML, or a bare word."""
    name, equals, text = override.partition("=")
    keys = name.strip().split(".")
    if not equals or len(keys) < 2 or not all(keys):
        raise LabError(f"--set {override}: expected section.key=value")
    value = _toml_value(text.strip())
    for key in keys[:-1]:
        below = tree.setdefault(key, {})
        if not isinstance(below, dict):
            raise LabError(f"--set {override}: {key} is a value, not a section")
        tree = below
    leaf, bracket, index = keys[-1].partition("[")
    if not bracket:
        tree[leaf] = value
        return
    items = tree.get(leaf)
    position = index.rstrip("]")
    if not isinstance(items, list) or position not in map(str, range(len(items))):
        raise LabError(f"--set {override}: {leaf} has no element [{position}] in this profile")
    tree[leaf] = [*items[: int(position)], value, *items[int(position) + 1 :]]


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _explain(tree: Mapping[str, Any], detail: ErrorDetails) -> str:
    """Return one line: the key, its value, what is allowed."""
    location = [str(part) for part in detail["loc"]]
    name = re.sub(r"\.(\d)", r"[\1]", ".".join(location))
    if detail["type"] == "missing":
        return f"{name}: missing; a profile without `base` states every constant that is flashed"
    value = detail["input"]
    if detail["type"] == "extra_forbidden":
        allowed = keys_at(LabConfig, location[:-1])
        return f"{name} = {value!r}: unknown key{f' ({hint(location[-1], allowed)})' if allowed else ''}"
    advice = "; still air is tunnel.fan_factor = 0" if name == "tunnel.speed" and value == 0 else ""
    why = detail["msg"].removeprefix("Value error, ")  # of a validator
    return f"{name} = {value!r}: {why[0].lower()}{why[1:]}{advice}"


def keys_at(model: Any, location: list[str]) -> list[str]:
    """Return the keys of the model at a location, which may pass dict keys and list indices; empty without a model."""
    for part in location:
        if part in model.model_fields:
            annotation = model.model_fields[part].annotation
            candidates = [annotation, *get_args(annotation)]
            model = next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), None)
        if model is None:
            return []
    return list(model.model_fields)
