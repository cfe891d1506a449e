"""Notifications, work, delays, suspension and priorities; the calls answer as those of queues do."""

from firmware_py.rtos.compiled import compiled
from firmware_py.rtos.lists import first_of, remove
from firmware_py.rtos.memory import (
    DELAY,
    DELAY_UNTIL,
    DONE,
    FOR_INTERRUPTS,
    IN_TASK,
    MAX_PRIORITIES,
    MAY_NOT_WAIT,
    NO_LIST,
    NOT_SUSPENDED,
    NOTIFY,
    NOTIFY_ISR,
    NTAKE,
    NTAKE_BLOCK,
    PENDING,
    PRIO_SET,
    SUSPENDED,
    SWITCH,
    TASK_RESUME,
    TASK_SUSPEND,
    TASKS,
    TICK_US,
    WAITS,
    KernelMemory,
)
from firmware_py.rtos.ready import (
    block,
    change_priority,
    counted,
    interrupted,
    record,
    switch_if,
    tick_at,
    unblock,
    wake,
)


@compiled
def notify(k: KernelMemory, task: int) -> int:
    """Add one to a task's notification value and wake it if it waits for that."""
    record(k, NOTIFY, task, 0, 2)
    answer = counted(k, DONE)
    k.notification[task] += 1
    if answer == DONE and k.notify_waiting[task] > 0:
        k.notify_waiting[task] = 0
        unblock(k, task)
        return switch_if(k, k.priority[task] > k.priority[k.current])
    return answer


@compiled
def notify_from_isr(k: KernelMemory, task: int) -> int:
    """Do the same from an interrupt."""
    if k.context == IN_TASK:
        return FOR_INTERRUPTS
    record(k, NOTIFY_ISR, task, 0, 0)
    k.notification[task] += 1
    woken = False
    if k.notify_waiting[task] > 0:
        k.notify_waiting[task] = 0
        woken = wake(k, task)
    interrupted(k, woken)
    return DONE


@compiled
def await_notification(k: KernelMemory, timeout: int) -> int:
    """Let the running task wait for its notification value to be above zero."""
    task = k.current
    if k.notification[task] > 0 or timeout == 0:
        return counted(k, DONE)
    if k.suspended > 0:
        return MAY_NOT_WAIT
    k.notify_waiting[task] = 1
    answer = block(k, NO_LIST, timeout if timeout < 0 else k.tick_count + timeout)
    record(k, NTAKE_BLOCK, task, 0, 0)
    return answer


@compiled
def take_notification(k: KernelMemory, clear: int) -> int:
    """Return the running task's notification value; set it to zero or lower it by one."""
    task = k.current
    record(k, NTAKE, task, 0, 0)
    k.notify_waiting[task] = 0
    value = k.notification[task]
    if value > 0:
        k.notification[task] = 0 if clear > 0 else value - 1
    return int(value)


@compiled
def work(k: KernelMemory, duration_us: int) -> int:
    """Let the running task take processor time: at once if nothing can happen meanwhile."""
    if duration_us <= 0:
        return counted(k, DONE)
    end_us = k.now_us + duration_us
    if end_us >= k.next_tick_us or end_us > k.until_us or k.switch_pending > 0:
        k.asked_us = duration_us
        return SWITCH
    k.work_us[k.current] += duration_us
    k.now_us = end_us
    k.calls = 0
    return DONE


@compiled
def sleep_until(k: KernelMemory, wake_tick: int) -> int:
    """Let the running task wait for a tick and nothing else."""
    answer = block(k, NO_LIST, wake_tick)
    return SWITCH if answer == WAITS else answer


@compiled
def pending(k: KernelMemory) -> int:
    """Let a task of higher priority run that a plain call woke."""
    return SWITCH if k.switch_pending > 0 and k.suspended == 0 else DONE


@compiled
def delay(k: KernelMemory, ticks: int) -> int:
    """Let the running task wait for some ticks; 0 lets the next one of its priority run."""
    if ticks <= 0:
        return SWITCH
    if k.suspended > 0:
        return MAY_NOT_WAIT
    record(k, DELAY, k.current, ticks, 0)
    return sleep_until(k, k.tick_count + ticks)


@compiled
def delay_until(k: KernelMemory, wake_tick: int) -> int:
    """Let the running task wait for a tick; when that is past, let the next one of its priority run."""
    if k.suspended > 0:
        return MAY_NOT_WAIT
    if wake_tick <= k.tick_count:
        return SWITCH
    record(k, DELAY_UNTIL, k.current, wake_tick, 0)
    return sleep_until(k, wake_tick)


@compiled
def suspend_task(k: KernelMemory, task: int) -> int:
    """Stop a task, whatever it is doing or waiting for."""
    if task == k.current and k.suspended > 0:
        return MAY_NOT_WAIT
    answer = counted(k, DONE)
    if answer != DONE:
        return answer
    record(k, TASK_SUSPEND, task, 0, 0)
    remove(k, task)
    remove(k, TASKS + task)
    k.place[task] = SUSPENDED
    k.notify_waiting[task] = 0
    return SWITCH if task == k.current else DONE


@compiled
def resume_task(k: KernelMemory, task: int) -> int:
    """Resume a suspended task; a task that waits for an object, and is not suspended, keeps waiting."""
    answer = counted(k, DONE)
    if answer != DONE or k.place[task] != SUSPENDED or k.place[TASKS + task] != SUSPENDED:
        return answer
    record(k, TASK_RESUME, task, 0, 0)
    unblock(k, task)
    return switch_if(k, k.priority[task] >= k.priority[k.current])


@compiled
def set_priority(k: KernelMemory, task: int, priority: int) -> int:
    """Change a task's base priority; an inherited priority stays until the mutex is given."""
    answer = counted(k, DONE)
    if answer != DONE:
        return answer
    record(k, PRIO_SET, task, priority, 0)
    old = k.base_priority[task]
    if priority == old:
        return DONE
    outranked = priority > old and priority >= k.priority[k.current]
    if task == k.current:
        outranked = priority < old
    k.base_priority[task] = priority
    k.order[TASKS + task] = MAX_PRIORITIES - priority
    change_priority(k, task, priority if k.priority[task] == old else k.priority[task])
    return switch_if(k, outranked)


@compiled
def suspend_all(k: KernelMemory) -> int:
    """Block task switches and defer ticks."""
    answer = counted(k, DONE)
    if answer == DONE:
        k.suspended += 1
    return answer


@compiled
def resume_all(k: KernelMemory) -> int:
    """End the innermost `suspend_all`; after the outermost, pending events happen now."""
    if k.suspended == 0:
        return NOT_SUSPENDED
    k.suspended -= 1
    if k.suspended > 0:
        return DONE
    while k.size[PENDING] > 0:
        task = first_of(k, PENDING) - TASKS
        remove(k, TASKS + task)
        unblock(k, task)
        if k.priority[task] >= k.priority[k.current]:
            k.switch_pending = 1
    while (k.tick_count + 1) * TICK_US < k.next_tick_us:
        tick_at(k, k.tick_count + 1)
    if k.preemption == 0:
        k.switch_pending = 0
    return SWITCH if k.switch_pending > 0 else DONE
