"""Puts the compiled modules into a wheel that is built with FLOATY_COMPILED set (`make wheel`); others are pure Python."""

import os
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CompiledModulesHook(BuildHookInterface[Any]):
    """What hatchling calls; compiling needs the packages of the extra `fast`."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile before a wheel is packed."""
        if version != "standard" or "FLOATY_COMPILED" not in os.environ:
            return
        sys.path.insert(0, str(Path(__file__).parent))
        from fast import build

        build()
        build_data["artifacts"].append("/firmware_py/compiled/*")
        build_data["pure_python"], build_data["infer_tag"] = False, True
