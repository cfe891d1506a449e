"""MAVLink frames: pymavlink's bytes, any chunks, damaged streams, signatures, loss counters, fuzzing."""

from collections.abc import Iterable, Sequence
from hashlib import sha256
from typing import Any

import numpy as np
import pymavlink.dialects.v20.development as dialect
import pytest

from firmware_py.wire import WireError, mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import Timesync
from firmware_py.wire.mavlink_frames import HALF_FRAME_US, FrameReceiver, FrameSender, Signing

KEY = sha256(b"floaty").digest()
STAMP = 370_000_000_000_00  # 10 us since 2015: 2026


def peer(key: bytes | None = None, system: int = 7, component: int = 9, link_id: int = 0) -> Any:
    """pymavlink's codec: the other end, and the source of golden bytes."""
    codec = dialect.MAVLink(None, system, component)
    if key is not None:
        codec.signing.secret_key = key
        codec.signing.sign_outgoing = True
        codec.signing.timestamp = STAMP
        codec.signing.link_id = link_id
    return codec


def golden(codec: Any, messages: Iterable[Any]) -> list[bytes]:
    frames = []
    for message in messages:
        frames.append(message.pack(codec))
        codec.seq = (codec.seq + 1) % 256
    return frames


def rotation(rng: np.random.Generator) -> tuple[float, ...]:
    q = rng.normal(size=4)
    return tuple(q / np.linalg.norm(q))


