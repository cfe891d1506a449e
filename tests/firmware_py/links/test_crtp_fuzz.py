"""Whatever arrives on the radio, the board neither raises nor grows nor stops flying; its counters tell it."""

import struct

import numpy as np
import pytest
from cflib.utils.encoding import compress_quaternion
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.wire import WireError, crtp, localisation, log, memories, parameters
from firmware_py.wire.supervisor import State
from support.crtp_client import LINK, LOC, LOG, MEM, PARAM, PLATFORM, SUPERVISOR, CrtpClient
from support.firmware_bench import LEVEL

PACKETS = 40_000
BATCH = 4  # packets per millisecond: more than the delivery queue's tasks are ever given by a radio
UPRIGHT = compress_quaternion((0, 0, 0, 1))


def packet(port: int, channel: int, data: bytes) -> bytes:
    return crtp.encode(crtp.Packet(port, channel, data))


SEEDS = (  # one well-formed request of every kind, from which mutants are made
    packet(LINK, 0, b"echo"), packet(LINK, 1, b"\0"),
    packet(PLATFORM, 0, b"\1\1"), packet(PLATFORM, 1, b"\0"), packet(PLATFORM, 2, bytes(30)),
    packet(SUPERVISOR, 0, b"\x0c"), packet(SUPERVISOR, 1, b"\1\1"), packet(SUPERVISOR, 1, b"\2"),
    packet(LOG, 0, b"\3"), packet(LOG, 0, b"\2\5\0"), packet(LOG, 1, b"\6\1\7\0\0\7\1\0"),
    packet(LOG, 1, b"\7\1\7\2\0"), packet(LOG, 1, b"\3\1\1"), packet(LOG, 1, b"\x08\1\1\0"), packet(LOG, 1, b"\2\1"),
    packet(LOG, 1, b"\5"), packet(PARAM, 0, b"\3"), packet(PARAM, 0, b"\2\1\0"), packet(PARAM, 1, b"\1\0"),
    packet(PARAM, 2, b"\1\0\0\0\x80\x3f"), packet(PARAM, 3, b"\0extCtrl\0z_P\0\x06\0\0\x80\x3f"),
    *(packet(PARAM, 3, bytes((command, 1, 0))) for command in range(2, 9)),
    packet(MEM, 0, b"\1"), packet(MEM, 0, b"\2\0"), packet(MEM, 1, b"\0\0\0\0\0\x18"),
    packet(MEM, 2, b"\0\0\x04\0\0FPS1"), packet(MEM, 2, struct.pack("<BI", 1, 8) + bytes(16)),
    packet(LOC, 0, struct.pack("<3f", 1, 2, 3)), packet(LOC, 2, struct.pack("<Bhhh", 0xE7, 1, 2, 3)),
    crtp.encode_ext_pose((0.0, 0.0, 0.0), LEVEL, 40_000),
    packet(LOC, 1, b"\x09" + struct.pack("<BhhhI", 0xE7, 1, 2, 3, UPRIGHT)),
    packet(LOC, 1, b"\3"), packet(LOC, 1, b"\4"), packet(3, 0, bytes(14)), packet(7, 0, b"\0"),
)  # fmt: skip


def mutant(rng: np.random.Generator) -> bytes:
    """A random packet, or a well-formed one with bytes changed, cut or added."""
    if rng.random() < 0.2:
        return rng.bytes(int(rng.integers(0, 40)))
    data = bytearray(SEEDS[rng.integers(len(SEEDS))])
    for _ in range(int(rng.integers(0, 4))):
        kind = rng.integers(4)
        if kind < 2 and len(data) > 1:
            data[rng.integers(1, len(data))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, int(rng.integers(256))))
        elif kind == 2:
            del data[int(rng.integers(0, len(data) + 1)) :]
        else:
            data += rng.bytes(int(rng.integers(0, 6)))
    return bytes(data)


@pytest.mark.long
def test_the_board_survives_random_and_mutated_packets() -> None:
    rng = np.random.default_rng(4)
    client = CrtpClient()
    client.imu_alive = False
    link = client.firmware.link
    offered = 0
    while offered < PACKETS:
        for _ in range(BATCH):
            client.firmware.radio_received(mutant(rng))
        offered += BATCH
        client.run(client.now_us + 1000)
        client.sent.clear()
        client.writes.clear()
        client.console.clear()
    for queue in client.firmware.kernel.queues:
        assert queue.high_water <= queue.length, queue.name
    assert link.malformed > PACKETS // 20
    assert link.unserved > 0
    fresh = CrtpClient()
    for port in (LOG, PARAM):
        assert client.one(port, 0, b"\3") == fresh.one(port, 0, b"\3")
    assert np.isfinite(client.firmware.signals.estimate).all()
    client.send(LOG, 1, b"\5")
    client.send(SUPERVISOR, 1, b"\2")
    client.run(client.now_us + 500_000)
    client.reboot()  # with whatever is now in the memories
    client.imu_alive = True
    client.send(SUPERVISOR, 1, b"\2")
    client.poses(605_000, 900_000)
    client.run(900_000)
    assert client.firmware.signals.supervisor.state is State.FLYING


@given(st.binary(max_size=40))
@settings(max_examples=300)
def test_decoders_raise_nothing_but_their_own_error(data: bytes) -> None:
    for decode in (
        crtp.decode,
        crtp.decode_ext_pose,
        log.decode_data,
        localisation.decode_packed_poses,
        memories.decode_config,
        parameters.decode_set_by_name,
        parameters.decode_ident,
    ):
        for variant in (data, b"\0" + data, b"\x09" + data, b"\0a\0b\0" + data):
            try:
                decode(variant)
            except WireError:
                continue
