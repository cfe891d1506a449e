"""The kernel's memory: tables of tasks and objects, lists of numbers, and the words of its calls.

A task, a queue and a list are numbers, indices of the tables. Lists are rings of items as in FreeRTOS's list.c: task t has
item t, which says where it is (ready, delayed), and item TASKS + t, which says whose event it waits for; behind the items
come the ends of the lists. Task 0 is the caller before the start. Times are microseconds, or ticks where they say so.
"""

from typing import Annotated, Final

from firmware_py.core.subset import AGAIN, DONE, FAILED, SWITCH, WAITS, I64s, Struct, i64

TICK_US: Final = 1000
MAX_PRIORITIES: Final = 7  # the Crazyflie's six, 0 to 5, and one above them for simulated interrupts
TASKS: Final = 2048  # at most, with the caller before the start
OBJECTS: Final = 128  # queues, semaphores and mutexes, at most
# Of the histogram's classes.
LATENCY_BOUNDS_US: Final = (1, 10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)
LATENCY_CLASSES: Final = len(LATENCY_BOUNDS_US) + 1
FRAMES: Final = 32  # native tasks have an index below
FRAME: Final = 16  # numbers: where it goes on, its timeout, an answer, and its locals
ROWS: Final = 1024  # of the trace, during one call

ITEMS: Final = 2 * TASKS
# Lists. Those of ready tasks come first, one for each priority.
DELAYED: Final = MAX_PRIORITIES
PENDING: Final = DELAYED + 1  # woken by interrupts while the scheduler is suspended
SENDERS: Final = PENDING + 1
RECEIVERS: Final = SENDERS + OBJECTS
LISTS: Final = RECEIVERS + OBJECTS
# Where an item is that is in no list. A wait without timeout is a suspension, as in FreeRTOS.
SUSPENDED: Final = -1
DELETED: Final = -2
NO_LIST: Final = -1

# A timeout that never ends, FreeRTOS's portMAX_DELAY; any other timeout is a number of ticks.
FOREVER: Final = -1
NEVER_US: Final = 1 << 62
SLEEP_US: Final = 1 << 50  # the work of the idle task, until any interrupt
# Calls of the kernel, or switches, at one instant after which the running task counts as stuck. The most that a task
# of the firmware needs is 25.
STUCK_CALLS: Final = 10_000

# Whose code runs at the moment: the creator of the tasks before the start, a task, or an interrupt between two runs.
BEFORE_START: Final = 0
IN_TASK: Final = 1
IN_INTERRUPT: Final = 2

# Answers of calls are those of the subset, and errors.
__all__ = ["AGAIN", "DONE", "FAILED", "SWITCH", "WAITS"]
STUCK: Final = -1
MAY_NOT_WAIT: Final = -2
WAITS_IN_INTERRUPT: Final = -3
FOR_INTERRUPTS: Final = -4
FOR_TASKS: Final = -5
NOT_SUSPENDED: Final = -6
HELD_BY_OTHER: Final = -7
HELD_BY_WAITER: Final = -8
ENDED_SUSPENDED: Final = -9
STUCK_SWITCHES: Final = -10
LATE: Final = -11
TRACE_FULL: Final = -12  # no error: the run goes on when the trace has been read

NOBODY: Final = -1
ISR: Final = -1  # in the trace
EVENTS: Final = (
    "TICK", "IN", "READY", "DELAY", "DELAY_UNTIL", "Q_SEND", "Q_SEND_BLOCK", "Q_SEND_FAIL", "Q_RECV", "Q_RECV_BLOCK",
    "Q_RECV_FAIL", "Q_SEND_ISR", "Q_SEND_ISR_FAIL", "NOTIFY", "NOTIFY_ISR", "NTAKE_BLOCK", "NTAKE", "SUSPEND", "RESUME",
    "PRIO_SET", "INHERIT", "DISINHERIT",
)  # fmt: skip
(
    TICK, IN, READY, DELAY, DELAY_UNTIL, Q_SEND, Q_SEND_BLOCK, Q_SEND_FAIL, Q_RECV, Q_RECV_BLOCK,
    Q_RECV_FAIL, Q_SEND_ISR, Q_SEND_ISR_FAIL, NOTIFY, NOTIFY_ISR, NTAKE_BLOCK, NTAKE, TASK_SUSPEND, TASK_RESUME,
    PRIO_SET, INHERIT, DISINHERIT,
) = range(len(EVENTS))  # fmt: skip


