"""From flight data to the model's constants."""

from importlib.util import find_spec

from firmware_py.extras import install_command
from hil.errors import LabError


def need_scipy() -> None:
    """Raise `LabError` that says how to install it when scipy is missing."""
    if find_spec("scipy") is None:
        raise LabError(f"identify needs scipy: {install_command('identify')}")
