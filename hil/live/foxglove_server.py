"""A live flight in Foxglove: a WebSocket server with the topics of `hil.exports.mcap` and the parameters.

A parameter changed there becomes a line for the station's operator; its new value is shown when the board has it.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import foxglove
import pyarrow as pa
from foxglove.websocket import Capability, Client, Parameter, ServerListener

from hil.exports.mcap import log_rows, log_texts
from hil.live.window import LOOPBACK, free_port

PORT = 8765  # Foxglove's own


class FoxgloveScreen(ServerListener):
    """`hil.live.picture.Screen` and the server's listener; `typed` takes lines for the operator."""

    def __init__(self, typed: Callable[[str], None]) -> None:
        self._typed = typed
        self._values: dict[str, float] = {}
        self._context = foxglove.Context()
        self._server = foxglove.start_server(
            name="floaty", host=LOOPBACK, port=free_port(PORT), capabilities=[Capability.Parameters],
            server_listener=self, context=self._context,
        )  # fmt: skip
        self.address = f"ws://{LOOPBACK}:{self._server.port}"

    def show(self, rows: pa.Table, events: Iterable[Mapping[str, Any]]) -> None:
        log_rows(rows, self._context)
        log_texts(events, self._context)

    def know(self, values: Mapping[str, float]) -> None:
        self._values |= values
        self._server.publish_parameter_values(self._parameters(values))

    def close(self) -> None:
        self._server.stop()

    def on_get_parameters(
        self, client: Client, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        """Return parameters, all of them if none is named."""
        return self._parameters(param_names or self._values)

    def on_set_parameters(
        self, client: Client, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        """Pass changes of parameters to the operator; returns the present values."""
        for parameter in parameters:
            value = parameter.get_value()
            if isinstance(value, int | float) and parameter.name in self._values:
                self._typed(f"set {parameter.name} {float(value)!r}")
        return self._parameters([parameter.name for parameter in parameters])

    def _parameters(self, names: Iterable[str]) -> list[Parameter]:
        values = self._values
        return [Parameter(name, value=values[name]) for name in names if name in values]
