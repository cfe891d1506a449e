"""The processor: which task runs, for how long, and when the next thing happens.

Code between two kernel calls takes no time and is atomic; work takes time and can be preempted by ticks and interrupts.
Hardware goes first at equal time. Ticks at which nothing can happen cost nothing, the tick count jumps over them (with a
trace every tick is visited, because the trace shows it).

    task = begin(k, now_us, until_us)       # the task whose code runs next: its caller takes one step of it
    while task > 0:
        task = resume(k, step of the task)  # 0: nothing more is due; below 0: an error
"""

from firmware_py.rtos.compiled import compiled
from firmware_py.rtos.lists import clear_lists, first_of, remove, turn
from firmware_py.rtos.memory import (
    DELAYED,
    DELETED,
    DONE,
    ENDED_SUSPENDED,
    IN,
    IN_TASK,
    LATE,
    LATENCY_BOUNDS_US,
    MAX_PRIORITIES,
    NEVER_US,
    SLEEP_US,
    STUCK_CALLS,
    STUCK_SWITCHES,
    TASKS,
    TICK,
    TICK_US,
    TRACE_FULL,
    KernelMemory,
)
from firmware_py.rtos.ready import leave_tasks, make_ready, record, switch_if, tick_at


@compiled
def pass_ticks(k: KernelMemory) -> None:
    """Take the tick that is due now, if one is; jump over those before at which nothing could happen."""
    tick = k.now_us // TICK_US
    k.next_tick_us = tick * TICK_US + TICK_US
    if k.suspended > 0:
        record(k, TICK, k.current, k.tick_count + 1, 0)
    elif k.now_us == tick * TICK_US:
        tick_at(k, tick)
    else:
        k.tick_count = tick


@compiled
def note_latency(k: KernelMemory, task: int, latency_us: int) -> None:
    """Count an activation that did not run at once."""
    if latency_us > k.worst_latency_us[task]:
        k.worst_latency_us[task] = latency_us
    interval = 0
    for bound_us in LATENCY_BOUNDS_US:
        if latency_us >= bound_us:
            interval += 1
    k.late[task, interval] += 1


@compiled
def switch_task(k: KernelMemory) -> None:
    """Make the next task of the highest priority that has ready ones the running one."""
    k.switch_pending = 0
    priority = MAX_PRIORITIES - 1
    while k.size[priority] == 0:
        priority -= 1
    task = turn(k, priority)
    if task == k.idle and k.size[priority] == 1 and k.preemption > 0:  # no task to yield to: sleeps at once
        k.work_left_us[task] = SLEEP_US
        k.idle_slept = 1
    k.current = task
    record(k, IN, task, priority, 0)
    if k.fresh[task] > 0:
        k.fresh[task] = 0
        if k.now_us > k.released_us[task]:
            note_latency(k, task, k.now_us - k.released_us[task])


@compiled
def step_idle(k: KernelMemory) -> int:
    """Let others of priority 0 run, then sleep until the next interrupt, like the Crazyflie's idle hook."""
    begins = k.idle_yielded == 0 or k.idle_slept > 0
    if begins and (k.preemption == 0 or k.size[0] > 1):
        k.idle_yielded, k.idle_slept = 1, 0
        return 0
    k.idle_yielded = 0
    return SLEEP_US


@compiled
def settle(k: KernelMemory, yielded_us: int) -> None:
    """Take what the running task has yielded: work, or the processor. Switch to another task where that is due."""
    task = k.current
    work_us = yielded_us + k.asked_us
    k.asked_us = 0
    if work_us > 0:
        k.work_left_us[task] = work_us
        k.work_us[task] += work_us
    else:
        k.switch_pending = 1
    if k.switch_pending > 0 and k.suspended == 0:
        switch_task(k)


@compiled
def set_next_wake(k: KernelMemory) -> None:
    """Work out when the running task's work ends or a tick may let another one run."""
    task = k.current
    wake_us = NEVER_US
    if k.tracing > 0 or (k.size[k.priority[task]] > 1 and k.preemption > 0):
        wake_us = k.next_tick_us
    elif k.size[DELAYED] > 0 and k.suspended == 0:
        wake_us = k.order[first_of(k, DELAYED)] * TICK_US
    if task != k.idle:
        k.work_end_us = k.now_us + k.work_left_us[task]
        if k.work_end_us < wake_us:
            wake_us = k.work_end_us
    k.next_wake_us = wake_us


