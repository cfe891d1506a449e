"""An operator's requests to a board besides flying it: its parameters, arming, the emergency stop.

A request begins with `ask`; the code that runs the link calls `answer` until there is one. Nothing blocks here, so
poses are still sent. `Dialogue` is common to all protocols: a script of exchanges, each repeated until its reply
arrives.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from enum import Enum
from math import nan
from typing import Any, Generic, TypeVar

REPEAT_US = 100_000  # without a reply, before the request is repeated
PATIENCE_US = 2_000_000  # without a reply, before the request is given up


class ControlsError(Exception):
    """The board refuses, does not know the parameter, or does not answer; the text is one line."""


class ControlAction(Enum):
    """The kinds of requests."""

    LIST = "list"  # parameters and their values: all, or at least those whose names begin with a name
    READ = "read"
    WRITE = "write"
    SAVE = "save"  # the persistent parameters, for the next boot
    ARM = "arm"  # and clear every state that ends without a reboot
    STOP = "stop"  # at once: flaps at hover until the board reboots


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """One request; `name` is the board's own."""

    action: ControlAction
    name: str = ""
    value: float = nan


@dataclass(frozen=True, slots=True)
class Answer:
    """The result: the requested parameters, by the names of the link; `error` is empty on success."""

    values: tuple[tuple[str, float], ...]
    error: str = ""


M = TypeVar("M")  # a message of the protocol


@dataclass(frozen=True, slots=True)
class Exchange(Generic[M]):
    """One message and its reply; `parse_reply` returns None for any other message."""

    send: Callable[[int], object]
    parse_reply: Callable[[M], Any]
    waits: bool = False  # the reply comes unasked: send only when it does not
    patience_us: int = PATIENCE_US
    missing: str = f"no answer within {PATIENCE_US * 1e-6:.0f} s"  # the error without a reply


Settings = tuple[tuple[str, float], ...]
Script = Generator[Exchange[M], Any, Settings]


class Dialogue(Generic[M]):
    """A script of exchanges over any protocol, which may raise `ControlsError`."""

    def __init__(self) -> None:
        self._script: Script[M] | None = None
        self._exchange: Exchange[M] | None = None
        self._answer: Answer | None = None
        self._again_us = self._give_up_us = 0

    @property
    def busy(self) -> bool:
        """Whether a script has not ended yet."""
        return self._script is not None

    def begin(self, now_us: int, script: Script[M]) -> None:
        """Begin; an older script is dropped."""
        self._answer = None
        self._script = script
        self._go_on(now_us, None)

    def receive(self, now_us: int, message: M) -> bool:
        """Take a message; return whether it was the expected reply."""
        reply = None if self._exchange is None else self._exchange.parse_reply(message)
        if reply is not None:
            self._go_on(now_us, reply)
        return reply is not None

    def answer(self, now_us: int) -> Answer | None:
        """Return the answer once it is there; repeat what was not answered."""
        if self._exchange is not None and now_us >= self._again_us:
            if now_us >= self._give_up_us:
                self._end(Answer((), self._exchange.missing))
            else:
                self._again_us = now_us + REPEAT_US
                self._exchange.send(now_us)
        answer, self._answer = self._answer, None
        return answer

    def _go_on(self, now_us: int, reply: Any) -> None:
        assert self._script is not None
        try:
            exchange = self._script.send(reply)
        except StopIteration as end:
            self._end(Answer(end.value))
        except ControlsError as error:
            self._end(Answer((), str(error)))
        else:
            self._exchange = exchange
            self._again_us, self._give_up_us = now_us + REPEAT_US, now_us + exchange.patience_us
            if not exchange.waits:
                exchange.send(now_us)

    def _end(self, answer: Answer) -> None:
        self._script = self._exchange = None
        self._answer = answer
