"""Corners of FreeRTOS V10.4.1 that the recorded scenarios do not reach; what is expected follows from its documented rules.

Priorities start at 2: the timer service task has 1.
"""

import pytest

from firmware_py.rtos import FOREVER, Kernel, Statistics
from firmware_py.rtos.errors import KernelError
from support.kernel_tasks import start


@pytest.fixture
def kernel():
    return Kernel()


def run_with(kernel, end_us, *interrupts):
    for instant_us, interrupt in interrupts:
        kernel.run(instant_us - 1)
        kernel.advance(instant_us)
        interrupt()
        kernel.run(instant_us)
    kernel.run(end_us)


def holder_of(kernel, mutexes, work_us):
    def body():
        for mutex in mutexes:
            yield from mutex.take()
        yield from kernel.work(work_us)
        for mutex in mutexes:
            yield from mutex.give()
        yield from kernel.work(100)

    return body


def taker_of(kernel, mutex, asks_tick, timeout):
    def body():
        yield from kernel.delay(asks_tick)
        if (yield from mutex.take(timeout)):
            yield from mutex.give()

    return body


def priority_at(kernel, task, instants_us):
    priorities = []
    for instant_us in instants_us:
        kernel.run(instant_us)
        priorities.append(task.priority)
    return priorities


@pytest.mark.parametrize(
    (
        "count",
        "waiters",
        "instants_us",
        "priorities",
    ),  # a waiter: its priority, when it asks, how long it waits
    [
        (1, ((5, 2, 2), (4, 1, 6)), [500, 1_500, 2_500, 4_500, 7_500], [2, 4, 5, 4, 2]),
        (1, ((4, 1, 2), (4, 2, 4)), [1_500, 2_500, 3_500, 5_500, 6_500], [4, 4, 4, 4, 2]),
        (2, ((5, 1, 2),), [1_500, 3_500, 9_400, 9_550], [5, 5, 5, 2]),
    ],
    ids=["that of the next waiter", "that of equal waiters", "that lent until it gives both mutexes"],
)
def test_a_holder_keeps_a_priority_when_a_waiter_gives_up(kernel, count, waiters, instants_us, priorities):
    mutexes = [kernel.create_mutex(f"mutex {number}") for number in range(count)]
    holder = kernel.create_task("holder", 2, holder_of(kernel, mutexes, 9_500))
    start(
        kernel,
        **{f"waiter {i}": (p, taker_of(kernel, mutexes[0], *when)) for i, (p, *when) in enumerate(waiters)},
    )
    assert priority_at(kernel, holder, instants_us) == priorities


def test_a_holder_is_not_lowered_below_its_own_priority_by_a_waiter_that_is_less_urgent(kernel):
    mutex = kernel.create_mutex("mutex")

    def body():
        yield from mutex.take()
        yield from kernel.delay(9)
        yield from mutex.give()

    holder = kernel.create_task("holder", 3, body)
    start(kernel, low=(2, taker_of(kernel, mutex, 1, FOREVER)), high=(5, taker_of(kernel, mutex, 2, 2)))
    assert priority_at(kernel, holder, [1_500, 2_500, 4_500]) == [3, 5, 3]


def test_a_priority_set_while_one_is_lent_counts_when_the_mutex_is_given(kernel):
    mutex = kernel.create_mutex("mutex")
    holder = kernel.create_task("holder", 2, holder_of(kernel, [mutex], 4_500))
    kernel.create_task("high", 5, taker_of(kernel, mutex, 1, FOREVER))

    def boss():
        yield from kernel.delay(2)
        yield from holder.priority_set(3)

    start(kernel, boss=(6, boss))
    assert priority_at(kernel, holder, [1_500, 2_500, 4_550]) == [5, 5, 3]


@pytest.mark.parametrize("how", ["set", "lent and returned"])
def test_waiters_are_ordered_by_their_present_priority(kernel, how):
    queue = kernel.create_queue(2, "queue")
    mutex = kernel.create_mutex("mutex")
    served = []

    def receiver(name):
        yield from kernel.delay(5)
        served.append((name, (yield from queue.receive())))

    def changed():
        yield from mutex.take()
        yield from kernel.work(2_000)
        yield from mutex.give()
        yield from receiver("changed")

    changed_task = kernel.create_task("changed", 2, changed)
    kernel.create_task("other", 3, receiver, "other")
    kernel.create_task("lender", 5, taker_of(kernel, mutex, 1, FOREVER))

    def boss():
        yield from kernel.delay(3)
        if how == "set":
            yield from changed_task.priority_set(4)
        yield from kernel.delay(10)
        yield from queue.send("first")
        yield from kernel.delay(1)
        yield from queue.send("second")

    start(kernel, boss=(6, boss))
    kernel.run(20_000)
    order = ["changed", "other"] if how == "set" else ["other", "changed"]
    assert served == list(zip(order, ["first", "second"], strict=True))


def test_a_notification_does_not_wake_a_task_that_was_suspended_while_it_waited_for_it(kernel):
    got = []

    def waiter():
        got.append(((yield from kernel.notify_take(False, 5)), kernel.now_us))

    waiter_task = kernel.create_task("waiter", 3, waiter)

    def boss():
        yield from waiter_task.suspend()
        yield from waiter_task.notify()
        yield from waiter_task.notify()
        yield from kernel.delay(8)
        yield from waiter_task.resume()

    start(kernel, boss=(2, boss))
    kernel.run(20_000)
    assert got == [(2, 8_000)]


