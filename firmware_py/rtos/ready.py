"""Which tasks are ready, and which wait: FreeRTOS's tasks.c, without the run.

Ready tasks of one priority take turns. Waiting tasks of an object are served by priority, first come first served among
equals; a task that waits with a timeout is in the list of delayed tasks, too.
"""

from firmware_py.rtos.compiled import compiled
from firmware_py.rtos.lists import append, first_of, insert, remove
from firmware_py.rtos.memory import (
    AGAIN,
    DELAYED,
    DONE,
    FAILED,
    IN_INTERRUPT,
    MAX_PRIORITIES,
    NO_LIST,
    PENDING,
    READY,
    ROWS,
    STUCK,
    STUCK_CALLS,
    SWITCH,
    TASKS,
    TICK,
    WAITS,
    WAITS_IN_INTERRUPT,
    KernelMemory,
)


@compiled
def record(k: KernelMemory, event: int, task: int, a: int, b: int) -> None:
    """Trace an event."""
    if k.tracing == 0 or k.rows >= ROWS:
        return
    row = k.rows
    k.trace[row, 0], k.trace[row, 1], k.trace[row, 2] = k.now_us, event, task
    k.trace[row, 3], k.trace[row, 4] = a, b
    k.rows = row + 1


@compiled
def counted(k: KernelMemory, answer: int) -> int:
    """Count a call that returns at once, because a task might make it for ever while no time passes.

    Of two calls that can only follow each other, like giving and taking, the one that takes is counted. Interrupts have no
    calls of this kind: there the first one is one too many.
    """
    k.calls += 1
    return answer if k.calls <= STUCK_CALLS else STUCK


@compiled
def leave_tasks(k: KernelMemory) -> None:
    """Allow interrupts and no calls of tasks from here on."""
    k.context = IN_INTERRUPT
    k.calls = STUCK_CALLS


@compiled
def make_ready(k: KernelMemory, task: int) -> None:
    """Put a task that is in no list behind the other ready ones of its priority."""
    record(k, READY, task, k.priority[task], 0)
    append(k, k.priority[task], task)


@compiled
def unblock(k: KernelMemory, task: int) -> None:
    """Make a task ready wherever it is.

    It may be ready already: a notification can reach a task whose wait timed out and that has not run since.
    """
    place = k.place[task]
    remove(k, task)
    if place < 0 or place >= MAX_PRIORITIES:  # otherwise its activation has begun
        k.released_us[task] = k.now_us
        k.fresh[task] = 1
    make_ready(k, task)


@compiled
def wake(k: KernelMemory, task: int) -> bool:
    """Make a waiting task ready, later if the scheduler is suspended; true when it outranks the running one."""
    remove(k, TASKS + task)
    if k.suspended > 0:
        append(k, PENDING, TASKS + task)
    else:
        unblock(k, task)
    return bool(k.priority[task] > k.priority[k.current])


@compiled
def switch_if(k: KernelMemory, outranked: bool) -> int:
    """Return the answer of a call that made a task ready which may outrank the running one."""
    if outranked and k.preemption > 0:
        k.switch_pending = 1
        return SWITCH
    return DONE


@compiled
def wake_first(k: KernelMemory, waiters: int) -> int:
    """Wake the first task that waits in a list, if one does; return the call's answer."""
    if k.size[waiters] == 0:
        return DONE
    outranked = wake(k, first_of(k, waiters) - TASKS)
    return switch_if(k, outranked)


@compiled
def interrupted(k: KernelMemory, task_woken: bool) -> None:
    """End every call from an interrupt."""
    k.interrupted = 1
    k.task_woken = 1 if task_woken else 0
    if task_woken:
        k.switch_pending = 1


@compiled
def change_priority(k: KernelMemory, task: int, priority: int) -> None:
    """Set the effective priority of a task, which goes behind the others there when it is ready."""
    place = k.place[task]
    ready = place >= 0 and place < MAX_PRIORITIES
    if ready:
        remove(k, task)
    k.priority[task] = priority
    if ready:
        make_ready(k, task)


@compiled
def block(k: KernelMemory, waiters: int, wake_tick: int) -> int:
    """Let the running task wait in a list, if there is one, and unless negative until a tick.

    The caller has checked that it may wait.
    """
    if k.context == IN_INTERRUPT:
        return WAITS_IN_INTERRUPT
    task = k.current
    if waiters != NO_LIST:
        insert(k, waiters, TASKS + task)
    remove(k, task)
    if wake_tick >= 0:
        k.order[task] = wake_tick
        insert(k, DELAYED, task)
    k.activations[task] += 1
    response_us = k.now_us - k.released_us[task]
    if response_us > k.worst_response_us[task]:
        k.worst_response_us[task] = response_us
    if response_us > k.response_limit_us[task]:
        k.limit_misses[task] += 1
    return WAITS


@compiled
def tick_at(k: KernelMemory, tick: int) -> None:
    """Count a tick: it wakes tasks, and ends the time slice of the running one."""
    record(k, TICK, k.current, tick, 0)
    k.tick_count = tick
    priority = k.priority[k.current]
    outranked = k.size[priority] > 1
    while k.size[DELAYED] > 0 and k.order[first_of(k, DELAYED)] <= tick:
        task = first_of(k, DELAYED)
        remove(k, task)
        remove(k, TASKS + task)
        unblock(k, task)
        if k.priority[task] >= priority:
            outranked = True
    if outranked and k.preemption > 0:
        k.switch_pending = 1


@compiled
def begin_wait(k: KernelMemory, timeout: int) -> int:
    """Note when the running task's wait of so many ticks will end; FAILED when it may wait no longer."""
    if timeout != AGAIN:
        k.deadline_tick[k.current] = timeout if timeout < 0 else k.tick_count + timeout
    deadline = k.deadline_tick[k.current]
    return FAILED if deadline >= 0 and deadline <= k.tick_count else WAITS
