"""The bytes that board and ground station share: pure functions from values to bytes and back."""


class WireError(ValueError):
    """Bytes that are not a message of this protocol, or a value that no message can carry."""


def check_size(what: str, data: bytes, *sizes: int) -> None:
    """Raise `WireError` unless `data` has one of these sizes: random bytes rarely have the size of a command."""
    if len(data) not in sizes:
        raise WireError(f"{what} of {len(data)} bytes: expected {' or '.join(map(str, sizes))}")
