"""The numbers of CRTP's services are those of cflib: both ends of our links use one constant, so only a third party shows a
wrong one.
"""

import pytest
from cflib.crazyflie import commander, localization, log, param, platformservice, supervisor, toc
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.mem.memory_element import MemoryElement
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort

from firmware_py.wire import crtp, high_level, localisation, memories, parameters, setpoints
from firmware_py.wire import log as log_wire
from firmware_py.wire import supervisor as supervisor_wire
from firmware_py.wire import toc as toc_wire

PATH, MISC, LOG = high_level.PathCommand, parameters.Misc, log_wire.LogCommand
# Ours, where cflib has them, and how cflib names each.
SAME = (
    (crtp, CRTPPort, """
        PORT_CONSOLE CONSOLE, PORT_PARAMETERS PARAM, PORT_COMMANDER COMMANDER, PORT_MEMORIES MEM, PORT_LOG LOGGING,
        PORT_LOCALISATION LOCALIZATION, PORT_GENERIC_SETPOINT COMMANDER_GENERIC, PORT_SUPERVISOR SUPERVISOR,
        PORT_PLATFORM PLATFORM, PORT_LINK LINKCTRL
    """),
    (crtp, CRTPPacket, """
        MAX_DATA MAX_DATA_SIZE
    """),
    (crtp, localization.Localization, """
        CHANNEL_GENERIC GENERIC_CH, EXT_POSE EXT_POSE
    """),
    (localisation, localization.Localization, """
        EMERGENCY_STOP EMERGENCY_STOP, EXT_POSE_PACKED EXT_POSE_PACKED,
        EMERGENCY_STOP_WATCHDOG EMERGENCY_STOP_WATCHDOG
    """),
    (high_level, CRTPPort, """
        PORT SETPOINT_HL
    """),
    (PATH, HighLevelCommander, """
        SET_GROUP_MASK COMMAND_SET_GROUP_MASK, STOP COMMAND_STOP, GO_TO_1 COMMAND_GO_TO,
        START_1 COMMAND_START_TRAJECTORY, DEFINE COMMAND_DEFINE_TRAJECTORY, TAKE_OFF COMMAND_TAKEOFF_2,
        LAND COMMAND_LAND_2, SPIRAL COMMAND_SPIRAL, GO_TO COMMAND_GO_TO_2, START COMMAND_START_TRAJECTORY_2
    """),
    (parameters, param, """
        CHANNEL_READ READ_CHANNEL, CHANNEL_WRITE WRITE_CHANNEL, CHANNEL_MISC MISC_CHANNEL
    """),
    (parameters, param.ParamTocElement, """
        EXTENDED_PERSISTENT EXTENDED_PERSISTENT
    """),
    (MISC, param, """
        SET_BY_NAME MISC_SETBYNAME, VALUE_UPDATED MISC_VALUE_UPDATED, EXTENDED_TYPE MISC_GET_EXTENDED_TYPE,
        STORE MISC_PERSISTENT_STORE, STATE MISC_PERSISTENT_GET_STATE, CLEAR MISC_PERSISTENT_CLEAR,
        DEFAULT MISC_GET_DEFAULT_VALUE, DEFAULT_V2 MISC_GET_DEFAULT_VALUE_V2,
        EXTENDED_TYPE_V2 MISC_GET_EXTENDED_TYPE_V2
    """),
    (log_wire, log, """
        CHANNEL_CONTROL CHAN_SETTINGS, CHANNEL_DATA CHAN_LOGDATA
    """),
    (log_wire, log.LogConfig, """
        MAX_VALUES MAX_LEN
    """),
    (LOG, log, """
        DELETE CMD_DELETE_BLOCK, START CMD_START_LOGGING, STOP CMD_STOP_LOGGING, RESET CMD_RESET_LOGGING,
        CREATE CMD_CREATE_BLOCK_V2, APPEND CMD_APPEND_BLOCK_V2
    """),
    (toc_wire, toc, """
        CHANNEL TOC_CHANNEL
    """),
    (toc_wire, log, """
        ITEM CMD_GET_ITEM_V2, INFO CMD_GET_INFO_V2
    """),
    (memories, MemoryElement, """
        TYPE_EEPROM TYPE_I2C, TYPE_TRAJECTORIES TYPE_TRAJ, TYPE_TESTER TYPE_MEMORY_TESTER,
        TYPE_DECKS TYPE_DECK_MEMORY, TYPE_DECK_BOOTLOADERS TYPE_DECKCTRL_DFU
    """),
    (setpoints, commander, """
        CHANNEL_SETPOINT SET_SETPOINT_CHANNEL, CHANNEL_NOTICE META_COMMAND_CHANNEL, STOP TYPE_STOP,
        FULL_STATE TYPE_FULL_STATE, POSITION TYPE_POSITION
    """),
    (supervisor_wire, platformservice, """
        PLATFORM_COMMAND PLATFORM_COMMAND, PLATFORM_VERSION VERSION_COMMAND, VERSION_PROTOCOL VERSION_GET_PROTOCOL,
        VERSION_FIRMWARE VERSION_GET_FIRMWARE, PLATFORM_APP APP_CHANNEL, COMMAND_ARM PLATFORM_REQUEST_ARMING,
        COMMAND_RECOVER PLATFORM_REQUEST_CRASH_RECOVERY, COMMAND_NOTIFY PLATFORM_REQUEST_USER_NOTIFICATION
    """),
    (supervisor_wire, supervisor, """
        SUPERVISOR_INFO SUPERVISOR_CH_INFO, SUPERVISOR_COMMAND SUPERVISOR_CH_COMMAND, GET_BITS CMD_GET_STATE_BITFIELD,
        ARM CMD_ARM_SYSTEM, RECOVER CMD_RECOVER_SYSTEM, STOP CMD_EMERGENCY_STOP,
        STOP_WATCHDOG CMD_EMERGENCY_STOP_WATCHDOG
    """),
)  # fmt: skip
PAIRS = [(ours, theirs, *pair.split()) for ours, theirs, pairs in SAME for pair in pairs.split(",")]


@pytest.mark.long
@pytest.mark.parametrize(("ours", "theirs", "name", "called"), PAIRS, ids=lambda one: str(one)[:40])
def test_a_number_is_cflibs(ours: object, theirs: object, name: str, called: str) -> None:
    assert getattr(ours, name) == getattr(theirs, called)


def test_commands_older_or_newer_than_cflibs_have_the_firmwares_numbers() -> None:
    """crtp_commander_high_level.c of crazyflie-firmware."""
    older = {"TAKE_OFF_1": 1, "LAND_1": 2, "TAKE_OFF_WITH_VELOCITY": 9, "LAND_WITH_VELOCITY": 10}
    assert {name: PATH[name] for name in older} == older
    assert LOG.START_MS == 8


def test_the_bit_of_a_lock_is_cflibs() -> None:
    assert 1 << supervisor.BIT_IS_LOCKED == supervisor_wire.LOCKED
