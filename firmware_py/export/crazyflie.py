"""The Crazyflie app around the flight core: a folder that an unmodified crazyflie-firmware checkout builds.

`app/` beside this file holds the sources that are the same for every profile; the core, the profile's constants and the
table of parameters are written into their places here. `app/README.md` says how the app is built and how it behaves.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi
from pathlib import Path

from firmware_py.config import (
    AllocationConfig,
    ControllerConfig,
    ExcitationConfig,
    FirmwareConfig,
    LogicConfig,
    ModelConfig,
    PredictorConfig,
    SupervisorConfig,
    parameters_of,
)
from firmware_py.core.structs import Parameters
from firmware_py.core.subset import f32
from firmware_py.export.app_logic import calls_header, own_logs
from firmware_py.export.app_wire import wire_header
from firmware_py.export.errors import ExportError
from firmware_py.export.profile_c import profile_source
from firmware_py.export.reading import float_literal
from firmware_py.logic.loading import load_logic, translation_of
from firmware_py.logic.plugs import GROUP
from firmware_py.parameters import FLAPS, SETPOINT_LIMIT, TRIM_LIMIT, configured_limits, core_fields
from firmware_py.wire.parameter_names import GAINS, SIGNALS

TEMPLATES = Path(__file__).parent / "app"
MARKER = Path("src") / "floaty_app.c"  # a folder with this file is an app and may be written over
PARAM_TYPES = {
    "F32": "PARAM_FLOAT",
    "I32": "PARAM_INT32",
    "U16": "PARAM_UINT16",
    "I16": "PARAM_INT16",
    "U8": "PARAM_UINT8",
}
TARGETS = (
    ("extCtrl.target_yaw", 3, pi),
    ("setpoint.X", 0, SETPOINT_LIMIT),
    ("setpoint.Y", 1, SETPOINT_LIMIT),
    ("setpoint.Z", 2, SETPOINT_LIMIT),
    ("setpoint.Yaw", 3, pi),
)
C_TYPES = {"F32": "float", "I32": "int32_t", "U16": "uint16_t", "I16": "int16_t", "U8": "uint8_t"}


@dataclass(frozen=True, slots=True)
class AppParameter:
    """A parameter of the TOC: `target` = `scale` times the value that a client sees."""

    name: str  # group.name
    kind: str  # of the client's value, a key of PARAM_TYPES
    target: str  # in C
    target_kind: str
    initial: float  # as the client sees it
    low: float
    high: float
    scale: float = 1.0
    persistent: bool = True

    @property
    def variable(self) -> str:
        """The C variable that the client writes."""
        return "seen_" + self.name.replace(".", "_")


def app_parameters(config: FirmwareConfig) -> tuple[AppParameter, ...]:
    """Return the table of parameters with a profile's values, in the order of the groups."""
    core = parameters_of(config).fields
    return (
        *_controls(core),
        *_robot(core),
        *(_field(core, name, key, section) for name, key, section in core_fields()),
        *_excitation(core, config.excitation),
        AppParameter("extPose.absolute", "U8", "floaty_absolute", "U8", 0, 0, 1),
        _supervision(config, "supervisor.poseTimeout", "pose_timeout_us", 1000),
        _supervision(config, "supervisor.lowBattery", "low_battery_mv", 1),
        *_own_logic(config.logic),
    )


def _field(
    core: Parameters,
    name: str,
    field: str,
    section: type,
    kind: str = "F32",
    target_kind: str = "F32",
    sign: int = 1,
) -> AppParameter:
    """Return a parameter that is a number in the core, with the limits of its configuration."""
    low, high = sorted(sign * limit for limit in configured_limits(section, field))
    value = sign * getattr(core, field).item()
    return AppParameter(name, kind, f"floaty_parameters.{field}", target_kind, value, low, high, scale=sign)


def _controls(core: Parameters) -> Iterator[AppParameter]:
    """Yield gains, flap angles from outside, and the set-point."""
    for name, (gain, sign) in GAINS.items():
        yield _field(core, f"extCtrl.{name}", gain, ControllerConfig, sign=sign)
    yield AppParameter("extCtrl.manual", "U8", "floaty_supervisor.manual", "U8", 0, 0, 2, persistent=False)
    for i, name in enumerate(FLAPS):
        c = f"floaty_input.manual[{i}]"
        yield AppParameter(f"extCtrl.{name}", "F32", c, "F32", 0.0, -pi / 2, pi / 2, persistent=False)
    for name, i, limit in TARGETS:
        c = f"floaty_parameters.target[{i}]"
        yield AppParameter(name, "F32", c, "F32", core.target.item(i), -limit, limit, persistent=False)


def _robot(core: Parameters) -> Iterator[AppParameter]:
    """Yield trims, hover angle, servo lag and the predictor."""
    for i, name in enumerate(FLAPS):
        c, trim = f"floaty_parameters.trim[{i}]", int(core.trim.item(i))
        yield AppParameter(f"motorShifts.{name}", "I16", c, "F32", trim, -TRIM_LIMIT, TRIM_LIMIT)
    yield _field(core, "RandConsts.flapHoverAng", "hover_angle", AllocationConfig)
    yield _field(core, "RandConsts.flapTimeConst", "flap_rate", ModelConfig)
    yield AppParameter(
        "delayComp.activate", "U8", "floaty_parameters.predict", "I32", core.predict.item(), 0, 1
    )
    yield _field(core, "delayComp.horizon", "horizon", PredictorConfig, "U8", "I32")
    yield _field(core, "delayComp.defaultAge", "default_age_us", PredictorConfig, "I32", "I32")


