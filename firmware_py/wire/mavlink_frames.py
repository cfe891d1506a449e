"""MAVLink 2 frames, sans I/O: bytes that arrive become messages, messages become bytes, counters report what was lost.

pymavlink makes frames and decodes them. Finding them and judging signatures is our own, because pymavlink's parser drops
whole supposed frames after a bad byte, lets one forged time stamp lock the true sender out, and counts a reordered pair as
256 lost frames. Here

- bytes that are no frame are skipped one at a time, so that no good frame after them is lost;
- half a frame waits for its rest until 100 ms of silence have passed (call `feed` with no data to let time pass); then its
  bytes are searched for other frames;
- a signature is checked before the frame is used; with a key, unsigned frames are refused. It is the
  sender's link id, a time stamp that only increases, and six bytes of SHA-256 over key, frame, link id and stamp.

Frames of MAVLink 1 are read, never written. The reader checks the addressee of a message.
"""

import re
import struct
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, NamedTuple

import pymavlink.dialects.v20.development as dialect

from firmware_py.wire import WireError
from firmware_py.wire.mavlink_dialect import KINDS, Message, address

KEY_SIZE = 32
SIGNATURE_SIZE = 13  # link id, 6 bytes of time stamp, 6 bytes of digest
STAMPS_PER_MINUTE = 6_000_000  # the unit is 10 us

_STAMP_MAX = (1 << 48) - 1
_DIGEST_SIZE = 6


