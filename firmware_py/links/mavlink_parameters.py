"""The parameter protocol: list, read by index or by name, set. The list has only writable parameters.

Every value is sent as REAL32, the one encoding that all ground stations agree on. Whether a request to set succeeds or
not, the answer carries the value in force. A failure is answered with PARAM_ERROR each time, and with a text for
the operator once. The list is sent one parameter at a time, each after the line has taken the previous one; a
request for the list while it is being sent starts it again.
"""

from collections.abc import Sequence
from math import isfinite
from zlib import crc32

from firmware_py.links.mavlink_stack import MavlinkStack, Task
from firmware_py.links.parameters import Parameter
from firmware_py.wire import WireError
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import Message
from firmware_py.wire.parameters import OK

HASH_NAME = "_HASH_CHECK"
HASH_BITS = 24  # which a REAL32 carries exactly
NO_INDEX = 0xFFFF
NO_NUMBER = -1  # the same in messages where it has a sign
DOES_NOT_EXIST, OUT_OF_RANGE, TYPE_UNSUPPORTED, TYPE_MISMATCH = 1, 2, 6, 7  # MAV_PARAM_ERROR
REAL32 = 9
# MAV_PARAM_TYPE by number; a message has no room for a value of 8 bytes.
TYPES = "none", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "UINT64", "INT64", "REAL32", "REAL64"
FOUR_BYTES = range(1, 7)


class MavlinkParameters:
    """Serves the parameters that have `write`, in the order of the table."""

    def __init__(self, stack: MavlinkStack, parameters: Sequence[Parameter]) -> None:
        self._stack = stack
        self._parameters = [parameter for parameter in parameters if parameter.write is not None]
        self._names = [services.mavlink_name(parameter.name) for parameter in self._parameters]
        self._numbers = {name: number for number, name in enumerate(self._names)}
        self._next = len(self._parameters)  # of the list that is being sent
        self._listing = stack.kernel.create_binary_semaphore("mavList")
        stack.handle("PARAM_REQUEST_LIST", self._start_list)
        stack.handle("PARAM_REQUEST_READ", self._read)
        stack.handle("PARAM_SET", self._set)
        stack.kernel.create_task("MAV-PARAM", 1, self._list_task)

    def _start_list(self, message: Message) -> None:
        self._next = 0
        self._listing.give_nowait()

    def _list_task(self) -> Task:
        stack, end = self._stack, len(self._parameters)
        while True:
            if self._next >= end:
                yield from self._listing.take()
            else:
                self._next += 1
                yield from stack.deliver(self._value(self._next - 1))

    def _read(self, message: Message) -> None:
        number = message.param_index
        if number < 0:
            if message.param_id == HASH_NAME:
                self._stack.reply(self._hash())
                return
            number = self._find(message)
        elif number >= len(self._parameters):
            self._stack.reply(services.parameter_error(message, message.param_id, number, DOES_NOT_EXIST))
            raise WireError(f"parameter {number}: there are {len(self._parameters)}")
        self._stack.reply(self._value(number))

    def _set(self, message: Message) -> None:
        name, value = message.param_id, message.param_value
        number = self._find(message)
        parameter = self._parameters[number]
        kind = message.param_type
        whole = parameter.scalar.is_float or (isfinite(value) and value == int(value))
        if kind != REAL32:
            error = TYPE_MISMATCH if kind in FOUR_BYTES else TYPE_UNSUPPORTED
            why = f"type {TYPES[kind] if kind < len(TYPES) else kind} refused, REAL32 is needed"
        elif not whole or parameter.set(value) != OK:
            error, why = OUT_OF_RANGE, f"{value:g} refused, {parameter.minimum:g}..{parameter.maximum:g}"
        else:
            error, why = None, ""
        self._stack.reply(self._value(number))
        if error is not None:
            self._stack.reply(services.parameter_error(message, name, NO_NUMBER, error))
            raise WireError(f"{name}: {why}")

    def _find(self, request: Message) -> int:
        name = request.param_id
        number = self._numbers.get(name)
        if number is None:
            self._stack.reply(services.parameter_error(request, name, NO_NUMBER, DOES_NOT_EXIST))
            raise WireError(f"no parameter {name}")
        return number

    def _value(self, number: int) -> Message:
        value = float(self._parameters[number].read())
        return services.parameter(self._names[number], value, number, len(self._parameters))

    def _hash(self) -> Message:
        """Return a number that changes with the names and with any value, by which clients recognise their cached copy."""
        content = b"".join(
            name.encode() + parameter.value()
            for name, parameter in zip(self._names, self._parameters, strict=True)
        )
        value = crc32(content) >> (32 - HASH_BITS)
        return services.parameter(HASH_NAME, float(value), NO_INDEX, len(self._parameters))
