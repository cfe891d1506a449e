"""MAVLink 2 frames, sans I/O: bytes that arrive become messages, messages become bytes, counters tell what was lost.

The dialect is pymavlink's `common`: its classes hold the fields, their layout and the CRC seeds. Framing is our own,
because pymavlink's parser drops whole supposed frames after a bad byte, lets one forged time stamp lock the true sender
out, and counts a reordered pair as 256 lost frames. Here

- bytes that are no frame are skipped one at a time, so that no good frame behind them is lost;
- half a frame waits for its rest until 100 ms of silence have passed (call `feed` with no data to let time pass); the
  bytes are then looked through again;
- a signature is checked before anything is learnt from the frame; with a key, nothing unsigned is accepted.

Frames of MAVLink 1 are read, never written. Whose message it is for is the reader's business.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from operator import attrgetter
from typing import Any

import pymavlink.dialects.v20.common as dialect
from pymavlink.dialects.v20.common import MAVLink_message as Message

from firmware_py.wire import WireError

HALF_FRAME_US = 100_000  # silence after which half a frame is given up; 280 bytes last 49 ms at 57600 baud
MINUTE = 6_000_000  # in units of the time stamp, 10 us
STAMP_MAX = (1 << 48) - 1
SIGNATURE_SIZE = 13  # link id, time stamp, 6 bytes of SHA-256
RESTART = 4  # so many late frames in sequence: their sender has begun anew

_MAGIC_2, _MAGIC_1 = 0xFD, 0xFE
_MAGIC = re.compile(b"[\xfd\xfe]")
_HEADER_2 = struct.Struct("<BBBBBBBHB")
_HEADER_1 = struct.Struct("<BBBBBB")
_CRC_SIZE = 2
_SIGNED = 1  # the only incompatibility flag that there is
_INCOMPLETE, _NO_FRAME = 0, 1  # bytes to go on by


@dataclass(slots=True)
class FrameCounters:
    """What a receiver has seen."""

    frames: int = 0  # delivered
    skipped_bytes: int = 0  # that belong to no frame
    bad_crc: int = 0  # supposed frames
    unknown: int = 0  # frames, in sequence, of messages that the dialect does not have
    unsigned: int = 0  # refused because a key is set
    bad_signature: int = 0
    replayed: int = 0  # rightly signed, but not newer than the last one of their stream
    lost: int = 0  # gaps in the sequence numbers
    late: int = 0  # behind the newest of their sender: reordered (and counted as lost before) or repeated


class Signing:
    """The key of a link and the time stamps of both directions; share one among all that use the key.

    `start` is the time stamp at `now_us` = 0, in 10 us since 2015-01-01: the last one known. With 0, a frame recorded
    before the last boot passes for a new one until the first true frame has been heard.
    """

    def __init__(self, key: bytes, link_id: int = 0, start: int = 0) -> None:
        if len(key) != 32:
            raise WireError(f"a signing key of {len(key)} bytes: 32 are needed")
        self.link_id = link_id
        self._key = key
        self._start = start
        self._newest = 0  # of all stamps, sent and heard
        self._streams: dict[tuple[int, int, int], int] = {}  # (system, component, link id): newest stamp

    def sign(self, now_us: int, frame: bytes) -> bytes:
        """The signature of `frame`, which ends with its CRC."""
        self._newest = min(STAMP_MAX, max(self._start + now_us // 10, self._newest + 1))
        head = bytes((self.link_id,)) + self._newest.to_bytes(6, "little")
        return head + self._digest(frame + head)

    def is_genuine(self, frame: bytes) -> bool:
        """Whether `frame`, complete with its signature, was made with the key."""
        return self._digest(frame[:-6]) == frame[-6:]

    def is_new(self, now_us: int, system: int, component: int, frame: bytes) -> bool:
        """Whether a genuine frame is newer than its stream's last; it is that last one from now on."""
        stream, stamp = (system, component, frame[-13]), int.from_bytes(frame[-12:-6], "little")
        last = self._streams.get(stream)
        if last is None:
            last = max(self._start + now_us // 10, self._newest) - MINUTE - 1
        if stamp <= last:
            return False
        self._streams[stream] = stamp
        self._newest = max(self._newest, stamp)
        return True

    def _digest(self, data: bytes) -> bytes:
        return sha256(self._key + data).digest()[:6]


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a kind of message lies in its payload."""

    create: Callable[..., Any]
    payload: struct.Struct
    crc_seed: bytes
    read: Callable[[Any], Any]  # the fields of a message in wire order
    arrays: tuple[
        int, ...
    ]  # lengths of the fields in wire order, 1 for a plain one; empty when all are plain
    order: tuple[int, ...]  # which of the wire's fields is the constructor's first, second, ...

    def pack(self, message: Message) -> bytes:
        """The payload, its trailing zeros included."""
        fields = self.read(message)
        if not self.arrays:
            return self.payload.pack(*fields)
        flat: list[Any] = []
        for field, length in zip(fields, self.arrays, strict=True):
            if length == 1:
                flat.append(field)
            else:
                flat.extend(field)
        return self.payload.pack(*flat)

    def unpack(self, payload: bytes) -> Message:
        """The message; what is missing of the payload is zero, and what is too long belongs to a newer dialect."""
        size = self.payload.size
        flat = self.payload.unpack(payload[:size].ljust(size, b"\0"))
        fields: tuple[Any, ...] | list[Any] = flat
        if self.arrays:
            fields, first = [], 0
            for length in self.arrays:
                fields.append(flat[first] if length == 1 else list(flat[first : first + length]))
                first += length
        return self.create(*[fields[i] for i in self.order])


@cache
def _layout(number: int) -> _Layout | None:
    """The layout of message `number`, None when the dialect does not have it."""
    kind = dialect.mavlink_map.get(number)
    if kind is None:
        return None
    texts = {name for name, type in zip(kind.fieldnames, kind.fieldtypes, strict=True) if type == "char"}
    names = [f"_{name}_raw" if name in texts else name for name in kind.ordered_fieldnames]
    get = attrgetter(*names)
    return _Layout(
        create=kind,
        payload=kind.unpacker,
        crc_seed=bytes((kind.crc_extra,)),
        read=get if len(names) > 1 else lambda message: (get(message),),
        arrays=tuple(kind.lengths) if max(kind.lengths) > 1 else (),
        order=tuple(kind.orders),
    )


def _crc(data: bytes) -> int:
    return int(dialect.x25crc(data).crc)


class FrameSender:
    """Makes the frames of one sender on one link, and counts them."""

    def __init__(self, system: int, component: int, signing: Signing | None = None) -> None:
        self._system = system
        self._component = component
        self._signing = signing
        self._sequence = 0

    def encode(self, now_us: int, message: Message) -> bytes:
        """The frame of `message`, which is not changed; `WireError` when a field does not fit its type."""
        number = message.get_msgId()
        layout = _layout(number)
        if layout is None:
            raise WireError(f"message {number}: not in the dialect")
        try:
            full = layout.pack(message)
        except (struct.error, OverflowError, TypeError, ValueError) as error:
            raise WireError(f"{message.get_type()}: {error}") from error
        payload = full.rstrip(b"\0") or full[:1]
        flags = _SIGNED if self._signing else 0
        body = (
            _HEADER_2.pack(
                _MAGIC_2, len(payload), flags, 0, self._sequence, self._system, self._component,
                number & 0xFFFF, number >> 16,
            )
            + payload
        )  # fmt: skip
        self._sequence = (self._sequence + 1) & 0xFF
        frame = body + _crc(body[1:] + layout.crc_seed).to_bytes(2, "little")
        return frame + self._signing.sign(now_us, frame) if self._signing else frame


class _Sequence:
    """Sequence numbers of one sender, modulo 256: half of them lie ahead, the others behind."""

    __slots__ = ("after_late", "late_run", "newest")

    def __init__(self, number: int) -> None:
        self.newest = number
        self.late_run = 0
        self.after_late = 0

    def note(self, number: int, counters: FrameCounters) -> None:
        step = (number - self.newest) & 0xFF
        if 1 <= step <= 128:
            counters.lost += step - 1
            self.newest = number
            self.late_run = 0
            return
        counters.late += 1
        self.late_run = self.late_run + 1 if number == self.after_late else 1
        self.after_late = (number + 1) & 0xFF
        if self.late_run == RESTART:
            self.newest = number


class FrameReceiver:
    """Finds the frames in a stream of bytes; never raises, whatever the bytes."""

    def __init__(self, signing: Signing | None = None) -> None:
        self.counters = FrameCounters()
        self._signing = signing
        self._held = b""  # half a frame
        self._last_us = 0  # when bytes came last
        self._senders: dict[tuple[int, int], _Sequence] = {}

    def feed(self, now_us: int, data: bytes) -> list[Message]:
        """The messages that `data` completes, in order; empty data lets time pass."""
        silent = now_us - self._last_us > HALF_FRAME_US
        stale = len(self._held) if silent else 0  # what starts before this byte waits no longer
        buffer = self._held + data
        if data:
            self._last_us = now_us
        messages: list[Message] = []
        position = 0
        while found := _MAGIC.search(buffer, position):
            start = found.start()
            self.counters.skipped_bytes += start - position
            position = start
            size = self._take(now_us, buffer, start, messages)
            if size == _INCOMPLETE:
                if start >= stale:
                    break
                size = _NO_FRAME
            if size == _NO_FRAME:
                self.counters.skipped_bytes += 1
            position += size
        else:
            self.counters.skipped_bytes += len(buffer) - position
            position = len(buffer)
        self._held = buffer[position:]
        return messages

    def _take(self, now_us: int, buffer: bytes, start: int, messages: list[Message]) -> int:
        """Look at the supposed frame at `start`; return how many bytes it takes, or `_INCOMPLETE` or `_NO_FRAME`."""
        is_2 = buffer[start] == _MAGIC_2
        layout_2 = _HEADER_2 if is_2 else _HEADER_1
        if len(buffer) - start < layout_2.size:
            return _INCOMPLETE
        flags = compatible = high = 0
        if is_2:
            _, length, flags, compatible, sequence, system, component, low, high = _HEADER_2.unpack_from(
                buffer, start
            )
        else:
            _, length, sequence, system, component, low = _HEADER_1.unpack_from(buffer, start)
        if flags & ~_SIGNED or not system:
            return _NO_FRAME
        layout = _layout(low | high << 16)
        if layout is None:
            self._note_unknown(sequence, system, component)
            return _NO_FRAME
        if not is_2 and length > layout.payload.size:
            return _NO_FRAME

        first = start + layout_2.size
        signed_at = first + length + _CRC_SIZE
        end = signed_at + SIGNATURE_SIZE if flags else signed_at
        if len(buffer) < end:
            return _INCOMPLETE
        crc = int.from_bytes(buffer[signed_at - _CRC_SIZE : signed_at], "little")
        if _crc(buffer[start + 1 : signed_at - _CRC_SIZE] + layout.crc_seed) != crc:
            self.counters.bad_crc += 1
            return _NO_FRAME

        frame = buffer[start:end]
        if self._signing and not self._is_admitted(self._signing, now_us, flags, system, component, frame):
            return signed_at - start  # the signature may be cut off: what stands in its place is looked at
        message = layout.unpack(buffer[first : first + length])
        header = message._header
        header.mlen, header.seq, header.srcSystem, header.srcComponent = length, sequence, system, component
        header.incompat_flags, header.compat_flags = flags, compatible
        message._msgbuf, message._crc = frame, crc
        self._note(sequence, system, component)
        messages.append(message)
        return end - start

    def _is_admitted(
        self, signing: Signing, now_us: int, signed: int, system: int, component: int, frame: bytes
    ) -> bool:
        if not signed:
            self.counters.unsigned += 1
        elif not signing.is_genuine(frame):
            self.counters.bad_signature += 1
        elif not signing.is_new(now_us, system, component, frame):
            self.counters.replayed += 1
        else:
            return True
        return False

    def _note(self, sequence: int, system: int, component: int) -> None:
        """Count the frame, and what is missing before it."""
        self.counters.frames += 1
        sender = self._senders.get((system, component))
        if sender is None:
            self._senders[system, component] = _Sequence(sequence)
        else:
            sender.note(sequence, self.counters)

    def _note_unknown(self, sequence: int, system: int, component: int) -> None:
        """Believe in a frame whose CRC nobody can check when it is the next one of a known sender."""
        sender = self._senders.get((system, component))
        if self._signing is None and sender is not None and sequence == (sender.newest + 1) & 0xFF:
            self.counters.unknown += 1
            sender.newest = sequence
