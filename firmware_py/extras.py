"""The message for a missing package of one of the project's extras."""

import shlex
import sys
from pathlib import Path

# Extras of the modules that are imported only where they are needed. Several have scipy.
EXTRAS = {
    "cflib": "radio", "pymavlink": "mavlink", "serial": "mavlink", "motioncapture": "mocap", "tornado": "view",
    "rerun": "view", "perfetto": "view", "google": "view", "mcap": "mcap", "mcap_protobuf": "mcap",
    "mcap_ros2": "mcap", "foxglove": "export", "av": "export", "scipy": "design", "control": "design",
    "ziglang": "deploy", "unicorn": "deploy", "elftools": "deploy", "cffi": "deploy", "onnx": "policy",
    "safetensors": "policy", "distributed": "campaign", "SALib": "campaign", "gymnasium": "learn",
}  # fmt: skip
PROJECT = "floaty-hil"  # on no package index, so messages name an extra's packages one by one


def packages_of_extras() -> dict[str, list[str]]:
    """Return the packages of each extra, as pip takes them; none for sources that were never installed."""
    from importlib.metadata import PackageNotFoundError, requires  # slow to load

    extras: dict[str, list[str]] = {}
    try:
        requirements = requires(PROJECT) or ()
    except PackageNotFoundError:
        requirements = ()
    for requirement in requirements:
        package, _, marker = requirement.replace('"', "'").partition("; extra == ")
        if marker:
            extras.setdefault(marker.strip("'"), []).append(package)
    return extras


def install_command(extra: str) -> str:
    """Return the command that installs an extra's packages for this Python, whether the project is a clone or a wheel."""
    wanted = packages_of_extras().get(extra) or ["--editable", f"{Path(__file__).parents[1]}[{extra}]"]
    return shlex.join((sys.executable, "-m", "pip", "install", *wanted))


def why_missing(error: ImportError) -> str:
    """Return the line about a missing package of an extra, with the command that installs it; empty for other modules."""
    module = (error.name or "").partition(".")[0]
    return f"{module} is missing: {install_command(EXTRAS[module])}" if module in EXTRAS else ""
