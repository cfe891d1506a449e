"""Software timers: a service task runs their callbacks and executes the commands in its queue.

Starting, stopping or resetting a timer sends a command; it takes effect when the service task gets to it. The tick of
the command counts, not the tick of its execution.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Generator
from dataclasses import dataclass

from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.memory import FOREVER
from firmware_py.rtos.processor import Processor
from firmware_py.rtos.queue import Queue

RELOAD, START, RESET, STOP, CHANGE_PERIOD = range(5)  # FreeRTOS's command numbers
COMMAND_QUEUE_LENGTH = 20  # crazyflie-firmware, FreeRTOSConfig.h
SERVICE_PRIORITY = 1  # the same

Callback = Callable[["Timer"], Generator[int, None, object]]


class Timer:
    """Calls `callback(timer)`, a generator function that must not block, `period_ticks` after its start.

    Made by `Kernel.create_timer`, dormant at first. The commands wait up to `timeout` ticks for space in the queue of
    the service task and are False when there was none.
    """

    def __init__(
        self, service: TimerService, name: str, period_ticks: int, autoreload: bool, callback: Callback
    ) -> None:
        _check_period(name, period_ticks)
        self._service = service
        self.name = name
        self.period_ticks = period_ticks
        self.autoreload = autoreload
        self.callback = callback
        self.expiry_tick = 0
        self.active = False  # whether the service task waits for it

    def start(self, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Expire one period from now, also when it was running already."""
        return self._service.send(START, self, self._service.kernel.tick_count, timeout)

    def reset(self, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Start the timer again, as `start` does."""
        return self._service.send(RESET, self, self._service.kernel.tick_count, timeout)

    def stop(self, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Make the timer dormant."""
        return self._service.send(STOP, self, 0, timeout)

    def change_period(self, period_ticks: int, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Expire one new period after the service task executes this, also when the timer was dormant."""
        _check_period(self.name, period_ticks)
        return self._service.send(CHANGE_PERIOD, self, period_ticks, timeout)


def _check_period(name: str, period_ticks: int) -> None:
    if period_ticks < 1:
        raise KernelError(f"timer {name}: period {period_ticks} ticks, it must be at least 1")


@dataclass(frozen=True, slots=True)
class _Command:
    number: int
    timer: Timer
    value: int  # the tick at which it was given, or the new period


class TimerService:
    """The timer service task ("Tmr Svc"), its command queue and the running timers in the order of their expiry."""

    def __init__(self, kernel: Processor) -> None:
        self.kernel = kernel
        self.commands: Queue[_Command] = Queue(kernel, COMMAND_QUEUE_LENGTH, "timer commands")
        self._running: list[Timer] = []

    def send(self, number: int, timer: Timer, value: int, timeout: int) -> Generator[int, None, bool]:
        """Queue a command from the running task, without waiting while the scheduler is suspended."""
        if self.kernel.suspended:
            timeout = 0
        sent = yield from self.commands.send(_Command(number, timer, value), timeout)
        self.kernel.record("TMR_CMD", number, int(sent))
        return sent

    def run(self) -> Generator[int, None, None]:
        """Run the service task."""
        while True:
            now = self.kernel.tick_count
            if self._running and self._running[0].expiry_tick <= now:
                yield from self._expire(self._running.pop(0), now)
            else:
                self._wait(now)
                yield 0
            while (command := (yield from self.commands.receive(0))) is not None:
                yield from self._execute(command)

    def _wait(self, now: int) -> None:
        if len(self.commands):
            return
        wake_tick = self._running[0].expiry_tick if self._running else FOREVER
        # FreeRTOS's "for ever" wraps around to the tick before now
        self.kernel.record("DELAY_UNTIL", wake_tick if wake_tick != FOREVER else now - 1)
        self.commands.wait_for_item(wake_tick)

    def _expire(self, timer: Timer, now: int) -> Generator[int, None, None]:
        self._record("TMR_EXPIRED", timer)
        timer.active = False
        if timer.autoreload:
            expired = timer.expiry_tick
            if not self._run_from(timer, expired, now):
                yield from self._reload(timer, expired)
        yield from timer.callback(timer)

    def _execute(self, command: _Command) -> Generator[int, None, None]:
        timer = command.timer
        if timer.active:
            self._running.remove(timer)
            timer.active = False
        self._record("TMR_CMD_RX", timer, command.number, command.value)
        now = self.kernel.tick_count
        if command.number == STOP:
            return
        if command.number == CHANGE_PERIOD:
            timer.period_ticks = command.value
            self._run_from(timer, now, now)
            return
        if self._run_from(timer, command.value, now):
            return
        yield from timer.callback(timer)
        self._record("TMR_EXPIRED", timer)
        if timer.autoreload:
            yield from self._reload(timer, command.value + timer.period_ticks)

    def _reload(self, timer: Timer, start_tick: int) -> Generator[int, None, None]:
        """Catch up with a period that is over already."""
        if not (yield from self.send(RELOAD, timer, start_tick, 0)):
            raise KernelError(
                f"timer {timer.name}: no place to reload it, {COMMAND_QUEUE_LENGTH} commands are waiting"
            )

    def _run_from(self, timer: Timer, start_tick: int, now: int) -> bool:
        """Run the timer for one period from `start_tick`; False when that is already over."""
        expiry_tick = start_tick + timer.period_ticks
        if expiry_tick <= now:
            return False
        timer.expiry_tick = expiry_tick
        timer.active = True
        insort(self._running, timer, key=lambda running: running.expiry_tick)
        return True

    def _record(self, event: str, timer: Timer, a: int = 0, b: int = 0) -> None:
        if self.kernel.trace is not None:
            self.kernel.trace(self.kernel.now_us, event, timer.name, a, b)