class Signing:
    """The key and the time stamps of both directions; one object for all senders and receivers that use the key.

    `start` is the time stamp at `now_us` = 0, in 10 us since 2015-01-01: the present if there is a calendar, else the
    last one known. With 0 and no frame received yet, a recorded frame passes for a new one. Raises `WireError` for a key
    that has not 32 bytes.
    """

    def __init__(self, key: bytes, link_id: int = 0, start: int = 0) -> None:
        if len(key) != KEY_SIZE:
            raise WireError(f"a signing key of {len(key)} bytes: {KEY_SIZE} are needed")
        self._key = key
        self._link_id = link_id
        self._start = start
        self._newest = 0  # of all stamps, sent and received
        self._streams: dict[tuple[int, int, int], int] = {}  # (system, component, link id): newest stamp

    def prepare(self, now_us: int, state: Any) -> None:
        """Set pymavlink's state of signing for the next frame."""
        self._newest = min(_STAMP_MAX, max(self._start + now_us // 10, self._newest + 1))
        state.secret_key, state.link_id, state.timestamp = self._key, self._link_id, self._newest
        state.sign_outgoing = True

    def is_genuine(self, frame: bytes) -> bool:
        """Return whether `frame`, its signature included, was made with the key."""
        digest = sha256(self._key + frame[:-_DIGEST_SIZE]).digest()
        return digest[:_DIGEST_SIZE] == frame[-_DIGEST_SIZE:]

    def is_new(self, now_us: int, system: int, component: int, frame: bytes) -> bool:
        """Return whether a genuine frame is newer than the last of its stream, and note it as the last.

        The first frame of a stream may be up to a minute behind the newest stamp of all.
        """
        stream, stamp = (system, component, frame[-13]), int.from_bytes(frame[-12:-6], "little")
        last = self._streams.get(stream)
        if last is None:
            last = max(self._start + now_us // 10, self._newest) - STAMPS_PER_MINUTE - 1
        if stamp <= last:
            return False
        self._streams[stream] = stamp
        self._newest = max(self._newest, stamp)
        return True


HALF_FRAME_US = 100_000  # silence after which half a frame is dropped; 280 bytes last 49 ms at 57600 baud
RESTART = 4  # so many late frames in sequence: their sender has restarted

_START_2 = b"\xfd"
_START = re.compile(b"[\xfd\xfe]")  # of version 2 or 1
_HEAD_2 = struct.Struct("<xBBBBBBHB")  # without the magic byte
_HEAD_1 = struct.Struct("<xBBBBB")
_CRC_SIZE = 2
_SIGNED = 1  # the only incompatibility flag that there is
# Results of looking at a supposed frame, beside its length.
_INCOMPLETE, _NO_FRAME = 0, 1


@dataclass(slots=True)
class FrameCounters:
    """The counters of a receiver."""

    frames: int = 0  # delivered
    skipped_bytes: int = 0  # that belong to no frame
    bad_crc: int = 0  # supposed frames
    unknown: int = 0  # next in sequence, but the dialect does not have the message (or its number is damaged)
    unsigned: int = 0  # refused because a key is set
    bad_signature: int = 0
    replayed: int = 0  # correctly signed, but not newer than the last one of their stream
    lost: int = 0  # gaps in the sequence numbers
    late: int = 0  # behind the newest of their sender: reordered (and counted as lost before) or repeated

    @property
    def bad(self) -> int:
        """Frames that were damaged or not correctly signed."""
        return self.bad_crc + self.bad_signature + self.unsigned + self.replayed


class FrameSender:
    """Makes the frames of one sender on one link, and counts them."""

    def __init__(self, system: int, component: int, signing: Signing | None = None) -> None:
        self._codec = dialect.MAVLink(None, system, component)
        self._signing = signing

    def encode(self, now_us: int, message: Message) -> bytes:
        """Return the frame of `message`; `WireError` when a field does not fit its type."""
        if self._signing is not None:
            self._signing.prepare(now_us, self._codec.signing)
        try:
            frame: bytes = message.pack(self._codec)
        except (struct.error, OverflowError, TypeError, ValueError) as error:
            raise WireError(f"{message.get_type()}: {error}") from error
        self._codec.seq = (self._codec.seq + 1) & 0xFF
        return frame


class _Sequence:
    """Sequence numbers of one sender, modulo 256: half of them lie ahead, the others behind."""

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


class _Head(NamedTuple):
    """The first bytes of a frame."""

    length: int  # of the payload
    flags: int  # that must be understood
    sequence: int
    system: int
    component: int
    number: int  # of the message


def _read_head(buffer: bytes, start: int) -> _Head:
    if buffer[start] == _START_2[0]:
        length, flags, _, sequence, system, component, low, high = _HEAD_2.unpack_from(buffer, start)
        return _Head(length, flags, sequence, system, component, low | high << 16)
    length, sequence, system, component, number = _HEAD_1.unpack_from(buffer, start)
    return _Head(length, 0, sequence, system, component, number)


class FrameReceiver:
    """Finds the frames in a stream of bytes; never raises, whatever the bytes."""

    def __init__(self, signing: Signing | None = None) -> None:
        self.counters = FrameCounters()
        self._codec = dialect.MAVLink(None)
        self._signing = signing
        self._held = b""  # half a frame
        self._last_us = 0  # when bytes were last received
        self._senders: dict[tuple[int, int], _Sequence] = {}

    def feed(self, now_us: int, data: bytes) -> list[Message]:
        """Return the messages that `data` completes, in order; empty data lets time pass."""
        silent = now_us - self._last_us > HALF_FRAME_US
        stale = len(self._held) if silent else 0  # half frames that start before this byte are dropped
        buffer = self._held + data
        if data:
            self._last_us = now_us
        messages: list[Message] = []
        position = 0
        while found := _START.search(buffer, position):
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
        head_size = _HEAD_2.size if buffer[start] == _START_2[0] else _HEAD_1.size
        if len(buffer) - start < head_size:
            return _INCOMPLETE
        head = _read_head(buffer, start)
        if head.flags & ~_SIGNED or not head.system:
            return _NO_FRAME
        kind = KINDS.get(head.number)
        if kind is None:
            self._note_unknown(head)
            return _NO_FRAME
        if head_size == _HEAD_1.size and head.length > kind.unpacker.size:
            return _NO_FRAME  # version 1 has no extensions
        end = start + head_size + head.length + _CRC_SIZE + (SIGNATURE_SIZE if head.flags else 0)
        if len(buffer) < end:
            return _INCOMPLETE
        frame = buffer[start:end]
        try:
            message = self._codec.decode(bytearray(frame))
        except dialect.MAVError:
            self.counters.bad_crc += 1
            return _NO_FRAME
        if self._signing is not None:
            refused = self._refuse(self._signing, now_us, head, frame)
            if refused:
                return refused
        self._note(head)
        address(message, frame[head_size : head_size + head.length])
        messages.append(message)
        return end - start

    def _refuse(self, signing: Signing, now_us: int, head: _Head, frame: bytes) -> int:
        """Return how many bytes to skip of a frame that is not signed, not genuine or not new; 0 to accept it."""
        if not head.flags:
            self.counters.unsigned += 1
            return len(frame)
        if not signing.is_genuine(frame):
            self.counters.bad_signature += 1
            # The frame may be cut short, so the bytes in the signature's place are searched for frames.
            return len(frame) - SIGNATURE_SIZE
        if not signing.is_new(now_us, head.system, head.component, frame):
            self.counters.replayed += 1
            return len(frame)
        return 0

    def _note(self, head: _Head) -> None:
        """Count the frame, and what is missing before it."""
        self.counters.frames += 1
        sender = self._senders.get((head.system, head.component))
        if sender is None:
            self._senders[head.system, head.component] = _Sequence(head.sequence)
        else:
            sender.note(head.sequence, self.counters)

    def _note_unknown(self, head: _Head) -> None:
        """Accept a frame whose CRC cannot be checked when it is the next one of a known sender."""
        sender = self._senders.get((head.system, head.component))
        if self._signing is None and sender is not None and head.sequence == (sender.newest + 1) & 0xFF:
            self.counters.unknown += 1
            sender.newest = head.sequence
