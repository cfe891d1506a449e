"""The message for a missing package of one of the project's extras."""

import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

PROJECT = "floaty-hil"  # on no package index, so messages name an extra's packages one by one


def packages_of_extras() -> dict[str, list[str]]:
    """Return the packages of each extra, as pip takes them; none for sources that were never installed."""
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