class Beat(Struct):
    """The event of the hardware that repeats most, which a run may take by itself; by the hardware's clock."""

    next_us: i64
    period_us: i64
    now_us: i64  # of the beat that happens
    order: i64  # of the next one among the planned events
    planned: i64  # events so far


class KernelMemory(Struct):
    """Everything that the kernel knows; truths are 0 and 1."""

    # The processor.
    preemption: i64
    now_us: i64
    end_us: i64  # how far the present run goes
    until_us: i64  # how far its present leg goes: beats of the hardware happen between two legs
    next_wake_us: i64  # of the next thing that happens without a new interrupt
    next_tick_us: i64
    tick_count: i64  # up to date while tasks run
    work_end_us: i64  # of the running task, when it has work left
    current: i64  # the running task
    first: i64  # the task that runs first
    idle: i64
    context: i64
    suspended: i64  # how many calls of suspend_all wait for their resume_all
    switch_pending: i64
    interrupts_off: i64
    interrupted: i64
    task_woken: i64  # whether the latest call from an interrupt woke a task above the running one
    idle_yielded: i64
    idle_slept: i64  # since it has yielded
    calls: i64  # of the kernel at this instant
    asked_us: i64  # work that the running task has asked for, until it gives up the processor
    steps: i64  # of tasks since `steps_us`
    steps_us: i64
    tasks: i64
    objects: i64

    # Lists and their items.
    next: Annotated[I64s, ITEMS + LISTS]
    previous: Annotated[I64s, ITEMS + LISTS]
    order: Annotated[I64s, ITEMS]  # ascending: wake tick, or urgency behind MAX_PRIORITIES
    place: Annotated[I64s, ITEMS]  # the list that holds the item
    latest: Annotated[I64s, LISTS]  # item that ran last
    size: Annotated[I64s, LISTS]

    # Tasks.
    priority: Annotated[I64s, TASKS]  # the effective one, after inheritance
    base_priority: Annotated[I64s, TASKS]
    mutexes_held: Annotated[I64s, TASKS]
    deadline_tick: Annotated[I64s, TASKS]  # of the present wait
    lent: Annotated[I64s, TASKS]  # whether the holder of the mutex that it waits for owes it its priority
    notification: Annotated[I64s, TASKS]
    notify_waiting: Annotated[I64s, TASKS]  # it waits for one, or has not run since that wait ended
    work_left_us: Annotated[I64s, TASKS]  # rest of the current work
    work_us: Annotated[I64s, TASKS]  # all work so far, the rest of the current one included
    # An activation lasts from the instant at which the task becomes ready after a wait to its next wait; its response time
    # is that duration, its start latency the part before it first runs.
    released_us: Annotated[I64s, TASKS]
    fresh: Annotated[I64s, TASKS]  # released, and has not run since
    activations: Annotated[I64s, TASKS]
    worst_response_us: Annotated[I64s, TASKS]
    worst_latency_us: Annotated[I64s, TASKS]
    late: Annotated[I64s, TASKS, LATENCY_CLASSES]  # activations that did not run at once, by start latency
    response_limit_us: Annotated[I64s, TASKS]
    limit_misses: Annotated[I64s, TASKS]

    frames: Annotated[I64s, FRAMES, FRAME]  # of native tasks

    # Queues; semaphores are queues of tokens, and mutexes have only their `holder` and waiting receivers.
    length: Annotated[I64s, OBJECTS]
    count: Annotated[I64s, OBJECTS]
    dropped: Annotated[I64s, OBJECTS]  # items that found the queue full
    high_water: Annotated[I64s, OBJECTS]  # the most items that ever waited
    holder: Annotated[I64s, OBJECTS]

    # The trace: instant, event, task, and two numbers.
    tracing: i64
    rows: i64
    trace: Annotated[I64s, ROWS, 5]