def conversation(rng: np.random.Generator, count: int) -> list[Any]:
    """Messages of a flight: poses mostly."""
    others = (
        lambda: mavlink.target(int(rng.integers(1 << 31)), tuple(rng.normal(size=3)), rng.normal()),
        services.station_heartbeat,
        lambda: services.timesync(0, int(rng.integers(1 << 62))),
        lambda: services.parameter("EXT_X_P", rng.normal(), int(rng.integers(60)), 60),
    )
    return [
        others[i // 4 % 4]()
        if i % 4 == 3
        else mavlink.pose(int(rng.integers(1 << 40)), tuple(rng.normal(size=3)), rotation(rng))
        for i in range(count)
    ]


def received(messages: Sequence[Any]) -> list[bytes]:
    return [bytes(message.get_msgbuf()) for message in messages]


def feed_all(receiver: FrameReceiver, stream: bytes, chunk: int, now_us: int = 0) -> list[bytes]:
    """Feed in chunks, then let silence pass."""
    messages = []
    for start in range(0, len(stream), chunk):
        messages += receiver.feed(now_us, stream[start : start + chunk])
    return received(messages + receiver.feed(now_us + HALF_FRAME_US + 1, b""))


@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_frames_count_themselves_and_carry_pymavlinks_signature(key: bytes | None) -> None:
    # More than 256, two in each unit of the time stamp.
    messages = conversation(np.random.default_rng(1), 300)
    sender = FrameSender(7, 9, Signing(key, link_id=3, start=STAMP) if key else None)
    mine = [sender.encode(5 * i, message) for i, message in enumerate(messages)]
    assert mine == golden(peer(key, link_id=3), messages)


@pytest.mark.long
@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_chunks_of_any_size_give_the_same_messages(key: bytes | None) -> None:
    frames = golden(peer(key), conversation(np.random.default_rng(2), 10))
    stream = b"".join(frames)
    for size in range(1, len(stream) + 1):
        receiver = FrameReceiver(Signing(key, start=STAMP) if key else None)
        assert feed_all(receiver, stream, size) == frames, f"chunks of {size}"
        assert receiver.counters.skipped_bytes == receiver.counters.lost == 0


def test_a_payload_of_zeros_keeps_its_first_byte() -> None:
    message = dialect.MAVLink_timesync_message(0, 0)
    assert FrameSender(7, 9).encode(0, message) == golden(peer(), [message])[0]


def test_version_1_is_read() -> None:
    frames = [
        message.pack(peer(), force_mavlink1=True)
        for message in (services.station_heartbeat(), services.timesync(1, 2))
    ]
    assert feed_all(FrameReceiver(), b"".join(frames), 7) == frames


def test_a_field_that_does_not_fit_is_refused_and_takes_no_sequence_number() -> None:
    sender = FrameSender(7, 9)
    with pytest.raises(WireError, match="PARAM_VALUE"):
        sender.encode(0, dialect.MAVLink_param_value_message(b"X", 1e300, 9, 1, 0))
    assert sender.encode(0, services.timesync(0, 1)) == golden(peer(), [services.timesync(0, 1)])[0]


# Damage


@pytest.mark.long
def test_garbage_before_frames_loses_no_frame() -> None:
    rng = np.random.default_rng(3)
    frames = golden(peer(), conversation(rng, 3000))
    stream = b""
    for i, frame in enumerate(frames):
        stream += (rng.bytes(int(rng.integers(1, 41))) if i % 10 == 0 else b"") + frame
    receiver, theirs = FrameReceiver(), peer()
    assert feed_all(receiver, stream, 64) == frames
    assert receiver.counters.lost == 0
    assert receiver.counters.skipped_bytes == len(stream) - len(b"".join(frames))
    theirs.robust_parsing = True
    good = [m for m in theirs.parse_buffer(stream) if m.get_type() != "BAD_DATA"]
    assert len(good) < len(frames) - 100  # the stream is a hard one


@pytest.mark.long
@pytest.mark.parametrize("stray", [b"\xfd", b"\xfe", b"\xfd\xfd\xfd", b"\xfe\xfd", b"\xfd\xfe"])
def test_stray_start_byte_does_not_delay_the_frame_behind_it(stray: bytes) -> None:
    receiver = FrameReceiver()
    for frame in golden(peer(), conversation(np.random.default_rng(4), 300)):
        assert received(receiver.feed(0, stray + frame)) == [frame]


def test_a_frame_cut_anywhere_costs_only_itself() -> None:
    frames = golden(peer(), conversation(np.random.default_rng(5), 8))
    for cut in range(len(frames[3])):
        receiver = FrameReceiver()
        stream = b"".join((*frames[:3], frames[3][:cut], *frames[4:]))
        assert feed_all(receiver, stream, 50) == frames[:3] + frames[4:], f"cut at {cut}"
        assert receiver.counters.lost + receiver.counters.unknown == 1  # unknown: cut in the message number


@pytest.mark.long
@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_any_flipped_bit_costs_only_its_frame(key: bytes | None) -> None:
    frames = golden(peer(key), conversation(np.random.default_rng(6), 5))
    for bit in range(8 * len(frames[2])):
        broken = bytearray(frames[2])
        broken[bit // 8] ^= 1 << bit % 8
        receiver = FrameReceiver(Signing(key, start=STAMP) if key else None)
        stream = b"".join((*frames[:2], broken, *frames[3:]))
        assert feed_all(receiver, stream, 1000) == frames[:2] + frames[3:], f"bit {bit}"
        counters = receiver.counters
        assert (counters.bad_crc, counters.bad_signature) != (0, 0) or counters.skipped_bytes >= len(broken)


def test_half_a_frame_is_given_up_after_silence_and_not_before() -> None:
    receiver = FrameReceiver()
    half = b"\xfd\xff" + golden(peer(), [services.timesync(0, 1)])[0][2:10]  # promises 255 bytes
    frame = golden(peer(), [services.station_heartbeat()])[0]
    assert receiver.feed(1000, half + frame) == []
    assert receiver.feed(1000 + HALF_FRAME_US, b"") == []
    assert received(receiver.feed(1001 + HALF_FRAME_US, b"")) == [frame]


def test_the_rest_of_a_frame_is_taken_even_after_silence() -> None:
    receiver = FrameReceiver()
    frame = golden(peer(), [services.station_heartbeat()])[0]
    receiver.feed(0, frame[:12])
    assert received(receiver.feed(10 * HALF_FRAME_US, frame[12:])) == [frame]


# Signatures


def signed_receiver() -> FrameReceiver:
    return FrameReceiver(Signing(KEY, start=STAMP))


def test_with_a_key_nothing_unsigned_is_accepted() -> None:
    receiver = signed_receiver()
    messages = conversation(np.random.default_rng(8), 20)
    assert feed_all(receiver, b"".join(golden(peer(), messages)), 30) == []
    assert feed_all(receiver, services.timesync(0, 1).pack(peer(), force_mavlink1=True), 30) == []
    assert (receiver.counters.unsigned, receiver.counters.frames) == (21, 0)


def test_a_wrong_key_is_refused() -> None:
    receiver = signed_receiver()
    frames = golden(peer(sha256(b"other").digest()), conversation(np.random.default_rng(9), 20))
    assert feed_all(receiver, b"".join(frames), 30) == []
    assert receiver.counters.bad_signature == 20


def test_without_a_key_signed_frames_are_read() -> None:
    frames = golden(peer(KEY), conversation(np.random.default_rng(10), 20))
    assert feed_all(FrameReceiver(), b"".join(frames), 30) == frames


def test_replayed_frames_are_refused() -> None:
    receiver = signed_receiver()
    frames = golden(peer(KEY), conversation(np.random.default_rng(11), 20))
    assert feed_all(receiver, b"".join(frames), 30) == frames
    assert feed_all(receiver, b"".join(frames), 30) == []
    assert (receiver.counters.replayed, receiver.counters.skipped_bytes) == (20, 0)


def test_a_forged_time_stamp_changes_nothing() -> None:
    receiver = signed_receiver()
    first, true = golden(peer(KEY), [services.timesync(0, 1), services.timesync(0, 2)])
    receiver.feed(0, first)
    forged = bytearray(first)
    forged[-12:-6] = b"\xff" * 6
    assert receiver.feed(0, bytes(forged)) == []
    other = bytearray(golden(peer(KEY, system=8), [services.timesync(0, 1)])[0])
    other[-12:-6] = b"\xff" * 6
    assert receiver.feed(0, bytes(other)) == []
    assert received(receiver.feed(0, true)) == [true]
    assert receiver.counters.bad_signature == 2


@pytest.mark.parametrize(("behind", "count"), [(6_000_000, 1), (6_000_001, 0)])
def test_a_new_stream_may_be_a_minute_behind(behind: int, count: int) -> None:
    receiver = signed_receiver()
    codec = peer(KEY)
    codec.signing.timestamp = STAMP + 500_000 - behind
    frame = golden(codec, [services.timesync(0, 1)])[0]
    assert len(receiver.feed(5_000_000, frame)) == count
    assert receiver.counters.replayed == 1 - count


def test_a_board_without_a_calendar_learns_the_time_from_a_genuine_frame() -> None:
    signing = Signing(KEY)
    receiver, sender = FrameReceiver(signing), FrameSender(1, 1, signing)
    theirs = peer(KEY)
    with pytest.raises(dialect.MAVError, match="signature"):
        theirs.decode(bytearray(sender.encode(0, services.timesync(0, 1))))
    newest, behind = peer(KEY), peer(KEY, system=8)  # whose clock is almost a minute slow
    behind.signing.timestamp -= 5_900_000
    for codec in (newest, behind):
        assert receiver.feed(0, golden(codec, [services.timesync(0, 1)])[0])
    frame = sender.encode(0, services.timesync(0, 2))
    assert theirs.decode(bytearray(frame)).ts1 == 2
    assert int.from_bytes(frame[-12:-6], "little") >= newest.signing.timestamp


def test_a_cut_signature_costs_only_its_frame() -> None:
    frames = golden(peer(KEY), conversation(np.random.default_rng(12), 5))
    for cut in range(1, 14):
        stream = b"".join((*frames[:2], frames[2][:-cut], *frames[3:]))
        assert feed_all(signed_receiver(), stream, 1000) == frames[:2] + frames[3:], f"{cut} bytes cut"


@pytest.mark.parametrize("size", [0, 31, 33])
def test_a_key_has_32_bytes(size: int) -> None:
    with pytest.raises(WireError, match=f"{size} bytes"):
        Signing(bytes(size))


# Loss counters


def count(order: Iterable[int]) -> tuple[int, int, int]:
    """Frames, lost and late after frames with these numbers, modulo 256."""
    receiver, codec = FrameReceiver(), peer()
    for number in order:
        codec.seq = number % 256
        receiver.feed(0, services.timesync(0, 1).pack(codec))
    return receiver.counters.frames, receiver.counters.lost, receiver.counters.late


@pytest.mark.long
@pytest.mark.parametrize(
    ("order", "counted"),
    [
        (range(1000), (1000, 0, 0)),
        ([number for number in range(1000) if number % 100 not in (55, 56, 57)], (970, 30, 0)),
        ((0, 2, 1, 3, 4), (5, 1, 1)),
        ((0, 1, 1, 2, 3), (5, 0, 1)),
        ((0, 128), (2, 127, 0)),
        ((0, 129), (2, 0, 1)),
        ((100, 10, 11, 12, 101, 13, 102), (7, 0, 4)),
        ((*range(100), *range(200)), (300, 0, 4)),
    ],
    ids=[
        "over the wrap",
        "gaps",
        "a reordered pair",
        "a repeated frame",
        "half ahead",
        "more is behind",
        "late ones apart",
        "a sender that begins anew",
    ],
)
def test_lost_and_late_frames_are_counted(order: Iterable[int], counted: tuple[int, int, int]) -> None:
    frames, lost, late = count(order)
    assert (frames, lost) == counted[:2]
    assert late <= counted[2] if frames == 300 else late == counted[2]


def test_senders_are_counted_apart() -> None:
    receiver, codecs = FrameReceiver(), [peer(system=system) for system in (1, 2)]
    codecs[1].seq = 77
    for _ in range(300):
        for codec in codecs:
            receiver.feed(0, golden(codec, [services.timesync(0, 1)])[0])
    assert (receiver.counters.frames, receiver.counters.lost, receiver.counters.late) == (600, 0, 0)


def test_unknown_messages_are_counted_and_not_lost() -> None:
    receiver, codec = FrameReceiver(), peer()
    for i in range(50):
        if i % 5 == 3:
            stranger = dialect.MAVLink_message(60_000, "STRANGER")
            frame = stranger._pack(codec, 99, np.random.default_rng(i).bytes(40))
            codec.seq += 1
        else:
            frame = golden(codec, [services.timesync(0, 1)])[0]
        receiver.feed(0, frame)
    assert (receiver.counters.frames, receiver.counters.unknown, receiver.counters.lost) == (40, 10, 0)


@pytest.mark.parametrize("addressee", [(3, 7), (7, 3), (3, 0), (0, 0)])
def test_a_time_request_has_its_addressee(addressee: tuple[int, int]) -> None:
    frame = FrameSender(1, 1).encode(0, Timesync(0, 5, *addressee))
    (message,) = FrameReceiver().feed(0, frame)
    assert (message.target_system, message.target_component) == addressee
