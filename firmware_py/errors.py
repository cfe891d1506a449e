"""The exceptions of the firmware package."""


class FirmwareError(Exception):
    """Base of everything that the firmware package raises."""


class ConfigError(FirmwareError):
    """A configuration value is missing, unknown or outside its range; the text says which, its value and what is allowed."""
