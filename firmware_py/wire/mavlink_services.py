"""The messages of the standard's services: heartbeats, commands, parameters, clocks, texts, files.

Nothing here has an axis; flight data is in `mavlink`.
"""

import pymavlink.dialects.v20.development as dialect

from firmware_py.wire.mavlink_dialect import Message, ProtocolVersion, Timesync
from firmware_py.wire.mavlink_numbers import Mode

BOARD_COMPONENT = 1  # autopilot
NAME_SIZE = 16  # of a parameter

PREFIXES = {  # of parameters, by group
    "extCtrl": "EXT",
    "motorPowerSet": "PWR",
    "motorShifts": "TRIM",
    "setpoint": "SP",
    "RandConsts": "RND",
    "delayComp": "DLY",
    "kalman": "KAL",
    "model": "MDL",
    "FloatyKalm": "FKL",
    "locSrv": "LOC",
    "stabilizer": "STAB",
    "supervisor": "SUP",
    "logic": "OWN",
    "excite": "EXC",
    "memTst": "MEM",
    "deck": "DK",
    "imu_sensors": "IMU",
    "firmware": "FW",
}


_VERSION = 3  # the heartbeat's field, 3 in MAVLink 1 and 2
_U16_MAX, _U32_MAX, _I32_MAX = 0xFFFF, 0xFFFFFFFF, 0x7FFFFFFF
# MISSION_INT because the board answers these messages, though with "unsupported": clients ask only if it is set.
_CAPABILITIES = (
    dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST  # every value is sent as REAL32
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
_FTP_NAK, _FTP_UNKNOWN_COMMAND = 129, 6
_STATUS_OF_STATE = (
    dialect.MAV_STATE_CALIBRATING,
    dialect.MAV_STATE_STANDBY,
    dialect.MAV_STATE_ACTIVE,
    dialect.MAV_STATE_CRITICAL,
)
_LANDED_OF_STATE = (
    dialect.MAV_LANDED_STATE_ON_GROUND,
    dialect.MAV_LANDED_STATE_ON_GROUND,
    dialect.MAV_LANDED_STATE_IN_AIR,
    dialect.MAV_LANDED_STATE_UNDEFINED,
)
_STATE_FLYING = 2
_MODE_FLYING = dialect.MAV_MODE_FLAG_STABILIZE_ENABLED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED


def u16(value: int) -> int:
    """Return the nearest number that 16 bits can hold."""
    return max(0, min(_U16_MAX, value))


def u32(value: int) -> int:
    """Return the lower 32 bits: clocks wrap."""
    return value & _U32_MAX


def mavlink_name(name: str) -> str:
    """Return the MAVLink name of parameter `group.name`; a group that is not in the table keeps its own name."""
    group, _, own = name.partition(".")
    return f"{PREFIXES.get(group, group)}_{own}".upper()[:NAME_SIZE]


def station_heartbeat() -> Message:
    """Return the heartbeat of a ground station."""
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, _VERSION
    )


def command(system: int, number: int, *params: float) -> Message:
    """Return a COMMAND_LONG to a board with at most seven parameters; those left out are zero."""
    padded = (*params, *(0.0,) * (7 - len(params)))
    return dialect.MAVLink_command_long_message(system, BOARD_COMPONENT, number, 0, *padded)


def timesync(tc1_ns: int, ts1_ns: int) -> Message:
    """Return a request (`tc1_ns` = 0) with the sender's clock."""
    return dialect.MAVLink_timesync_message(tc1_ns, ts1_ns)


def timesync_answer(tc1_ns: int, request: Message) -> Message:
    """Return the answer to a request: own clock, and what its sender recognises it by."""
    return Timesync(tc1_ns, request.ts1, request.get_srcSystem(), request.get_srcComponent())


def ping_answer(request: Message) -> Message:
    return dialect.MAVLink_ping_message(
        request.time_usec, request.seq, request.get_srcSystem(), request.get_srcComponent()
    )


