"""Put the commit into every wheel and sdist."""

import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ReleaseHook(BuildHookInterface[Any]):
    """Called by hatchling."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the commit before a wheel or sdist is packed. An editable installation asks git."""
        if version != "standard":
            return
        sys.path.insert(0, self.root)
        from hil.laboratory.files.installation import COMMIT, commit

        # An sdist has the file already, and packs it with the package.
        if not COMMIT.is_file() and (text := commit()):
            self._folder = tempfile.TemporaryDirectory()
            stated = Path(self._folder.name) / COMMIT.name
            stated.write_text(text + "\n", encoding="utf-8")
            build_data["force_include"][str(stated)] = str(COMMIT.relative_to(self.root))
