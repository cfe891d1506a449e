"""The exceptions of the firmware package."""


class FirmwareError(Exception):
    """Base of everything that the firmware package raises."""
