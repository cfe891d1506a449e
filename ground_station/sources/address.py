"""The value of `--mocap`, which overrides `[capture]` of the profile: SYSTEM[:HOST[:PORT]][,OPTION...] or replay:PATH."""

from pathlib import Path
from typing import Any, get_args

from ground_station.config import CaptureConfig, System
from ground_station.errors import MocapError
from ground_station.mocap import MocapSource
from ground_station.sources.motioncapture_client import MotioncaptureSource, settings_of
from ground_station.sources.optitrack import OptitrackSource
from ground_station.sources.replay import ReplaySource

FORMS = (
    "optitrack:HOST[:PORT], vicon:HOST[:PORT], qualisys:HOST or vrpn:HOST[:PORT], "
    "with ,multicast ,body=NAME ,z-up or ,y-up; or replay:PATH"
)
REPLAY = "replay:"


def find_source(text: str | None, capture: CaptureConfig) -> MocapSource:
    """Return the source that `text` names, else the profile's, not open yet; `MocapError` for a malformed one."""
    if text is not None and text.startswith(REPLAY):
        return ReplaySource(Path(text.removeprefix(REPLAY)))
    chosen = capture if text is None else override(text, capture)
    if chosen.system == "qualisys" and chosen.port is not None:
        raise MocapError("qualisys: its client supports only port 22222")
    if chosen.system == "optitrack":
        return OptitrackSource(chosen)
    return MotioncaptureSource(chosen.system, settings_of(chosen), chosen)


def override(text: str, capture: CaptureConfig) -> CaptureConfig:
    """Return `capture` with the values in `text`; another system has its own host, port, multicast and axes."""
    place, *options = text.split(",")
    system, colon, where = place.partition(":")
    if system not in get_args(System):
        raise MocapError(f"expected {FORMS}")
    host, second_colon, port = where.partition(":")
    another = system != capture.system
    if not host and (colon or another):
        raise MocapError(f"expected {FORMS}")
    values: dict[str, Any] = {"system": system}
    if another:
        values |= {"port": None, "multicast": False, "axes": None}
    if host:
        values |= {"host": host, "port": None}
    if second_colon:
        values["port"] = _port(port)
    for option in options:
        values |= _option(option, system)
    return capture.model_copy(update=values)


def _option(option: str, system: str) -> dict[str, Any]:
    if option.startswith("body=") and len(option) > 5:
        return {"body": option[5:]}
    if option in ("z-up", "y-up"):
        return {"axes": option}
    if option == "multicast" and system == "optitrack":
        return {"multicast": True}
    raise MocapError(f"{option!r}: expected {FORMS}")


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 5 and 0 < int(text) < 65536):
        raise MocapError(f"expected {FORMS}")
    return int(text)
