"""MAVLink 2 signatures: a shared key, and time stamps that only go up.

A frame's signature is the sender's link id, a time stamp and six bytes of SHA-256 over key, frame, link id and stamp.
Nothing in a frame is used before its signature is found genuine.
"""

from hashlib import sha256

from firmware_py.wire import WireError

KEY_SIZE = 32
SIGNATURE_SIZE = 13  # link id, 6 bytes of time stamp, 6 bytes of digest
STAMPS_PER_MINUTE = 6_000_000  # the unit is 10 us

_STAMP_MAX = (1 << 48) - 1
_DIGEST_SIZE = 6


class Signing:
    """The key and the time stamps of both directions; one object for all senders and receivers that use the key.

    `start` is the time stamp at `now_us` = 0, in 10 us since 2015-01-01: the present if there is a calendar, else the
    last one known. With 0 and no frame heard yet, a recorded frame passes for a new one. Raises `WireError` for a key
    that has not 32 bytes.
    """

    def __init__(self, key: bytes, link_id: int = 0, start: int = 0) -> None:
        if len(key) != KEY_SIZE:
            raise WireError(f"a signing key of {len(key)} bytes: {KEY_SIZE} are needed")
        self._key = key
        self._link_id = bytes((link_id,))
        self._start = start
        self._newest = 0  # of all stamps, sent and heard
        self._streams: dict[tuple[int, int, int], int] = {}  # (system, component, link id): newest stamp

    def sign(self, now_us: int, frame: bytes) -> bytes:
        """The signature to send behind `frame`, which ends with its CRC."""
        self._newest = min(_STAMP_MAX, max(self._start + now_us // 10, self._newest + 1))
        head = self._link_id + self._newest.to_bytes(6, "little")
        return head + self._digest(frame + head)

    def is_genuine(self, frame: bytes) -> bool:
        """Whether `frame`, its signature included, was made with the key."""
        return self._digest(frame[:-_DIGEST_SIZE]) == frame[-_DIGEST_SIZE:]

    def is_new(self, now_us: int, system: int, component: int, frame: bytes) -> bool:
        """Whether a genuine frame is newer than the last of its stream, and is its last from now on.

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

    def _digest(self, data: bytes) -> bytes:
        return sha256(self._key + data).digest()[:_DIGEST_SIZE]
