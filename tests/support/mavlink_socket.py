"""A bare MAVLink program on pymavlink's own connection: sends, and waits for what it wants to see."""

import os
import time
from collections.abc import Callable
from typing import Any

from pymavlink import mavutil

from support.serving import PATIENCE_S

GAIN = "EXT_Z_P"  # extCtrl.z_P, the parameter that tests tune


class MavlinkSocket:
    """A ground station (system 255, component 190) on an end as `floaty serve --mavlink` prints it."""

    def __init__(self, master: str) -> None:
        os.environ["MAVLINK20"] = "1"  # otherwise it begins with version 1
        self._line = mavutil.mavlink_connection(
            master, baud=57600, source_component=190, dialect="development"
        )
        self.codec, self.close = self._line.mav, self._line.close

    def wait(
        self, kind: str, wanted: Callable[[Any], bool] = lambda _: True, timeout_s: float = PATIENCE_S
    ) -> Any:
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            message = self._line.recv_match(type=kind, blocking=True, timeout=left_s)
            if message is not None and wanted(message):
                return message
        raise AssertionError(f"no {kind} within {timeout_s} s")

    def parameters(self) -> dict[str, Any]:
        """Every PARAM_VALUE of one list, by name."""
        self.codec.param_request_list_send(1, 1)
        found: dict[str, Any] = {}
        deadline = time.monotonic() + PATIENCE_S
        while not found or len(found) < next(iter(found.values())).param_count:
            message = self.wait("PARAM_VALUE", timeout_s=deadline - time.monotonic())
            found[message.param_id] = message
        return found
