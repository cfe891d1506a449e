"""Whatever arrives on the serial line, the board neither raises nor grows nor stops flying; its counters tell it."""

import numpy as np
import pytest

from firmware_py.wire.supervisor import State
from support.mavlink_client import STATION, MavlinkClient, codec
from support.random_requests import random_message, spoilt

MESSAGES = 10_000
BATCH = 4  # messages per millisecond: twice what 921600 baud can carry


def recover(client: MavlinkClient) -> None:
    """Undo what the fuzz did to the supervisor and its parameters, as a ground station would."""
    client.firmware.signals.supervisor._fields.locked = 0  # without a reboot: this board shall fly on
    for name, value in (
        (b"FLOATY_STOP", 1.0),
        (b"FLOATY_STOP", 0.0),
        (b"EXT_MANUAL", 0.0),
        (b"SUP_LOWBATTERY", 3200.0),
    ):
        client.ask("param_set", 1, 1, name, value, 9)
    client.command(400, 1)


@pytest.mark.long
def test_the_board_survives_messages_of_every_kind_with_any_contents() -> None:
    rng = np.random.default_rng(5)
    client = MavlinkClient()
    client.run(700_000)  # the gyro's zero is known
    client.imu_alive = False
    sender, sent = codec(*STATION), 0
    while sent < MESSAGES:
        frames = [random_message(rng).pack(sender) for _ in range(BATCH)]
        sent += BATCH
        if rng.random() < 0.2:
            frames[0] = spoilt(rng, frames[0])
        client.receive(b"".join(frames))
        client.run(client.now_us + 1000)
        client.writes.clear()
        client.console.clear()
        if len(client.messages) > 10_000:
            client.messages.clear()
    stack, counters = client.stack, client.stack.counters
    for queue in client.firmware.kernel.queues:
        assert queue.high_water <= queue.length, queue.name
    assert counters.frames > 0.9 * MESSAGES
    assert stack.refused > MESSAGES // 20
    assert stack.unserved > MESSAGES // 20
    assert stack.counters.bad > 0
    assert np.isfinite(client.firmware.signals.estimate).all()
    client.send("request_data_stream", 1, 1, 0, 1, 0)
    client.command(511, 350, -1)
    client.run(client.now_us + 200_000)
    fresh = MavlinkClient()
    for asked in (client, fresh):
        asked.ask("param_request_list", 1, 1, wait_us=200_000)
    names = [[answer.param_id for answer in asked.of("PARAM_VALUE")] for asked in (client, fresh)]
    assert names[0] == names[1] != []
    recover(client)
    client.imu_alive = True
    client.send("set_position_target_local_ned", 0, 1, 1, 1, 0x9F8, 0, 0, -1.15, 0, 0, 0, 0, 0, 0, 0, 0)
    client.poses(client.now_us + 5000, client.now_us + 2_000_000)
    client.run(client.now_us + 2_000_000)
    assert client.firmware.signals.supervisor.state is State.FLYING, client.console


@pytest.mark.long
def test_a_board_with_a_key_learns_nothing_from_a_hundred_thousand_unsigned_bytes() -> None:
    rng = np.random.default_rng(6)
    client = MavlinkClient(f'mavlink.signing_key="{bytes(32).hex()}"')
    sender = codec(*STATION)
    for _ in range(1000):
        client.receive(random_message(rng).pack(sender) + rng.bytes(50))
        client.run(client.now_us + 1000)
    assert client.stack.counters.unsigned > 900
    assert client.stack.counters.frames == 0
    assert client.stack.refused == client.stack.unserved == 0
