"""Whole conversations in bytes: what a ground station such as QGroundControl asks when it connects meets no silence."""

from typing import Any

import pymavlink.dialects.v20.development as dialect
import pytest

from support.mavlink_client import STATION, STREAMS, MavlinkClient

ACCEPTED, DENIED = 0, 2
MISSION, FENCE, RALLY = 0, 1, 2
PROTOCOL_VERSION, COMPONENT_INFORMATION, COMPONENT_METADATA, AVAILABLE_MODES = 300, 395, 397, 435
REQUEST_MESSAGE, SET_MESSAGE_INTERVAL = 512, 511


@pytest.fixture
def client() -> MavlinkClient:
    made = MavlinkClient()
    made.run(20_000)
    return made


def answers(client: MavlinkClient, kind: str, name: str, *fields: Any, wait_us: int = 3000) -> list[Any]:
    """The answers of one kind to a message of ours."""
    return [message for message in client.ask(name, *fields, wait_us=wait_us) if message.get_type() == kind]


def test_a_connection_as_qgroundcontrol_makes_it_meets_no_silence(client: MavlinkClient) -> None:
    """In the order of its InitialConnectStateMachine; every request gets what it waits for, or a refusal."""
    client.send(
        "heartbeat", dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE
    )
    client.send("system_time", 1_700_000_000_000_000, 0)

    def request(number: int) -> tuple[int, list[str]]:
        ack, *rest = client.command(REQUEST_MESSAGE, number)
        assert (ack.command, ack.target_system, ack.target_component) == (REQUEST_MESSAGE, *STATION)
        return ack.result, [answer.get_type() for answer in rest]

    assert request(148) == (ACCEPTED, ["AUTOPILOT_VERSION"])
    assert request(PROTOCOL_VERSION) == (ACCEPTED, ["UNKNOWN_300"])  # to pymavlink
    for number in (COMPONENT_METADATA, COMPONENT_INFORMATION):
        assert request(number) == (DENIED, [])
    assert request(AVAILABLE_MODES) == (ACCEPTED, ["AVAILABLE_MODES", "AVAILABLE_MODES"])
    assert client.command(519)[0].result == ACCEPTED  # the older request for PROTOCOL_VERSION
    (nak,) = answers(
        client, "FILE_TRANSFER_PROTOCOL", "file_transfer_protocol", 0, 1, 1, [1, 0, 0, 4] + [0] * 247
    )
    assert nak.payload[3] == 129

    listed = answers(client, "PARAM_VALUE", "param_request_list", 1, 1, wait_us=200_000)
    assert {value.param_index for value in listed} == set(range(listed[0].param_count))

    for kind in (MISSION, FENCE, RALLY):
        (found,) = answers(client, "MISSION_COUNT", "mission_request_list", 1, 1, kind)
        assert (found.count, found.mission_type) == (0, kind)
        assert (found.target_system, found.target_component) == STATION
        after = client.ask("mission_ack", 1, 1, 0, kind)  # the end of the transaction
        assert [answer.get_type() for answer in after if answer.get_type() not in STREAMS] == []

    assert request(242) == (ACCEPTED, ["HOME_POSITION"])
    for number in (245, 33, 331):
        assert client.command(SET_MESSAGE_INTERVAL, number, 100_000)[0].result == ACCEPTED
    client.messages.clear()
    client.send("request_data_stream", 1, 1, dialect.MAV_DATA_STREAM_ALL, 20, 1)
    client.run(client.now_us + 500_000)
    heard = {message.get_type() for _, message in client.messages}
    assert {"EXTENDED_SYS_STATE", "GLOBAL_POSITION_INT", "ODOMETRY", "SYS_STATUS", "ATTITUDE"} <= heard
    assert len(client.of("ATTITUDE")) == 10

    (log,) = answers(client, "LOG_ENTRY", "log_request_list", 1, 1, 0, 0xFFFF)
    assert (log.num_logs, log.last_log_num, log.size) == (0, 0, 0)
    assert client.command(176, 1, 4)[0].result == DENIED  # a mode


@pytest.mark.parametrize("kind", [MISSION, FENCE, RALLY])
def test_other_mission_messages_are_unsupported(client: MavlinkClient, kind: int) -> None:
    item = (1, 1, 0, 3, 16, 0, 1, 0, 0, 0, 0, 0, 0, 0, kind)
    requests: dict[str, tuple[Any, ...]] = {
        "mission_count": (1, 1, 3, kind),
        "mission_clear_all": (1, 1, kind),
        "mission_request": (1, 1, 0, kind),
        "mission_request_int": (1, 1, 0, kind),
        "mission_request_partial_list": (1, 1, 0, 5, kind),
        "mission_write_partial_list": (1, 1, 0, 5, kind),
        "mission_item": item,
        "mission_item_int": item,
    }
    for name, fields in requests.items():
        (ack,) = answers(client, "MISSION_ACK", name, *fields)
        assert (ack.type, ack.mission_type) == (dialect.MAV_MISSION_UNSUPPORTED, kind)
        assert (ack.target_system, ack.target_component) == STATION
    (ack,) = answers(client, "MISSION_ACK", "mission_set_current", 1, 1, 2)
    assert ack.type == dialect.MAV_MISSION_UNSUPPORTED


def test_mission_and_log_requests_to_another_system_are_ignored(client: MavlinkClient) -> None:
    assert client.ask("mission_request_list", 2, 1, 0) == []
    assert client.ask("log_request_list", 2, 1, 0, 0xFFFF) == []
    assert client.ask("set_mode", 2, 1, 4) == []


def test_a_log_that_is_not_there_ends_at_once(client: MavlinkClient) -> None:
    (data,) = answers(client, "LOG_DATA", "log_request_data", 1, 1, 7, 1000, 90)
    assert (data.id, data.ofs, data.count) == (7, 1000, 0)
