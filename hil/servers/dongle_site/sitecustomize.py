"""With this folder on PYTHONPATH every Python program sees the virtual dongle (see `hil/servers/dongle_plugin.py`)."""

import importlib.util
from pathlib import Path

_spec = importlib.util.spec_from_file_location(
    "floaty_dongle_plugin", Path(__file__).parent.parent / "dongle_plugin.py"
)
assert _spec is not None
assert _spec.loader is not None
_plugin = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_plugin)
_plugin.install()
