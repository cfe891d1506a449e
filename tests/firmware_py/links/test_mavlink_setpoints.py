"""Requests that the board does not serve, and its modes: every sender gets an answer."""

from typing import Any

import pytest

from support.mavlink_client import LEVEL, STATION, MavlinkClient, codec, lines

ACCEPTED, DENIED = 0, 2
DO_SET_MODE, REQUEST_MESSAGE, AVAILABLE_MODES, CURRENT_MODE = 176, 512, 435, 436
HOLD, OFFBOARD = 0x03040000, 0x00060000
OTHER = (7, 190)
GOAL_MASK, VELOCITY_MASK, POSITION_MASK = (
    0x9F8,
    0xDC7,
    0x9C0,
)  # what they leave out: all but position and yaw, …

UNSERVED: dict[str, tuple[Any, ...]] = {
    "set_attitude_target": (0, 1, 1, 0, LEVEL, 0, 0, 0, 0.5),
    "set_position_target_global_int": (0, 1, 1, 6, GOAL_MASK, 0, 0, 1.0, 0, 0, 0, 0, 0, 0, 0, 0),
    "manual_control": (1, 0, 0, 500, 0, 0),
    "rc_channels_override": (1, 1, *(1500,) * 8),
    "set_home_position": (1, 0, 0, 0, 0, 0, 0, LEVEL, 0, 0, 0),
    "set_gps_global_origin": (1, 0, 0, 0),
    "log_erase": (1, 1),
}


@pytest.fixture
def client() -> MavlinkClient:
    made = MavlinkClient()
    made.run(700_000)  # the gyro's zero is found
    made.messages.clear()
    return made


def target(
    x: float, mask: int = GOAL_MASK, vx: float = 0.0, frame: int = 1, z: float = -1.15
) -> tuple[Any, ...]:
    return 0, 1, 1, frame, mask, x, 0, z, vx, 0, 0, 0, 0, 0, 0, 0


def texts(client: MavlinkClient, name: str, *fields: Any) -> list[str]:
    return lines(answer for answer in client.ask(name, *fields) if answer.get_type() == "STATUSTEXT")


def by(client: MavlinkClient, sender: tuple[int, int], name: str, *fields: Any) -> None:
    other = codec(*sender)
    client.receive(getattr(other, f"{name}_encode")(*fields).pack(other))
    client.run(client.now_us + 3000)


def aim(client: MavlinkClient) -> float:
    """The x of the goal that the board reports."""
    (found,) = [a for a in client.command(REQUEST_MESSAGE, 85) if a.get_type() == "POSITION_TARGET_LOCAL_NED"]
    return round(float(found.x), 6)


# What is not served


@pytest.mark.long
@pytest.mark.parametrize("name", UNSERVED)
def test_unserved_requests_are_reported_once_then_seldom(client: MavlinkClient, name: str) -> None:
    line = f"{name.upper()} is not served"
    assert texts(client, name, *UNSERVED[name]) == [line]
    client.messages.clear()
    for _ in range(100):
        client.send(name, *UNSERVED[name])
        client.run(client.now_us + 20_000)
    assert client.texts() == []
    client.run(client.now_us + 10_000_000)
    assert texts(client, name, *UNSERVED[name]) == [f"{line} (100 more before)"]
    assert client.stack.unserved == 102  # 1 + 100 + 1
    client.run(client.now_us + 10_000_000)
    assert [texts(client, name, *UNSERVED[name]) for _ in range(2)] == [[line], []]  # seldom again


@pytest.mark.long
def test_a_thousand_senders_get_no_thousand_texts(client: MavlinkClient) -> None:
    for number in range(1, 1001):
        sender = 2 + number % 5, 1 + number % 250
        by(client, sender, "set_attitude_target", *UNSERVED["set_attitude_target"])
    assert len(client.texts()) == 64 + 1
    assert client.texts()[-1] == "requests of further kinds or senders refused"


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("set_attitude_target", (0, 2, 1, 0, LEVEL, 0, 0, 0, 0.5)),  # for another system
        ("manual_control", (2, 0, 0, 500, 0, 0)),
        ("vfr_hud", (0, 0, 0, 0, 0, 0)),  # telemetry of another vehicle
        ("command_ack", (400, 0)),
        ("mission_ack", (1, 1, 0)),
        ("log_request_end", (1, 1)),
    ],
)
def test_other_messages_are_not_answered(client: MavlinkClient, name: str, fields: tuple[Any, ...]) -> None:
    assert texts(client, name, *fields) == []


