"""The flight in the rerun viewer: one picture for simulated and real flights, as a file, from a server, or live.

Entities are below `/world` (`scene`; metres, W), `/plot` and `/state` (`plots`) and `/text`. Only this package uses
rerun, from the extra `view`: without it, importing from here raises `LabError`.
"""

from firmware_py.extras import install_command
from hil.errors import LabError

try:
    import rerun as rerun
except ImportError as error:
    raise LabError(f"the viewer needs rerun: {install_command('view')}") from error