def heartbeat(armed: bool, state: int, mode: int = Mode.HOLD) -> Message:
    """Return the board's heartbeat; `armed`: flaps under control. `state` is that of the supervisor, 0..3."""
    base_mode = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    if armed:
        base_mode |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
    if state == _STATE_FLYING:
        base_mode |= _MODE_FLYING
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_GENERIC,
        dialect.MAV_AUTOPILOT_GENERIC,
        base_mode,
        mode,
        _STATUS_OF_STATE[state],
        _VERSION,
    )


def read_heartbeat(message: Message) -> int | None:
    """Return the supervisor's state in a board's heartbeat, 0..3; None for a status that no board sends."""
    status = message.system_status
    return _STATUS_OF_STATE.index(status) if status in _STATUS_OF_STATE else None


def available_mode(mode: Mode) -> Message:
    """Return one of the board's modes; their indices begin at 1."""
    modes = tuple(Mode)
    return dialect.MAVLink_available_modes_message(
        len(modes),
        modes.index(mode) + 1,
        dialect.MAV_STANDARD_MODE_NON_STANDARD,
        mode,
        0,
        _text(mode.name.capitalize(), 35),
    )


def current_mode(mode: Mode) -> Message:
    """Return the mode in force: the one that was chosen last, or its replacement."""
    return dialect.MAVLink_current_mode_message(dialect.MAV_STANDARD_MODE_NON_STANDARD, mode, mode)


def no_control(request: Message) -> Message:
    """Return the answer to CHANGE_OPERATOR_CONTROL: no control for anybody. The nearest code is 2, passkey."""
    return dialect.MAVLink_change_operator_control_ack_message(
        request.get_srcSystem(), request.control_request, 2
    )


def system_time(unix_us: int, t_ms: int) -> Message:
    """Return the time of day, 0 while it is not known, and the time since boot."""
    return dialect.MAVLink_system_time_message(unix_us, u32(t_ms))


def named_value(t_ms: int, name: str, value: float) -> Message:
    """Return a named number; the name is cut at 10 characters."""
    return dialect.MAVLink_named_value_float_message(u32(t_ms), _text(name, 10), value)