def test_exclusive_control_is_refused(client: MavlinkClient) -> None:
    answers = client.ask("change_operator_control", 1, 0, 0, b"")
    (ack,) = [a for a in answers if a.get_type() == "CHANGE_OPERATOR_CONTROL_ACK"]
    assert (ack.gcs_system_id, ack.control_request, ack.ack) == (STATION[0], 0, 2)
    assert [a.text for a in answers if a.get_type() == "STATUSTEXT"] == [
        "no client gets control for itself alone"
    ]


@pytest.mark.long
@pytest.mark.parametrize(
    ("fields", "line"),
    [
        (target(0.0, VELOCITY_MASK & ~0x400, vx=1.0), "target refused: it has a velocity, no position"),
        (target(0.0, VELOCITY_MASK, vx=1.0), "target refused: it has a velocity, no position"),
        (target(0.1, frame=8), "target in frame 8: LOCAL_NED is flown"),
        (target(0.1, GOAL_MASK | 1), "target refused: x, y, z together, and no force"),
        (target(0.0, 0xDFF), "target refused: neither position nor yaw"),
    ],
)
def test_bad_targets_fail_with_the_reason(client: MavlinkClient, fields: tuple[Any, ...], line: str) -> None:
    assert texts(client, "set_position_target_local_ned", *fields) == [line]
    assert texts(client, "set_position_target_local_ned", *fields) == []
    assert client.stack.refused == 2
    assert aim(client) == 0.0


def test_a_velocity_beside_a_position_is_reported_and_the_position_is_flown(client: MavlinkClient) -> None:
    moving = target(0.1, POSITION_MASK, vx=0.2)
    assert texts(client, "set_position_target_local_ned", *moving) == [
        "only position and yaw of targets are flown"
    ]
    assert aim(client) == 0.1
    assert texts(client, "set_position_target_local_ned", *target(0.05, POSITION_MASK)) == []


def test_a_pose_that_is_refused_is_reported(client: MavlinkClient) -> None:
    (line,) = texts(client, "att_pos_mocap", 0, LEVEL, 1e6, 0, 0)
    assert line.startswith("position (1000000.0,")


# Modes


def current(client: MavlinkClient) -> int:
    """The mode that CURRENT_MODE and the next heartbeat report."""
    _, found = client.command(REQUEST_MESSAGE, CURRENT_MODE)
    assert found.intended_custom_mode == found.custom_mode
    (beat,) = [a for a in client.command(REQUEST_MESSAGE, 0) if a.get_type() == "HEARTBEAT"]
    assert beat.custom_mode == found.custom_mode
    return int(found.custom_mode)


def offboard(client: MavlinkClient, *params: float) -> None:
    ack, *_ = client.command(DO_SET_MODE, *(params or (1, 6, 0)))
    assert (ack.command, ack.result) == (DO_SET_MODE, ACCEPTED)


@pytest.mark.parametrize(("index", "names"), [(0, ["Hold", "Offboard"]), (1, ["Hold"]), (2, ["Offboard"])])
def test_modes_are_listed(client: MavlinkClient, index: int, names: list[str]) -> None:
    _, *found = client.command(REQUEST_MESSAGE, AVAILABLE_MODES, index)
    assert [mode.mode_name for mode in found] == names
    assert {mode.number_modes for mode in found} == {2}
    numbers = {"Hold": (1, HOLD), "Offboard": (2, OFFBOARD)}
    assert [(mode.mode_index, mode.custom_mode) for mode in found] == [numbers[name] for name in names]
    assert client.command(REQUEST_MESSAGE, AVAILABLE_MODES, 3)[0].result == 2


