"""The exception of the export: what cannot be translated, built or run."""

from firmware_py.errors import FirmwareError


class ExportError(FirmwareError):
    """The text says what, where, and what is allowed or missing."""
