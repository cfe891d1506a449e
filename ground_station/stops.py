"""The signals that end a flight in order: Ctrl-C, the end of a service, a terminal that hangs up."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

HANGUP = tuple(getattr(signal, name) for name in ("SIGHUP",) if hasattr(signal, name))  # POSIX has it
STOPS = (signal.SIGINT, signal.SIGTERM, *HANGUP)


def heeded() -> list[int]:
    """Return the signals that end a flight; without the last for a process that shall survive its terminal (nohup)."""
    return [one for one in STOPS if not (one in HANGUP and signal.getsignal(one) is signal.SIG_IGN)]


def stop_signals() -> list[int]:
    """Return a list that receives the signals for an orderly end."""
    stops: list[int] = []
    for number in heeded():
        signal.signal(number, lambda received, _: stops.append(received))
    return stops


@contextmanager
def stopped_like_ctrl_c() -> Iterator[None]:
    """Let the other signals raise `KeyboardInterrupt`, as Ctrl-C does, but once: a terminal may send several."""
    others = heeded()[1:]

    def interrupt(received: int, frame: object) -> None:
        for number in others:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = [signal.signal(number, interrupt) for number in others]
    try:
        yield
    finally:
        for number, handler in zip(others, before, strict=True):
            signal.signal(number, handler)
