"""The exceptions of the firmware package and of own logic."""


class FirmwareError(Exception):
    """Base of everything that the firmware package raises."""


class LogicError(FirmwareError):
    """A user's module cannot fly; the text says where and why."""
