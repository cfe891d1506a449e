"""The bytes that board and ground station share: pure functions from values to bytes and back."""


class WireError(ValueError):
    """Bytes that are not a message of this protocol, or a value that no message can carry."""
