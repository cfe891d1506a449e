"""Queues and semaphores, as in FreeRTOS's queue.c; semaphores are queues whose items nobody looks at.

A call answers FAILED, DONE, SWITCH (done, and a task of higher priority may run), or WAITS: then the task gives up the
processor and makes the call AGAIN. Values below 0 are errors.
"""

from firmware_py.rtos.compiled import compiled
from firmware_py.rtos.lists import first_of
from firmware_py.rtos.memory import (
    AGAIN,
    DONE,
    FAILED,
    FOR_INTERRUPTS,
    FOR_TASKS,
    IN_INTERRUPT,
    IN_TASK,
    ISR,
    MAY_NOT_WAIT,
    NOBODY,
    Q_RECV,
    Q_RECV_BLOCK,
    Q_RECV_FAIL,
    Q_SEND,
    Q_SEND_BLOCK,
    Q_SEND_FAIL,
    Q_SEND_ISR,
    Q_SEND_ISR_FAIL,
    RECEIVERS,
    SENDERS,
    TASKS,
    KernelMemory,
)
from firmware_py.rtos.ready import begin_wait, block, counted, interrupted, record, wake, wake_first


@compiled
def add_object(k: KernelMemory, length: int, count: int) -> int:
    """Make a queue, semaphore or mutex; return its number."""
    made = k.objects
    k.objects = made + 1
    k.length[made] = length
    k.count[made] = count
    k.holder[made] = NOBODY
    return made


@compiled
def put(k: KernelMemory, queue: int) -> None:
    """Append an item."""
    k.count[queue] += 1
    if k.count[queue] > k.high_water[queue]:
        k.high_water[queue] = k.count[queue]


@compiled
def send(k: KernelMemory, queue: int, timeout: int) -> int:
    """Let the running task append an item."""
    if timeout != AGAIN:
        if k.context == IN_INTERRUPT:
            return FOR_TASKS
        if timeout != 0 and k.suspended > 0:
            return MAY_NOT_WAIT
    if k.count[queue] >= k.length[queue]:
        waiting = begin_wait(k, timeout)
        if waiting == FAILED:
            record(k, Q_SEND_FAIL, k.current, queue, 0)
            k.dropped[queue] += 1
            return counted(k, FAILED)
        record(k, Q_SEND_BLOCK, k.current, queue, 0)
        return block(k, SENDERS + queue, k.deadline_tick[k.current])
    record(k, Q_SEND, k.current, queue, k.count[queue])
    put(k, queue)
    return wake_first(k, RECEIVERS + queue)


@compiled
def send_from_isr(k: KernelMemory, queue: int) -> int:
    """Let an interrupt append an item."""
    if k.context == IN_TASK:
        return FOR_INTERRUPTS
    if k.count[queue] >= k.length[queue]:
        record(k, Q_SEND_ISR_FAIL, ISR, queue, 0)
        k.dropped[queue] += 1
        interrupted(k, False)
        return FAILED
    record(k, Q_SEND_ISR, ISR, queue, k.count[queue])
    put(k, queue)
    woken = False
    if k.size[RECEIVERS + queue] > 0:
        woken = wake(k, first_of(k, RECEIVERS + queue) - TASKS)
    interrupted(k, woken)
    return DONE


@compiled
def receive(k: KernelMemory, queue: int, timeout: int) -> int:
    """Let the running task take the oldest item."""
    if timeout != AGAIN and timeout != 0 and k.suspended > 0:
        return MAY_NOT_WAIT
    if k.count[queue] == 0:
        waiting = begin_wait(k, timeout)
        if waiting == FAILED:
            record(k, Q_RECV_FAIL, k.current, queue, 0)
            return counted(k, FAILED)
        record(k, Q_RECV_BLOCK, k.current, queue, 0)
        return block(k, RECEIVERS + queue, k.deadline_tick[k.current])
    if timeout != AGAIN:
        answer = counted(k, DONE)
        if answer != DONE:
            return answer
    record(k, Q_RECV, k.current, queue, k.count[queue])
    k.count[queue] -= 1
    return wake_first(k, SENDERS + queue)


@compiled
def reset(k: KernelMemory, queue: int) -> int:
    """Empty a queue."""
    if k.context == IN_INTERRUPT:
        return FOR_TASKS
    answer = counted(k, DONE)
    if answer != DONE:
        return answer
    k.count[queue] = 0
    return wake_first(k, SENDERS + queue)


@compiled
def wait_for_item(k: KernelMemory, queue: int, wake_tick: int) -> int:
    """Block the running task until an item comes or, unless negative, a tick; for the timer service."""
    if k.suspended > 0:
        return MAY_NOT_WAIT
    return block(k, RECEIVERS + queue, wake_tick)