@pytest.mark.parametrize("params", [(1, 6, 0), (1, OFFBOARD, 0)])
def test_offboard_starts_and_ends_by_command(client: MavlinkClient, params: tuple[float, ...]) -> None:
    assert current(client) == HOLD
    client.messages.clear()
    offboard(client, *params)
    assert [mode.custom_mode for mode in client.of("CURRENT_MODE")] == [OFFBOARD]  # unasked
    assert client.texts() == ["mode: offboard"]
    assert current(client) == OFFBOARD
    assert client.command(DO_SET_MODE, 1, 4, 3)[0].result == ACCEPTED
    assert current(client) == HOLD
    client.messages.clear()
    by(client, OTHER, "set_position_target_local_ned", *target(0.1))
    client.run(client.now_us + 600_000)
    assert (aim(client), client.texts()) == (0.1, [])


def test_the_older_message_chooses_modes_as_well(client: MavlinkClient) -> None:
    for number, result in ((OFFBOARD, ACCEPTED), (4, DENIED), (HOLD, ACCEPTED)):
        (ack,) = [a for a in client.ask("set_mode", 1, 1, number) if a.get_type() == "COMMAND_ACK"]
        assert (ack.command, ack.result) == (DO_SET_MODE, result)
        assert (ack.target_system, ack.target_component) == STATION
    assert client.command(DO_SET_MODE, 1, 3, 0)[0].result == DENIED


def test_offboard_ends_half_a_second_after_the_last_setpoint_keeping_the_goal(client: MavlinkClient) -> None:
    offboard(client)
    for x in (0.0, 0.05, 0.1):
        client.run(client.now_us + 400_000)
        client.send("set_position_target_local_ned", *target(x))
    client.messages.clear()
    client.run(client.now_us + 495_000)
    assert client.texts() == []
    client.run(client.now_us + 10_000)
    assert client.texts() == ["offboard left: no set-points for 0.5 s, holding"]
    assert current(client) == HOLD
    assert aim(client) == 0.1


def test_targets_that_are_refused_keep_no_offboard_alive(client: MavlinkClient) -> None:
    offboard(client)
    for _ in range(8):
        client.send("set_position_target_local_ned", *target(0.0, VELOCITY_MASK, vx=1.0))
        client.run(client.now_us + 100_000)
    assert current(client) == HOLD


@pytest.mark.parametrize("older", [False, True])
def test_in_offboard_only_the_client_that_started_it_moves_the_goal(
    client: MavlinkClient, older: bool
) -> None:
    if older:
        client.ask("set_mode", 1, 1, OFFBOARD)
    else:
        offboard(client)
    by(client, OTHER, "set_position_target_local_ned", *target(0.1))
    assert "target refused: another client is in offboard" in client.texts()
    assert aim(client) == 0.0
    by(client, STATION, "set_position_target_local_ned", *target(0.05))
    assert aim(client) == 0.05
    client.run(client.now_us + 600_000)
    by(client, OTHER, "set_position_target_local_ned", *target(0.1))
    assert aim(client) == 0.1


# The box


@pytest.mark.parametrize(("x", "z"), [(0.16, -1.15), (0.0, -1.81), (0.0, -0.49)])
def test_a_target_outside_the_box_names_the_parameters(client: MavlinkClient, x: float, z: float) -> None:
    line = "target refused: outside the box, see BOX_RADIUS, BOX_BELOW and BOX_ABOVE"
    assert texts(client, "set_position_target_local_ned", *target(x, z=z)) == [line]
    assert aim(client) == 0.0
    inside = (x - 0.02, z + (0.02 if z < -1.5 else -0.02 if z > -1.0 else 0.0))
    assert texts(client, "set_position_target_local_ned", *target(inside[0], z=inside[1])) == []
    assert aim(client) == round(inside[0], 6)


def test_the_box_follows_its_parameters_and_a_goal_outside_may_return(client: MavlinkClient) -> None:
    client.ask("param_set", 1, 1, b"BOX_RADIUS", 1.0, 9)
    assert texts(client, "set_position_target_local_ned", *target(0.9)) == []
    client.ask("param_set", 1, 1, b"BOX_RADIUS", 0.1, 9)
    for x, expected in ((0.95, 0.9), (0.5, 0.5), (0.6, 0.5), (0.05, 0.05), (0.15, 0.05)):
        client.ask("set_position_target_local_ned", *target(x))
        assert aim(client) == expected
