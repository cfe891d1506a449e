"""Put the commit into every wheel and sdist, and the compiled modules into a wheel built with FLOATY_COMPILED set (`make
wheel`)."""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ReleaseHook(BuildHookInterface[Any]):
    """Called by hatchling; compiling needs the packages of the extra `fast`."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the commit, and compile, before a wheel or sdist is packed. An editable installation asks git."""
        if version != "standard":
            return
        sys.path.insert(0, self.root)
        from hil.installation import COMMIT, commit

        # An sdist has the file already, and packs it with the package.
        if not COMMIT.is_file() and (text := commit()):
            self._folder = tempfile.TemporaryDirectory()
            stated = Path(self._folder.name) / COMMIT.name
            stated.write_text(text + "\n", encoding="utf-8")
            build_data["force_include"][str(stated)] = str(COMMIT.relative_to(self.root))
        if self.target_name == "wheel" and "FLOATY_COMPILED" in os.environ:
            sys.path.insert(0, str(Path(__file__).parent))
            from fast import build

            build()
            build_data["artifacts"].append("/firmware_py/compiled/*")
            build_data["pure_python"], build_data["infer_tag"] = False, True
