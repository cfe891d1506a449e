"""The exceptions of own logic."""

from firmware_py.errors import FirmwareError


class LogicError(FirmwareError):
    """A module of the user's cannot fly; the text says where and why."""
