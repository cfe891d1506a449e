"""The exceptions of own logic."""

from firmware_py.errors import FirmwareError


class LogicError(FirmwareError):
    """A user's module cannot fly; the text says where and why."""
