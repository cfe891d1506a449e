"""A live flight in Foxglove: a WebSocket server with the topics of `hil.pictures.exports.mcap`, and parameters if wanted.

Foxglove's own server accepts any page in a browser, so this one speaks its protocol (`foxglove.sdk.v1`); the SDK encodes the
messages, as MCAP. A client needs the token in the address, and a page must be Foxglove's or of this computer. A parameter
changed there becomes a line for the station's operator; its new value is shown when the board has it.
"""

import base64
import io
import json
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import foxglove
import pyarrow as pa
from foxglove.mcap import MCAPWriteOptions
from tornado.ioloop import IOLoop
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from hil.live.local_server import Guarded, LocalServer
from hil.pictures.exports.mcap import log_rows, log_texts

PORT = 8765  # Foxglove's own
PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
SITES = ("app.foxglove.dev", "localhost", "127.0.0.1")  # whose pages may connect
WAITING_MAX = 2000  # messages for a client that reads slowly: two seconds of a flight
MAGIC_SIZE, SCHEMA, CHANNEL, MESSAGE, FOOTER = 8, 3, 4, 5, 15  # of MCAP
_RECORD = struct.Struct("<BQ")  # kind, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, number, log time [ns], publish time [ns]
_DATA = struct.Struct("<BIQ")  # of Foxglove: operation 1, subscription, log time [ns]


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic with the type of its messages."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes

    def described(self, number: int) -> dict[str, Any]:
        """Return it as Foxglove advertises it; a schema that is not text travels as base64."""
        text = "json" in self.schema_encoding
        schema = self.schema.decode() if text else base64.b64encode(self.schema).decode()
        return {
            "id": number, "topic": self.topic, "encoding": self.encoding, "schemaName": self.schema_name,
            "schemaEncoding": self.schema_encoding, "schema": schema,
        }  # fmt: skip


def read_mcap(data: bytes) -> Iterator[tuple[Channel, int, bytes]]:
    """Yield channel, log time [ns] and content of the messages of an MCAP file without chunks."""
    schemas: dict[int, tuple[str, str, bytes]] = {}
    channels: dict[int, Channel] = {}
    at = MAGIC_SIZE
    while data[at] != FOOTER:
        kind, size = _RECORD.unpack_from(data, at)
        record = memoryview(data)[at + _RECORD.size :][:size]
        at += _RECORD.size + size
        if kind == SCHEMA:
            name, encoding, content = _strings(record[2:], 3)
            schemas[_number(record)] = (name.decode(), encoding.decode(), content)
        elif kind == CHANNEL:
            topic, encoding = _strings(record[4:], 2)
            schema = schemas[_number(record[2:])]
            channels[_number(record)] = Channel(topic.decode(), encoding.decode(), *schema)
        elif kind == MESSAGE:
            number, _, time_ns, _ = _MESSAGE.unpack_from(record)
            yield channels[number], time_ns, bytes(record[_MESSAGE.size :])


def _number(record: memoryview) -> int:
    return int.from_bytes(record[:2], "little")


def _strings(record: memoryview, count: int) -> list[bytes]:
    """Return the first strings of a record, each with its length before it."""
    found = []
    for _ in range(count):
        size = int.from_bytes(record[:4], "little")
        found.append(bytes(record[4 : 4 + size]))
        record = record[4 + size :]
    return found


class FoxgloveScreen:
    """`hil.live.picture.Screen`; `typed` takes lines for the operator, None: parameters are neither shown nor changed."""

    def __init__(self, typed: Callable[[str], None] | None) -> None:
        self.typed = typed
        self.values: dict[str, float] = {}
        self.channels: dict[Channel, int] = {}  # and their numbers
        self.clients: set[_Client] = set()
        self._context = foxglove.Context()
        self._server = LocalServer(PORT, self, {"/": _Client})
        self.address = f"ws://{self._server.host}/?token={self._server.token}"

    def show_rows(self, rows: pa.Table, events: Iterable[Mapping[str, Any]]) -> None:
        file = io.BytesIO()
        plain = MCAPWriteOptions(compression=None, use_chunks=False)
        with foxglove.open_mcap(file, context=self._context, writer_options=plain):
            log_rows(rows, self._context)
            log_texts(events, self._context)
        self._server.call(partial(self._publish, [*read_mcap(file.getvalue())]))

    def know(self, values: Mapping[str, float]) -> None:
        if self.typed is not None:
            self._server.call(partial(self._learn, dict(values)))

    def close(self) -> None:
        self._server.close()

    # In the thread of the server

    def _publish(self, messages: list[tuple[Channel, int, bytes]]) -> None:
        for channel, time_ns, data in messages:
            if channel not in self.channels:
                self.channels[channel] = len(self.channels) + 1
                for client in self.clients:
                    client.advertise([channel])
            for client in self.clients:
                client.send_sample(self.channels[channel], time_ns, data)

    def _learn(self, values: dict[str, float]) -> None:
        self.values |= values
        for client in self.clients:
            if wanted := client.parameters & values.keys():
                client.tell(op="parameterValues", parameters=self.parameters(wanted))

    def parameters(self, names: Iterable[str]) -> list[dict[str, Any]]:
        """Return the known ones of these, as Foxglove has them."""
        known = self.values
        return [{"name": name, "value": known[name], "type": "float64"} for name in names if name in known]


