"""The Crazyflie app around the flight core: a folder that an unmodified crazyflie-firmware checkout builds.

`app/` beside this file holds the sources that are the same for every profile; the core, the profile's constants and the
table of parameters are written into their places here. `app/README.md` describes the app's build and behaviour.
"""

from pathlib import Path

from firmware_py.config import FirmwareConfig
from firmware_py.export.app_logic import calls_header, sensors_source
from firmware_py.export.app_toc import toc_source
from firmware_py.export.app_wire import wire_header
from firmware_py.export.errors import ExportError
from firmware_py.export.profile_c import profile_source
from firmware_py.logic.loading import translation_of

TEMPLATES = Path(__file__).parent / "app"
OWN_SENSORS = Path("src") / "own_sensors.c"  # the user's: written once
MARKER = Path("src") / "floaty_app.c"  # a folder with this file is an app and may be written over


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
    files["src/floaty_settings.h"] = _settings(profile)
    files["src/floaty_calls.h"] = calls_header(config.logic)
    files["src/floaty_wire.h"] = wire_header()
    files["src/floaty_toc.c"] = toc_source(config)
    if sensors := sensors_source(config.logic):
        files[str(OWN_SENSORS)] = sensors
        files["src/Kbuild"] += f"obj-y += {OWN_SENSORS.stem}.o\n"
    return files


def write_app(config: FirmwareConfig, profile: str, folder: Path) -> tuple[Path, ...]:
    """Write the app and return its files; `ExportError` when the folder holds something else, or cannot be written."""
    files = app_files(config, profile)
    try:
        if folder.exists() and any(folder.iterdir()) and not (folder / MARKER).is_file():
            raise ExportError(f"{folder}: neither empty nor an app of Floaty: nothing is written there")
        # The marker first: an app that was not written to its end may be written again.
        for name, text in sorted(files.items(), key=lambda file: file[0] != str(MARKER)):
            path = folder / name
            if name == str(OWN_SENSORS) and path.exists():
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
    except OSError as error:
        raise ExportError(f"{folder}: {error.strerror or error}") from None
    return tuple(folder / name for name in files)


def _settings(profile: str) -> str:
    """Return the header with the profile's name."""
    name = profile.replace("\\", "/").replace('"', "'")
    return (
        "/* The profile that the app was made of. Written by `floaty deploy`. */\n"
        "#pragma once\n\n"
        f'#define FLOATY_PROFILE_NAME "{name}"\n'
    )
