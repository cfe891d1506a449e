"""Native tasks: coroutines of the subset, which run as C or as generators of Python.

    @compiled
    def estimator(k: KernelMemory) -> Steps:
        while True:
            yield from take(k, RUN, FOREVER)
            ...

`yield from` a call of the kernel gives up the processor until the call is done; its value is 1, or 0 for a call that failed.
"""

from collections.abc import Callable, Generator

from firmware_py.rtos import calls, queues
from firmware_py.rtos.memory import AGAIN, FAILED, SWITCH, WAITS, KernelMemory

Steps = Generator[int, None, int | None]


class Awaited:
    """A call of the kernel for `yield from`; where it has a timeout, that is its last argument."""

    def __init__(self, call: Callable[..., int]) -> None:
        self.call = call

    def __call__(self, k: KernelMemory, *numbers: int) -> Generator[int, None, int]:
        given = numbers
        while (answer := self.call(k, *given)) == WAITS:
            yield 0
            given = (*given[:-1], AGAIN)
        if answer == SWITCH:
            yield 0
        return int(answer != FAILED)


take = receive = Awaited(queues.receive)
give = send = Awaited(queues.send)
delay = Awaited(calls.delay)
delay_until = Awaited(calls.delay_until)
work = Awaited(calls.work)
yield_if_pending = Awaited(calls.pending)