class _Client(Guarded, WebSocketHandler):
    """One connection."""

    owner: FoxgloveScreen

    def check_origin(self, origin: str) -> bool:
        """Whether a page may connect: Foxglove's, one of this computer, or a program's that is not from the web."""
        site = urlsplit(origin)
        return site.hostname in SITES if site.scheme in ("http", "https") else site.scheme != ""

    def select_subprotocol(self, subprotocols: list[str]) -> str | None:
        return next((one for one in PROTOCOLS if one in subprotocols), None)

    def open(self, *_: str) -> None:
        self.parameters: set[str] = set()  # whose changes are to be sent
        self._subscriptions: dict[int, int] = {}  # channel: subscription
        self._waiting: deque[str | bytes] = deque(maxlen=WAITING_MAX)  # the oldest are dropped
        self._sending = False
        capabilities = ["parameters", "parametersSubscribe"] if self.owner.typed is not None else []
        self.tell(
            op="serverInfo", name="floaty", capabilities=capabilities, metadata={},
            sessionId=self.server.token[:8],
        )  # fmt: skip
        if self.owner.channels:
            self.advertise(self.owner.channels)
        self.owner.clients.add(self)

    def on_close(self) -> None:
        self.owner.clients.discard(self)

    def on_message(self, message: str | bytes) -> None:
        """Take a request; one that cannot be read is answered with an error."""
        try:
            self._take(json.loads(message))
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            self.tell(op="status", level=2, message=f"invalid message: {type(error).__name__}")

    def _take(self, request: dict[str, Any]) -> None:
        operation = request["op"]
        if operation == "subscribe":
            self._subscriptions |= {int(one["channelId"]): int(one["id"]) for one in request["subscriptions"]}
        elif operation == "unsubscribe":
            gone = request["subscriptionIds"]
            self._subscriptions = {of: own for of, own in self._subscriptions.items() if own not in gone}
        elif self.owner.typed is None:
            raise ValueError
        elif operation == "getParameters":
            self._answer(request, request["parameterNames"] or self.owner.values)
        elif operation == "setParameters":
            self._set(request)
        elif operation == "subscribeParameterUpdates":
            self.parameters |= set(request["parameterNames"])
        elif operation == "unsubscribeParameterUpdates":
            self.parameters -= set(request["parameterNames"])
        else:
            raise ValueError

    def _set(self, request: dict[str, Any]) -> None:
        """Pass changes of parameters to the operator; answer with the present values."""
        for wish in request["parameters"]:
            value = wish.get("value")
            if (
                type(value) in (int, float)
                and wish["name"] in self.owner.values
                and self.owner.typed is not None
            ):
                self.owner.typed(f"set {wish['name']} {float(value)!r}")
        self._answer(request, [wish["name"] for wish in request["parameters"]])

    def _answer(self, request: dict[str, Any], names: Iterable[str]) -> None:
        answered = {"id": request["id"]} if "id" in request else {}
        self.tell(op="parameterValues", parameters=self.owner.parameters(names), **answered)

    def advertise(self, channels: Iterable[Channel]) -> None:
        """Tell of channels."""
        numbers = self.owner.channels
        self.tell(op="advertise", channels=[channel.described(numbers[channel]) for channel in channels])

    def send_sample(self, number: int, time_ns: int, data: bytes) -> None:
        """Send a message of a channel, if the client has subscribed to it."""
        if number in self._subscriptions:
            self._queue(_DATA.pack(1, self._subscriptions[number], time_ns) + data)

    def tell(self, **message: Any) -> None:
        """Send a message as JSON."""
        self._queue(json.dumps(message))

    def _queue(self, message: str | bytes) -> None:
        self._waiting.append(message)
        if not self._sending:
            self._sending = True
            IOLoop.current().add_callback(self._send)

    async def _send(self) -> None:
        with suppress(WebSocketClosedError):
            while self._waiting:
                message = self._waiting.popleft()
                await self.write_message(message, binary=isinstance(message, bytes))
        self._sending = False