def test_resume_does_not_disturb_a_task_that_waits():
    events = []
    kernel = Kernel(trace=lambda us, event, who, a, b: events.append((us, event, who)))
    queue = kernel.create_queue(1, "queue")

    def receiver():
        yield from queue.receive()

    receiver_task = kernel.create_task("receiver", 3, receiver)

    def boss():
        yield from receiver_task.resume()
        yield from kernel.delay(2)
        yield from queue.send("item")

    start(kernel, boss=(2, boss))
    kernel.run(5_000)
    assert [event[:2] for event in events if event[2] == "receiver"] == [
        (0, "READY"),
        (0, "IN"),
        (0, "Q_RECV_BLOCK"),
        (2_000, "READY"),
        (2_000, "IN"),
        (2_000, "Q_RECV"),
    ]


def test_a_task_suspended_while_it_waits_goes_on_waiting_for_the_rest_of_its_time(kernel):
    queue = kernel.create_queue(1, "queue")
    ended_us = []

    def receiver(timeout):
        yield from queue.receive(timeout)
        ended_us.append(kernel.now_us)

    receivers = [kernel.create_task(f"timeout {timeout}", 3, receiver, timeout) for timeout in (3, 9)]

    def boss():
        yield from kernel.delay(1)
        for task in receivers:
            yield from task.suspend()
        yield from kernel.delay(4)
        for task in receivers:
            yield from task.resume()

    start(kernel, boss=(4, boss))
    kernel.run(20_000)
    assert ended_us == [5_000, 9_000]


def test_without_preemption_a_yield_while_the_scheduler_is_suspended_is_lost():
    kernel = Kernel(preemption=False)
    order = []

    def first():
        kernel.suspend_all()
        yield from kernel.task_yield()
        yield from kernel.resume_all()
        order.append("first")

    def second():
        order.append("second")
        yield from ()

    start(kernel, second=(2, second), first=(2, first))
    kernel.run(0)
    assert order == ["first", "second"]


def test_a_task_of_equal_priority_that_woke_meanwhile_runs_when_the_scheduler_resumes(kernel):
    semaphore = kernel.create_binary_semaphore("semaphore")
    order = []

    def first():
        kernel.suspend_all()
        yield from kernel.work(500)
        yield from kernel.resume_all()
        order.append("first")

    def second():
        yield from semaphore.take()
        order.append("second")

    start(kernel, first=(2, first), second=(2, second))
    run_with(kernel, 600, (300, semaphore.give_from_isr))
    assert order == ["second", "first"]


def test_a_tick_that_is_due_while_the_scheduler_is_suspended_does_not_stop_the_clock(kernel):
    def sleeper():
        yield from kernel.delay(1)

    def worker():
        kernel.suspend_all()
        yield from kernel.work(3_000)
        yield from kernel.resume_all()

    start(kernel, sleeper=(3, sleeper), worker=(2, worker))
    kernel.run(100)
    assert kernel.next_wake_us == 3_000


def test_a_slice_ends_at_a_tick_and_not_at_the_interrupt_that_makes_another_task_ready(kernel):
    semaphore = kernel.create_binary_semaphore("semaphore")
    woke_us = []

    def worker():
        yield from kernel.work(9_000)

    def other():
        yield from semaphore.take()
        woke_us.append(kernel.now_us)

    start(kernel, worker=(2, worker), other=(2, other))
    run_with(kernel, 5_000, (3_500, semaphore.give_from_isr))
    assert woke_us == [4_000]


def test_the_start_latency_ends_at_the_first_switch_to_the_task(kernel):
    semaphore = kernel.create_binary_semaphore("semaphore")

    def low():
        yield from kernel.work(1_000)

    def high():
        yield from semaphore.take()
        yield from kernel.work(200)

    kernel.create_task("low", 2, low)
    kernel.create_task("high", 3, high)
    statistics = Statistics(kernel, {})
    kernel.start()
    run_with(kernel, 5_000, (500, semaphore.give_from_isr))
    assert [report.worst_latency_us for report in statistics.reports()] == [0, 0]


def test_notifying_a_ready_task_does_not_restart_its_activation(kernel):
    """Its wait ends at 1 ms, the notification comes at 2 ms, it runs at 3 ms."""

    def low():
        yield from kernel.notify_take(True, 1)

    low_task = kernel.create_task("low", 2, low)

    def high():
        yield from kernel.delay(1)
        yield from kernel.work(1_000)
        yield from low_task.notify()
        yield from kernel.work(1_000)

    kernel.create_task("high", 3, high)
    statistics = Statistics(kernel, {})
    kernel.start()
    kernel.run(5_000)
    assert statistics.reports()[0].worst_latency_us == 2_000


def test_a_kernel_has_2047_tasks_and_refuses_the_next(kernel):
    while len(kernel.names) < 2048:  # with the caller before the start
        kernel.create_task("many", 2, holder_of(kernel, (), 0))
    with pytest.raises(KernelError, match="there are 2047 tasks, which is the most"):
        kernel.create_task("one more", 2, holder_of(kernel, (), 0))