@compiled
def arrive(k: KernelMemory) -> None:
    """Go on to the next instant at which something is due, and let its tasks run."""
    k.now_us = k.next_wake_us
    k.interrupted = 0
    if k.now_us >= k.next_tick_us:
        pass_ticks(k)
    task = k.current
    k.calls, k.steps, k.steps_us, k.context = 0, 0, k.now_us, IN_TASK
    if k.work_left_us[task] > 0:  # every interrupt ends the sleep of the idle task
        k.work_left_us[task] = 0 if task == k.idle else k.work_end_us - k.now_us
    if k.switch_pending > 0 and k.suspended == 0:
        switch_task(k)


@compiled
def count_step(k: KernelMemory) -> bool:
    """Count a step of the running task; false when there were too many at one instant."""
    k.steps += 1
    if k.steps > STUCK_CALLS:
        if k.now_us == k.steps_us:
            return False
        k.steps_us, k.steps = k.now_us, 0
    return True


@compiled
def next_task(k: KernelMemory) -> int:
    """Go on until a task is to take a step, and return it; 0 when nothing more is due until the run ends."""
    while True:
        while k.work_left_us[k.current] == 0 and k.context == IN_TASK:
            going = count_step(k)
            if not going:
                return STUCK_SWITCHES
            if k.current != k.idle:
                return k.current
            yielded_us = step_idle(k)
            settle(k, yielded_us)
        if k.context == IN_TASK:
            leave_tasks(k)
            set_next_wake(k)
            if k.next_wake_us <= k.now_us:
                return LATE
        if k.next_wake_us > k.until_us:
            break
        if k.rows > 0:
            return TRACE_FULL
        arrive(k)
    if k.until_us > k.now_us:
        k.now_us = k.until_us
    return 0


@compiled
def begin(k: KernelMemory, now_us: int, until_us: int) -> int:
    """Do all that is due up to and including an instant, until every task waits or works; then go on until the later one."""
    k.until_us = until_us if until_us > now_us else now_us
    k.end_us = k.until_us
    if k.interrupted > 0 and k.next_wake_us > now_us:
        k.next_wake_us = now_us
    return next_task(k)


@compiled
def resume(k: KernelMemory, yielded_us: int) -> int:
    """Go on after a step of the running task, which has yielded its work, or 0 for the processor; below 0: after a pause."""
    if yielded_us >= 0:
        settle(k, yielded_us)
    return next_task(k)


@compiled
def end_task(k: KernelMemory) -> int:
    """Delete the running task, whose function has returned."""
    if k.suspended > 0:
        return ENDED_SUSPENDED
    remove(k, k.current)
    k.place[k.current] = DELETED
    return DONE


@compiled
def boot(k: KernelMemory, preemption: int) -> None:
    """Set up a processor without tasks; its caller counts as task 0."""
    clear_lists(k)
    k.preemption = preemption
    k.next_tick_us = TICK_US
    k.next_wake_us = NEVER_US
    k.tasks = 1
    k.response_limit_us[0] = NEVER_US


@compiled
def add_task(k: KernelMemory, priority: int) -> int:
    """Make the next task ready; its number is that of the tasks before."""
    task = k.tasks
    k.tasks = task + 1
    k.priority[task] = priority
    k.base_priority[task] = priority
    k.order[TASKS + task] = MAX_PRIORITIES - priority
    k.released_us[task] = k.now_us
    k.fresh[task] = 1
    k.response_limit_us[task] = NEVER_US
    make_ready(k, task)
    if k.current > 0:
        return switch_if(k, priority > k.priority[k.current])
    if k.first == 0 or priority >= k.priority[k.first]:
        k.first = task
    return DONE


@compiled
def start(k: KernelMemory) -> None:
    """Let the tasks begin at the first run."""
    leave_tasks(k)
    k.current = k.first
    k.next_wake_us = k.now_us
    k.fresh[k.current] = 0
    record(k, IN, k.current, k.priority[k.current], 0)
