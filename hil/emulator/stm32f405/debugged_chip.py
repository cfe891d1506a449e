"""A chip that runs as its debugger wants, forward and, with checkpoints, backwards."""

from collections.abc import Callable
from typing import Any

from hil.emulator.stm32f405.backwards import PERIOD, Goal, Position, Search, access_of, position_of
from hil.emulator.stm32f405.chip import Chip, StopReason
from hil.emulator.stm32f405.freertos import FreeRtos
from hil.emulator.stm32f405.gdb import GdbServer
from hil.emulator.stm32f405.gdb_protocol import BACK, SIGABRT, SIGINT, SIGTRAP, ResumeRequest

CRASH = StopReason.LOCKUP | StopReason.WATCHDOG


class DebuggedChip:
    """Runs a chip under its debugger; waits for one first."""

    def __init__(
        self,
        chip: Chip,
        server: GdbServer,
        kernel: FreeRtos | None = None,
        booted_us: Callable[[], int] = lambda: 0,
    ) -> None:
        """`booted_us` returns the chip's time at which the laboratory's begins, 0 before it does."""
        server.attach(chip, kernel)
        self._chip, self._server, self._booted_us = chip, server, booted_us
        self._request = ResumeRequest.STOP
        self._search: Search | None = None  # on the way forward from a checkpoint
        self._woken_at: Position | None = None  # that checkpoint
        self._held: tuple[int, ...] = ()  # where the debugger has stopped last
        self._trail: list[Position] = []  # the instants just before this one
        self._near: tuple[Position, Any] | None = (
            None  # an earlier instant of this run, and the chip's state then
        )

    def run(self, until_cycles: int) -> int:
        """Run up to a time, or until the caller must act, like `Chip.run`.

        Raises `KeyboardInterrupt` when the debugger ends it.
        """
        if self._request is ResumeRequest.STOP and not self._is_time():
            return self._chip.run(until_cycles)
        if self._request is ResumeRequest.STOP or self._server.wants_to_stop():
            self._search = None
            self._hold(SIGINT)
        self._take_checkpoint()
        self._near = None
        if self._search is not None and self._search.slow_from <= until_cycles:
            self._near = position_of(self._chip), self._chip.save()
        seen: int = StopReason.TIME
        state = self._chip.state
        while True:
            self._arrive()
            # The caller acts between two blocks, as without a debugger: never inside one, where `resume` is the pc.
            until = int(state.now) if seen else until_cycles
            reason, stopped = self._advance(until)
            seen |= reason
            pc = self._chip.register("pc")
            if reason & StopReason.BREAK:  # of a conditional instruction: at the end of its block
                crashed = pc in self._chip.crash_points
                stopped |= pc in self._chip.breakpoints or not crashed
                seen &= seen if crashed else ~StopReason.BREAK
            accessed, seen = seen & StopReason.WATCHPOINT, seen & ~StopReason.WATCHPOINT
            if self._search is not None:
                self._note(self._search, stopped, bool(accessed))
            elif accessed:
                self._hold(SIGTRAP, state.watch_address)
            elif stopped:
                self._hold(SIGTRAP)
            elif self._crashes(seen, pc):
                self._hold(SIGABRT)
            if seen & StopReason.BREAK or (state.resume != state.pc and (seen or state.now >= until_cycles)):
                return seen

    def _is_time(self) -> bool:
        """Return whether the debugger's part of the flight has begun."""
        from_us, booted_us = self._server.from_us, self._booted_us()
        return from_us <= 0 or bool(booted_us and self._chip.now_us >= booted_us + from_us)

    def _advance(self, until: int) -> tuple[int, bool]:
        """Run, or execute one instruction; return why it ended, and whether that is a stop for the debugger."""
        search, chip = self._search, self._chip
        if search is None:
            steps = self._request is ResumeRequest.STEP
        else:
            steps = chip.state.now >= search.slow_from
            until = until if steps else min(until, search.slow_from)
        if not steps:
            return chip.run(until), False
        if search is not None:
            search.pass_by(position_of(chip))
        reason = chip.step(until)
        pc = chip.register("pc")
        if pc in chip.crash_points:
            chip.state.skip_at = 0  # the next run reports the crash
        stopped = bool(reason & StopReason.STEP)
        if search is not None:
            stopped = stopped and pc in chip.breakpoints
        return reason & ~StopReason.STEP, stopped

    def _crashes(self, seen: int, pc: int) -> bool:
        """Return whether the firmware has just crashed, and the debugger did not stop here already."""
        crashed = seen & CRASH or (seen & StopReason.BREAK and pc in self._chip.crash_points)
        backwards = self._server.is_connected and self._server.checkpoints is not None
        return bool(crashed) and backwards and self._held != position_of(self._chip).order

    def _hold(self, signal: int, watched: int | None = None, at_begin: bool = False) -> None:
        self._request = self._server.hold(signal, watched, at_begin)
        while self._request in BACK:
            near = self._request is ResumeRequest.BACK_STEP and self._step_back()
            if not near:
                self._go_back()
            self._request = self._server.hold(SIGTRAP, at_begin=not near)  # there is nothing before
        if self._request is ResumeRequest.KILL:
            raise KeyboardInterrupt
        self._held, self._trail = position_of(self._chip).order, []
        if self._server.checkpoints is not None and self._server.protocol.take_changes():
            self._near = None
            self._server.checkpoints.clear()  # what follows from a change happens again only from here on

    # Backwards

    def _take_checkpoint(self) -> None:
        """Leave a copy of the flight asleep where one is due; a woken one flies on from here to the end of a search."""
        checkpoints, now = self._server.checkpoints, int(self._chip.state.now)
        if checkpoints is None or not self._server.is_connected:
            return
        here = position_of(self._chip)
        if checkpoints.kept:
            last = checkpoints.kept[-1].cycles
            due = now - last >= PERIOD if self._search is None else self._search.is_due(last, now)
            if not due:
                return
        woken = checkpoints.leave_copy(here, now)
        if woken is not None:
            self._server.protocol.restore(woken["debugger"])
            self._request, self._search = ResumeRequest.RUN, Search.of(woken["search"])
            self._woken_at, self._held, self._trail = here, (), []

    def _step_back(self) -> bool:
        """Go back by an instruction within this run, without a checkpoint; return whether that could be done."""
        here = position_of(self._chip)
        if self._near is None or self._near[0].order >= here.order:
            return False
        _, saved = self._near
        if not self._trail:
            self._chip.restore(saved)
            self._trail = self._passed(here.before, here)
        if not self._trail:
            return False
        *self._trail, before = self._trail
        self._chip.restore(saved)
        self._passed(before.at, before)
        return True

    def _passed(self, slow_from: int, end: Position) -> list[Position]:
        """Run the chip to an instant within this run; return the instants passed by on the last part of the way."""
        chip, passed = self._chip, list[Position]()
        while chip.state.now < slow_from and position_of(chip).order < end.order:
            chip.run(slow_from)
        while (here := position_of(chip)).order < end.order:
            passed.append(here)
            chip.step()
        return passed

    def _go_back(self) -> None:
        """Go back as requested; return only where there is nothing before."""
        here = position_of(self._chip)
        if self._request is ResumeRequest.BACK_STEP:
            if self._trail:
                self._fly_again(Search(Goal.THERE, self._trail[-1], trail=self._trail[:-1]))
            self._fly_again(Search(Goal.STEP, here))
        elif self._server.protocol.has_stops:
            self._fly_again(Search(Goal.STOP, here))
        self._fly_again(Search(Goal.BEGIN, here))

    def _fly_again(self, search: Search) -> None:
        """End this process in favour of a checkpoint before the end of a search; return if there is none."""
        checkpoints = self._server.checkpoints
        assert checkpoints is not None
        message = {"search": search.stored(), "debugger": self._server.protocol.stored()}
        while before := [one for one in checkpoints.kept if search.may_begin(Position(*one.position))]:
            checkpoints.wake(before[0 if search.goal is Goal.BEGIN else -1], message)

    def _note(self, search: Search, stopped: bool, accessed: bool) -> None:
        """Keep a stop that the debugger would have seen."""
        if accessed:
            search.note(access_of(self._chip), int(self._chip.state.watch_address))  # before it
        if stopped:
            search.note(position_of(self._chip))

    def _arrive(self) -> None:
        """Act at the end of a search."""
        search = self._search
        if search is None:
            return
        if search.goal is Goal.BEGIN:
            self._search = None
            self._hold(SIGTRAP, at_begin=True)
        elif search.is_over(position_of(self._chip)):
            self._look_back(search)

    def _look_back(self, search: Search) -> None:
        """Stop at the end of a search, or go back to what it has found or not found."""
        if search.goal is Goal.STEP and search.trail:
            self._fly_again(Search(Goal.THERE, search.trail[-1], trail=search.trail[:-1]))
        if search.goal is Goal.STOP:
            if search.found is not None:
                goal = Goal.THERE if search.watched is None else Goal.AFTER
                self._fly_again(Search(goal, search.found, search.watched))
            assert self._woken_at is not None
            self._fly_again(Search(Goal.STOP, self._woken_at))
            self._fly_again(Search(Goal.BEGIN, search.end))
        self._search, self._trail = None, search.trail
        self._hold(SIGTRAP, search.watched)
