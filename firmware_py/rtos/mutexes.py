"""Mutexes with priority inheritance, as in FreeRTOS's queue.c; they answer as queues do."""

from firmware_py.rtos.compiled import compiled
from firmware_py.rtos.lists import first_of
from firmware_py.rtos.memory import (
    AGAIN,
    DISINHERIT,
    DONE,
    FAILED,
    FOR_INTERRUPTS,
    HELD_BY_OTHER,
    HELD_BY_WAITER,
    IN_TASK,
    INHERIT,
    ISR,
    MAX_PRIORITIES,
    MAY_NOT_WAIT,
    NOBODY,
    Q_RECV,
    Q_RECV_BLOCK,
    Q_RECV_FAIL,
    Q_SEND,
    Q_SEND_FAIL,
    Q_SEND_ISR_FAIL,
    RECEIVERS,
    TASKS,
    KernelMemory,
)
from firmware_py.rtos.ready import (
    begin_wait,
    block,
    change_priority,
    counted,
    interrupted,
    record,
    switch_if,
    wake_first,
)


@compiled
def lend_priority(k: KernelMemory, holder: int, waiter: int) -> None:
    """Raise the holder of a mutex to the priority of a task that waits for it; note whether it owes it to such a one."""
    priority = k.priority[waiter]
    owes = k.base_priority[holder] < priority
    if k.priority[holder] < priority:
        owes = True
        k.order[TASKS + holder] = MAX_PRIORITIES - priority
        change_priority(k, holder, priority)
        record(k, INHERIT, holder, priority, 0)
    k.lent[waiter] = 1 if owes else 0


@compiled
def disinherit(k: KernelMemory, holder: int, priority: int) -> None:
    """Set the priority of a task that has inherited another."""
    record(k, DISINHERIT, holder, priority, 0)
    k.order[TASKS + holder] = MAX_PRIORITIES - priority
    change_priority(k, holder, priority)


@compiled
def lower_after_timeout(k: KernelMemory, mutex: int) -> int:
    """Take back a timed-out waiter's priority; a holder of several mutexes keeps it until it gives them."""
    holder = k.holder[mutex]
    priority = k.base_priority[holder]
    if k.size[RECEIVERS + mutex] > 0:
        next_priority = MAX_PRIORITIES - k.order[first_of(k, RECEIVERS + mutex)]
        if next_priority > priority:
            priority = next_priority
    if k.priority[holder] == priority or k.mutexes_held[holder] != 1:
        return DONE
    if holder == k.current:
        return HELD_BY_WAITER
    disinherit(k, holder, priority)
    return DONE


@compiled
def take_mutex(k: KernelMemory, mutex: int, timeout: int) -> int:
    """Let the running task become the holder."""
    task, holder = k.current, k.holder[mutex]
    if timeout != AGAIN:
        if timeout != 0 and k.suspended > 0:
            return MAY_NOT_WAIT
        answer = counted(k, DONE)
        if answer != DONE:
            return answer
        k.lent[task] = 0
    if holder == NOBODY:
        record(k, Q_RECV, task, mutex, 1)
        k.holder[mutex] = task
        k.mutexes_held[task] += 1
        return DONE
    waiting = begin_wait(k, timeout)
    if waiting == FAILED:
        if k.lent[task] > 0:
            lowered = lower_after_timeout(k, mutex)
            if lowered != DONE:
                return lowered
        record(k, Q_RECV_FAIL, task, mutex, 0)
        return counted(k, FAILED)
    record(k, Q_RECV_BLOCK, task, mutex, 0)
    lend_priority(k, holder, task)
    return block(k, RECEIVERS + mutex, k.deadline_tick[task])


@compiled
def give_mutex(k: KernelMemory, mutex: int) -> int:
    """Set the mutex free and, with the last one held, return to the task's own priority."""
    task = k.current
    if k.holder[mutex] == NOBODY:
        record(k, Q_SEND_FAIL, task, mutex, 0)
        return counted(k, FAILED)
    if k.holder[mutex] != task:
        return HELD_BY_OTHER
    record(k, Q_SEND, task, mutex, 0)
    k.holder[mutex] = NOBODY
    k.mutexes_held[task] -= 1
    lowered = k.priority[task] != k.base_priority[task] and k.mutexes_held[task] == 0
    if lowered:
        disinherit(k, task, k.base_priority[task])
    if k.size[RECEIVERS + mutex] > 0:
        return wake_first(k, RECEIVERS + mutex)
    return switch_if(k, lowered)


@compiled
def give_mutex_from_isr(k: KernelMemory, mutex: int) -> int:
    """Refuse to set a mutex free from an interrupt."""
    if k.context == IN_TASK:
        return FOR_INTERRUPTS
    if k.holder[mutex] != NOBODY:
        return HELD_BY_OTHER
    record(k, Q_SEND_ISR_FAIL, ISR, mutex, 0)
    interrupted(k, False)
    return FAILED