def _excitation(core: Parameters, config: ExcitationConfig) -> Iterator[AppParameter]:
    """Yield the excitation; a board that boots excites nothing."""
    c = "floaty_parameters.excite_kind"
    yield AppParameter("excite.signal", "U8", c, "I32", 0, 0, len(SIGNALS) - 1, persistent=False)
    fields = [(f"u{i + 1}", f"excite_rms[{i}]", core.excite_rms.item(i)) for i in range(4)]
    fields += [("low", "excite_low", config.low), ("high", "excite_high", config.high)]
    for name, field, value in fields:
        c, limits = f"floaty_parameters.{field}", configured_limits(ExcitationConfig, name)
        yield AppParameter(f"excite.{name}", "F32", c, "F32", value, *limits, persistent=False)


def _supervision(config: FirmwareConfig, name: str, key: str, scale: int) -> AppParameter:
    low, high = configured_limits(SupervisorConfig, key)
    value = getattr(config.supervisor, key)
    c = f"floaty_supervisor.{key}"
    return AppParameter(name, "U16", c, "I32", value // scale, low / scale, high / scale, scale)


def _own_logic(config: LogicConfig) -> Iterator[AppParameter]:
    """Yield what the user's modules have declared as Tunable."""
    if (logic := load_logic(config)) is None:
        return
    for one in logic.loaded.parameters:
        kind, c = one.base.upper(), f"floaty_{one.block}.{one.name}"
        value = logic.values[one.name]
        yield AppParameter(f"{GROUP}.{one.name}", kind, c, kind, value, one.mark.low, one.mark.high)


def app_files(config: FirmwareConfig, profile: str) -> dict[str, str]:
    """Return the texts of the app's files by their paths in it; `profile` is the name that the board shows."""
    files = {
        path.relative_to(TEMPLATES).as_posix(): path.read_text("utf-8")
        for path in sorted(TEMPLATES.rglob("*"))
        if path.is_file()
    }
    core = translation_of(config.logic)
    files["src/floaty_core.h"] = core.header
    files["src/floaty_core.c"] = core.source
    files["src/floaty_profile.c"] = profile_source(config)
    files["src/floaty_settings.h"] = _settings(config, profile)
    files["src/floaty_calls.h"] = calls_header(config.logic)
    files["src/floaty_wire.h"] = wire_header()
    toc = files["src/floaty_toc.c"].replace("/* @logs */", own_logs(config.logic))
    files["src/floaty_toc.c"] = _toc(toc, app_parameters(config))
    return files


def write_app(config: FirmwareConfig, profile: str, folder: Path) -> tuple[Path, ...]:
    """Write the app and return its files; `ExportError` when the folder holds something else, or cannot be written."""
    files = app_files(config, profile)
    try:
        if folder.exists() and any(folder.iterdir()) and not (folder / MARKER).is_file():
            raise ExportError(f"{folder}: neither empty nor an app of Floaty: nothing is written there")
        for name, text in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
    except OSError as error:
        raise ExportError(f"{folder}: {error.strerror or error}") from None
    return tuple(folder / name for name in files)


def _settings(config: FirmwareConfig, profile: str) -> str:
    """Return the header with what the profile says beyond the core's parameters."""
    name = profile.replace("\\", "/").replace('"', "'")
    return (
        "/* What the profile says beyond the parameters of the core. */\n"
        "#pragma once\n\n"
        f'#define FLOATY_PROFILE_NAME "{name}"\n'
        f"#define FLOATY_POSE_TIMEOUT_US {config.supervisor.pose_timeout_us}\n"
        f"#define FLOATY_LOW_BATTERY_MV {config.supervisor.low_battery_mv}\n"
    )


def _number(value: float) -> str:
    """Return a float32 constant of C."""
    return float_literal(f32(value))


def _value(parameter: AppParameter) -> str:
    return _number(parameter.initial) if parameter.kind == "F32" else str(int(parameter.initial))


def _toc(template: str, parameters: tuple[AppParameter, ...]) -> str:
    """Return the table of parameters in C."""
    variables = [f"static {C_TYPES[p.kind]} {p.variable} = {_value(p)};" for p in parameters]
    table = [
        f'  {{"{p.name}", &{p.variable}, &{p.target}, {_number(p.scale)}, {_number(p.low)}, {_number(p.high)}, '
        f"{_number(p.initial)}, KIND_{p.kind}, KIND_{p.target_kind}}},"
        for p in parameters
    ]
    groups: dict[str, list[str]] = {}
    for p in parameters:
        group, name = p.name.split(".")
        flags = PARAM_TYPES[p.kind] + (" | PARAM_PERSISTENT" if p.persistent else "")
        line = f"PARAM_ADD_WITH_CALLBACK({flags}, {name}, &{p.variable}, floaty_toc_apply)"
        groups.setdefault(group, []).append(line)
    blocks = [
        "\n".join((f"PARAM_GROUP_START({group})", *lines, f"PARAM_GROUP_STOP({group})"))
        for group, lines in groups.items()
    ]
    texts = {"variables": "\n".join(variables), "table": "\n".join(table), "groups": "\n\n".join(blocks)}
    for marker, text in texts.items():
        template = template.replace(f"/* @{marker} */", text)
    return template
