"""Channels and commands of the Crazyflie's platform and supervisor ports, for both ends of a link."""

PLATFORM_COMMAND, PLATFORM_VERSION, PLATFORM_APP = 0, 1, 2
VERSION_PROTOCOL, VERSION_FIRMWARE, VERSION_DEVICE = 0, 1, 2
COMMAND_ARM, COMMAND_RECOVER, COMMAND_NOTIFY = 1, 2, 3

SUPERVISOR_INFO, SUPERVISOR_COMMAND = 0, 1
GET_BITS = 0x0C
ARM, RECOVER, STOP, STOP_WATCHDOG = 1, 2, 3, 4
REPLY = 0x80
LOCKED = 1 << 6  # of the supervisor's bits: stopped until a reboot
