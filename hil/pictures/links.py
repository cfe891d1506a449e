"""Links from a report into the recording of its flight.

A page opened from disk cannot start a viewer, and rerun's browser viewer reads recordings only from a server. So the
links lead to this computer, where `floaty view RUN --view web` answers them for their run.
"""

from hil.laboratory.files.result import Result

HOST, PORT = "127.0.0.1", 9877  # beside rerun's own 9876


def key_of(result: Result) -> str:
    """Return the key that distinguishes the links of one flight from those of others."""
    return (result.hash or "unfinished")[:16]


def link_to(result: Result, at_s: float) -> str:
    """Return the address of an instant, seconds from the release, of a flight."""
    return f"http://{HOST}:{PORT}/{key_of(result)}/{at_s:.2f}"