def status_text(severity: int, text: str, number: int = 0) -> tuple[Message, ...]:
    """Return a line for the operator; severity as in syslog, 0 emergency .. 7 debug.

    A line of more than 50 characters is sent in pieces that carry its number, 1..65535; the last is shorter.
    """
    size = dialect.MAVLink_statustext_message.array_lengths[1]
    if len(text) <= size:
        return (dialect.MAVLink_statustext_message(severity, _text(text, size)),)
    return tuple(
        dialect.MAVLink_statustext_message(severity, _text(text[start:], size), number, start // size)
        for start in range(0, len(text) + 1, size)
    )


def parameter(name: str, value: float, index: int, count: int) -> Message:
    """Return a parameter's value; the type is always REAL32, the only one that all ground stations read alike."""
    return dialect.MAVLink_param_value_message(
        _text(name, NAME_SIZE), value, dialect.MAV_PARAM_TYPE_REAL32, u16(count), u16(index)
    )


def parameter_list(system: int) -> Message:
    """Return a request for all parameters of a board."""
    return dialect.MAVLink_param_request_list_message(system, BOARD_COMPONENT)


def parameter_read(system: int, which: str | int) -> Message:
    """Return a request for one parameter, by name or by its index."""
    name, index = (which, -1) if isinstance(which, str) else ("", which)
    return dialect.MAVLink_param_request_read_message(system, BOARD_COMPONENT, _text(name, NAME_SIZE), index)


def parameter_set(system: int, name: str, value: float) -> Message:
    """Return a request to change a parameter, as REAL32."""
    return dialect.MAVLink_param_set_message(
        system, BOARD_COMPONENT, _text(name, NAME_SIZE), value, dialect.MAV_PARAM_TYPE_REAL32
    )


def command_ack(number: int, result: int, to_system: int, to_component: int) -> Message:
    """Return the answer to a command: MAV_RESULT 0 accepted, 1 temporarily rejected, 2 denied, 3 unsupported, 4 failed."""
    return dialect.MAVLink_command_ack_message(number, result, 0, 0, to_system, to_component)


def refusal(ack: Message) -> str:
    """Return the result in a COMMAND_ACK that does not accept, in the standard's words."""
    result = _word("MAV_RESULT", ack.result).replace("_", " ").lower()
    return f"the board refuses {_word('MAV_CMD', ack.command)}: {result}"


def _word(enumeration: str, number: int) -> str:
    """Return the standard's word for a number; the number where there is none."""
    known = dialect.enums[enumeration].get(number)
    return str(number) if known is None else known.name.removeprefix(f"{enumeration}_")


def autopilot_version(version: tuple[int, int, int], revision: bytes, uid: int) -> Message:
    """Return the board's version, up to 8 bytes of the source's revision, and its serial number."""
    major, minor, patch = version
    packed = major << 24 | minor << 16 | patch << 8
    own, none = list(revision[:8].ljust(8, b"\0")), [0] * 8
    return dialect.MAVLink_autopilot_version_message(
        _CAPABILITIES, packed, 0, 0, 0, own, none, none, 0, 0, uid
    )


def protocol_version() -> Message:
    """Return MAVLink 2, and the versions that are read: 1 as well; the revisions of the standard are not stated."""
    return ProtocolVersion(200, 100, 200)


def message_interval(number: int, interval_us: int) -> Message:
    """Return how often a message is sent; -1: not at all, 0: there is no such message."""
    return dialect.MAVLink_message_interval_message(u16(number), max(-1, min(_I32_MAX, interval_us)))


def parameter_error(request: Message, name: str, index: int, error: int) -> Message:
    """Return why a parameter request fails: a MAV_PARAM_ERROR."""
    return dialect.MAVLink_param_error_message(
        request.get_srcSystem(), request.get_srcComponent(), _text(name, NAME_SIZE), index, error
    )


def no_mission(request: Message) -> Message:
    """Return the answer to MISSION_REQUEST_LIST, for every type of mission."""
    return dialect.MAVLink_mission_count_message(
        request.get_srcSystem(), request.get_srcComponent(), 0, request.mission_type
    )


def refused_mission(request: Message) -> Message:
    """Return the answer to every other message about missions."""
    return dialect.MAVLink_mission_ack_message(
        request.get_srcSystem(),
        request.get_srcComponent(),
        dialect.MAV_MISSION_UNSUPPORTED,
        getattr(request, "mission_type", dialect.MAV_MISSION_TYPE_MISSION),
    )


def no_logs() -> Message:
    """Return the answer to LOG_REQUEST_LIST."""
    return dialect.MAVLink_log_entry_message(0, 0, 0, 0, 0)


def no_log_data(request: Message) -> Message:
    """Return the answer to LOG_REQUEST_DATA: the log ends there."""
    return dialect.MAVLink_log_data_message(request.id, request.ofs, 0, (0,) * 90)


def extended_state(state: int) -> Message:
    """Return whether the robot is in the air, by the supervisor's state: in failsafe that is not known on board."""
    return dialect.MAVLink_extended_sys_state_message(
        dialect.MAV_VTOL_STATE_UNDEFINED, _LANDED_OF_STATE[state]
    )


def ftp_nak(request: Message) -> Message:
    """Return the answer to any file transfer: unknown command."""
    asked = bytes(request.payload)
    sequence = (int.from_bytes(asked[:2], "little") + 1) & 0xFFFF
    session, opcode = asked[2], asked[3]
    head = sequence.to_bytes(2, "little") + bytes((session, _FTP_NAK, 1, opcode, 0, 0)) + asked[8:12]
    answer = head + bytes((_FTP_UNKNOWN_COMMAND,))
    return dialect.MAVLink_file_transfer_protocol_message(
        0, request.get_srcSystem(), request.get_srcComponent(), answer.ljust(251, b"\0")
    )


def _text(text: str, size: int) -> bytes:
    return text.encode("ascii", "replace")[:size]
