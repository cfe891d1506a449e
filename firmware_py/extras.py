"""What to say when a package of one of the project's extras is missing."""

import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

PROJECT = "floaty-hil"  # on no index: what an extra brings is named package by package


def install_command(extra: str) -> str:
    """Return the command that installs an extra's packages for this Python, whether the project is a clone or a wheel."""
    try:
        requirements = [line.replace('"', "'").partition("; ") for line in requires(PROJECT) or ()]
        wanted = [package for package, _, marker in requirements if marker == f"extra == '{extra}'"]
    except PackageNotFoundError:  # sources that were never installed
        wanted = ["--editable", f"{Path(__file__).parents[1]}[{extra}]"]
    return shlex.join((sys.executable, "-m", "pip", "install", *wanted))
