"""Laws of the scheduler that no FreeRTOS trace shows (`test_rtos_traces.py`): plain calls, errors, statistics."""

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.rtos import FOREVER, Kernel, KernelError, Statistics, StuckTaskError, TaskError
from firmware_py.rtos.scheduler import STUCK_CALLS
from firmware_py.rtos.statistics import LATENCY_BOUNDS_US, ProcessorLoad
from firmware_py.rtos.timer import COMMAND_QUEUE_LENGTH
from support.kernel_tasks import start


def run_until(kernel, end_us, interrupts=()):
    """The harness's loop: hardware first. `interrupts` are (instant, call), in any order."""
    for instant_us, interrupt in sorted(interrupts, key=lambda pair: pair[0]):
        while kernel.next_wake_us is not None and kernel.next_wake_us < instant_us:
            kernel.run(kernel.next_wake_us)
        kernel.advance(instant_us)
        interrupt()
        kernel.run(instant_us)
    kernel.run(end_us)


INSTANTS_US = st.lists(st.integers(0, 20_000), max_size=30)


@pytest.mark.long
@given(
    length=st.integers(1, 5),
    from_isr=INSTANTS_US,
    period=st.integers(1, 4),
    timeout=st.integers(0, 3),
    work_us=st.integers(0, 9_000),
)
def test_a_queue_never_exceeds_its_length_and_counts_its_losses(length, from_isr, period, timeout, work_us):
    kernel = Kernel()
    queue = kernel.create_queue(length, "queue")
    sent, received, waiting = [], [], []

    def send_from_isr(number):
        sent.append(number)
        queue.send_from_isr(number)
        waiting.append(len(queue))

    def sender():
        for number in range(1_000, 1_008):
            yield from kernel.delay(period)
            sent.append(number)
            yield from queue.send(number, timeout)
            waiting.append(len(queue))

    def receiver():
        while True:
            received.append((yield from queue.receive()))
            yield from kernel.work(work_us)

    start(kernel, receiver=(1, receiver), sender=(2, sender))
    run_until(kernel, 500_000, [(us, lambda n=n: send_from_isr(n)) for n, us in enumerate(sorted(from_isr))])
    assert max(waiting) <= queue.high_water <= length
    assert len(queue) == 0
    assert len(received) + queue.dropped == len(sent)
    for source in (range(1_000), range(1_000, 2_000)):
        numbers = [number for number in received if number in source]
        assert numbers == sorted(numbers)


def test_nothing_falls_due_while_all_tasks_wait_for_interrupts():
    kernel = Kernel()
    semaphore = kernel.create_binary_semaphore("semaphore")

    def taker():
        yield from semaphore.take()
        yield from kernel.delay(3)

    start(kernel, taker=(1, taker))
    kernel.run(0)
    assert kernel.next_wake_us is None
    kernel.run(1_234_567)
    semaphore.give_from_isr()
    kernel.run(1_234_567)
    assert kernel.tick_count == 1_234
    assert kernel.next_wake_us == 1_237_000


def test_a_task_of_priority_0_runs_at_the_interrupt_that_wakes_it():
    """Also after it shared its priority with the idle task, which is then somewhere inside its loop."""
    kernel = Kernel()
    semaphore = kernel.create_binary_semaphore("semaphore")
    woke_us = []

    def background():
        while True:
            yield from semaphore.take()
            woke_us.append(kernel.now_us)
            yield from kernel.work(2_500)

    start(kernel, background=(0, background))
    instants_us = [300, 20_300, 40_300, 60_300, 80_300]
    run_until(kernel, 100_000, [(us, semaphore.give_from_isr) for us in instants_us])
    assert woke_us == instants_us


@pytest.mark.parametrize("before_us", [2_999, 3_000, 3_001])
def test_a_run_that_is_stopped_before_an_instant_does_what_is_due_before_it_and_no_more(before_us):
    kernel, ran = Kernel(), []

    def task():
        while True:
            yield from kernel.delay(1)
            ran.append(kernel.now_us)
            kernel.stop_before(before_us)

    start(kernel, task=(1, task))
    kernel.run(0, 10_000)
    assert (ran, kernel.now_us) == ([us for us in (1_000, 2_000, 3_000) if us < before_us], before_us - 1)


def test_an_interrupt_at_the_instant_at_which_work_ends_comes_first():
    kernel = Kernel()
    semaphore = kernel.create_binary_semaphore("semaphore")
    order = []

    def low():
        yield from kernel.work(700)
        order.append("work ends")

    def high():
        yield from semaphore.take()
        order.append("interrupt")

    start(kernel, low=(1, low), high=(2, high))
    run_until(kernel, 700, [(700, semaphore.give_from_isr)])
    assert order == ["interrupt", "work ends"]


@pytest.mark.parametrize("priority", [1, 3])
def test_a_reset_queue_is_empty_and_lets_the_sender_that_waited_longest_go_on(priority):
    kernel = Kernel(preemption=True)
    queue = kernel.create_queue(2, "queue")
    order = []

    def sender(number):
        yield from kernel.delay(1 + number)
        yield from queue.send(f"waiting {number}")
        order.append(f"sent {number}")

    def resetter():
        queue.send_nowait("old")
        queue.send_nowait("older")
        yield from kernel.delay(10)
        yield from queue.reset()
        order.append("reset")

    kernel.create_task("resetter", 2, resetter)
    for number in range(3):
        kernel.create_task(f"sender {number}", priority, sender, number)
    kernel.start()
    kernel.run(12_000)
    # like xQueueReset, it wakes one of the three; an urgent one goes on before the call returns
    assert order == (["reset", "sent 0"] if priority == 1 else ["sent 0", "reset"])
    assert len(queue) == 1


def test_a_plain_receive_lets_a_more_urgent_sender_go_on_when_the_receiver_gives_way():
    kernel = Kernel()
    queue = kernel.create_queue(1, "queue")
    order = []

    def receiver():
        order.append(queue.receive_nowait())
        order.append("goes on")
        yield from kernel.work(10)
        order.append(queue.receive_nowait())
        order.append(queue.receive_nowait())

    def sender():
        yield from queue.send(1)
        yield from queue.send(2)
        order.append("sent")

    start(kernel, receiver=(1, receiver), sender=(2, sender))
    kernel.run(20)
    assert order == [1, "goes on", "sent", 2, None]


def test_a_task_that_raises_is_named_with_the_time_and_the_others_can_go_on():
    kernel = Kernel()
    ticks = []

    def careless():
        yield from kernel.delay(2)
        yield from kernel.work(345)
        raise ValueError("no such gain")

    def careful():
        while True:
            yield from kernel.delay(1)
            ticks.append(kernel.tick_count)

    start(kernel, careless=(1, careless), careful=(2, careful))
    with pytest.raises(TaskError, match=r"task careless at 2\.345 ms: ValueError: no such gain") as caught:
        kernel.run(10_000)
    assert isinstance(caught.value.__cause__, ValueError)
    assert (caught.value.task, caught.value.time_us) == ("careless", 2_345)
    kernel.run(10_000)
    assert ticks == list(range(1, 11))


# What a task can do for ever while no time passes: calls that fail, that change nothing, that undo each other.
LOOPS = {
    "task_yield": lambda o: (o.kernel.task_yield(),),
    "delay(0)": lambda o: (o.kernel.delay(0),),
    "delay_until now": lambda o: (o.kernel.delay_until(o.kernel.tick_count),),
    "work(0)": lambda o: (o.kernel.work(0),),
    "receive from an empty queue": lambda o: (o.queue.receive(0),),
    "send into a full queue": lambda o: (o.queue.send("item", 0),),
    "send and receive": lambda o: (o.queue.send("item"), o.queue.receive()),
    "send and receive without waiting": lambda o: (
        o.queue.send_nowait("item"),
        o.queue.receive_nowait() and (),
    ),
    "reset": lambda o: (o.queue.reset(),),
    "take what was not given": lambda o: (o.semaphore.take(0),),
    "give what was not taken": lambda o: (o.semaphore.give(),),
    "give what was not taken without waiting": lambda o: (o.semaphore.give_nowait(),),
    "give and take": lambda o: (o.semaphore.give(), o.semaphore.take()),
    "take and give a mutex": lambda o: (o.mutex.take(), o.mutex.give()),
    "give a free mutex": lambda o: (o.mutex.give(),),
    "notify": lambda o: (o.kernel.current.notify(),),
    "notify_take": lambda o: (o.kernel.notify_take(True, 0),),
    "notify and notify_take": lambda o: (o.kernel.current.notify(), o.kernel.notify_take(True, 5)),
    "suspend another": lambda o: (o.other.suspend(),),
    "resume another": lambda o: (o.other.resume(),),
    "suspend and resume another": lambda o: (o.other.suspend(), o.other.resume()),
    "priority_set": lambda o: (o.kernel.current.priority_set(2),),
    "suspend_all": lambda o: (o.kernel.suspend_all() or (),),
    "suspend_all and resume_all": lambda o: (o.kernel.suspend_all() or (), o.kernel.resume_all()),
    "timer commands": lambda o: (o.timer.start(0), o.timer.stop(0)),
}


@pytest.mark.long
@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("loop", LOOPS)
def test_a_task_that_never_lets_time_pass_is_named(loop, traced):
    lines = []
    kernel = Kernel(trace=(lambda *line: lines.append(line)) if traced else None)

    def body():
        yield from kernel.delay(1)
        while True:
            for call in LOOPS[loop](objects):
                yield from call

    kernel.create_task("spinner", 2, body)
    objects = SimpleNamespace(
        kernel=kernel,
        queue=kernel.create_queue(1, "queue"),
        semaphore=kernel.create_binary_semaphore("semaphore"),
        mutex=kernel.create_mutex("mutex"),
        timer=kernel.create_timer("timer", 1, False, lambda timer: iter(())),
        other=kernel.create_task("other", 1, sleeper, kernel),
    )
    kernel.start()
    with pytest.raises(StuckTaskError, match=rf"task spinner at 1\.000 ms: {STUCK_CALLS} .* at one instant"):
        kernel.run(5_000)
    assert len(lines) < 10 * STUCK_CALLS


def sleeper(kernel):
    yield from kernel.delay(1_000)


def test_a_wait_for_an_instant_that_has_passed_is_named():
    kernel = Kernel()

    def body():
        yield from kernel.delay(3)
        kernel.block(None, kernel.tick_count)  # what no call of the kernel does: each checks that it may wait
        yield 0

    start(kernel, late=(1, body))
    with pytest.raises(
        StuckTaskError, match=r"task late at 3\.000 ms: waits for 3\.000 ms, which has passed"
    ):
        kernel.run(10_000)


def test_two_tasks_that_hand_each_other_the_processor_for_ever_are_stuck():
    kernel = Kernel()
    ping, pong = kernel.create_binary_semaphore("ping"), kernel.create_binary_semaphore("pong")

    def player(own, other):
        while True:
            yield from other.give()
            yield from own.take()

    start(kernel, a=(2, player, ping, pong), b=(2, player, pong, ping))
    with pytest.raises(StuckTaskError, match=f"{STUCK_CALLS} switches at one instant"):
        kernel.run(0)


def test_tasks_that_each_end_at_once_end_at_one_instant_however_many_they_are():
    kernel = Kernel()
    ended = []

    def body(number):
        ended.append(number)
        yield from ()

    for number in range(2_000):
        kernel.create_task(f"task {number}", 1, body, number)
    kernel.start()
    kernel.run(0)
    assert sorted(ended) == list(range(2_000))


def wrong_yield(kernel):
    yield kernel.create_queue(1, "queue").receive()


def in_suspend_all(call):
    """A task that does `call(kernel)` while the scheduler is suspended."""

    def body(kernel):
        kernel.suspend_all()
        yield from call(kernel)

    return body


def doing(call):
    def body(kernel):
        yield from call(kernel)

    return body


def give_a_mutex_of_another(kernel):
    mutex = kernel.create_mutex("lock")

    def other():
        yield from mutex.take()

    kernel.create_task("other", 2, other)
    yield from kernel.task_yield()
    yield from mutex.give()


def given(semaphore):
    for _ in semaphore.give():
        pass
    return semaphore


NO_WAIT = "must not wait while the scheduler is suspended"


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        (wrong_yield, "yielded a generator; kernel calls need `yield from`"),
        (in_suspend_all(lambda kernel: kernel.delay(1)), NO_WAIT),
        (in_suspend_all(lambda kernel: kernel.delay_until(1)), NO_WAIT),
        (in_suspend_all(lambda kernel: kernel.delay_until(0)), NO_WAIT),
        (in_suspend_all(lambda kernel: kernel.notify_take(True, 1)), NO_WAIT),
        (in_suspend_all(lambda kernel: kernel.current.suspend()), NO_WAIT),
        # A timeout alone is against the rules, also when there would be nothing to wait for.
        (in_suspend_all(lambda kernel: kernel.create_queue(1, "q").send("item", 1)), NO_WAIT),
        (in_suspend_all(lambda kernel: kernel.create_queue(1, "q").receive(1)), NO_WAIT),
        (in_suspend_all(lambda kernel: given(kernel.create_binary_semaphore("s")).take(1)), NO_WAIT),
        (in_suspend_all(lambda kernel: kernel.create_mutex("m").take()), NO_WAIT),
        (in_suspend_all(lambda kernel: ()), "ended while the scheduler was suspended"),
        (doing(lambda kernel: kernel.resume_all()), "resume_all without suspend_all"),
        (give_a_mutex_of_another, "mutex lock: given by task, held by other"),
        (doing(lambda kernel: kernel.create_queue(1, "q").send(None)), "queue q: None cannot be sent"),
        (doing(lambda kernel: kernel.create_queue(1, "q").send_nowait(None)), "queue q: None cannot be sent"),
        (doing(lambda kernel: kernel.current.priority_set(-1)), "priority -1 is outside 0..6"),
        (doing(lambda kernel: kernel.current.priority_set(7)), "priority 7 is outside 0..6"),
    ],
)
def test_an_assertion_of_freertos_is_an_error_of_the_task(body, complaint):
    kernel = Kernel()
    start(kernel, task=(1, body, kernel))
    with pytest.raises(TaskError, match=r"^task task at 0\.000 ms: ") as caught:
        kernel.run(1_000)
    assert complaint in str(caught.value)


def test_calls_that_need_not_wait_work_while_the_scheduler_is_suspended():
    kernel = Kernel()
    queue = kernel.create_queue(1, "queue")
    semaphore = kernel.create_binary_semaphore("semaphore")
    mutex = kernel.create_mutex("mutex")
    results = []

    def body():
        kernel.suspend_all()
        results.append((yield from queue.receive(0)))
        results.append((yield from queue.send("item", 0)))
        results.append((yield from semaphore.take(0)))
        results.append((yield from mutex.take(0)))
        results.append((yield from mutex.give()))
        yield from kernel.current.notify()
        results.append((yield from kernel.notify_take(True, 5)))
        yield from kernel.delay(0)
        yield from kernel.resume_all()

    start(kernel, task=(1, body))
    kernel.run(0)
    assert results == [None, True, None, True, True, 1]


def test_neither_a_free_mutex_nor_a_held_one_from_an_interrupt_can_be_given():
    kernel = Kernel()
    mutex = kernel.create_mutex("mutex")
    results = []

    def body():
        results.append((yield from mutex.give()))

    start(kernel, task=(1, body))
    kernel.run(0)
    results.append(mutex.give_from_isr())
    assert results == [False, False]
    assert mutex.holder is None
    kernel.create_task("taker", 1, mutex.take)
    kernel.run(1_000)
    with pytest.raises(KernelError, match=r"^mutex mutex: given from an interrupt, held by taker$"):
        mutex.give_from_isr()


def objects_of(kernel):
    """One of each, with a task that waits for ever, on a kernel that was not started."""
    return SimpleNamespace(
        kernel=kernel,
        queue=kernel.create_queue(1, "q"),
        semaphore=kernel.create_binary_semaphore("s"),
        mutex=kernel.create_mutex("m"),
        other=kernel.create_task("other", 1, sleeper, kernel),
    )


@pytest.mark.parametrize(
    ("call", "who"),
    [
        (lambda o: o.queue.send_from_isr("item"), "queue q: sending from an interrupt"),
        (lambda o: o.semaphore.give_from_isr(), "semaphore s: sending from an interrupt"),
        (lambda o: o.mutex.give_from_isr(), "mutex m: give_from_isr"),
        (lambda o: o.other.notify_from_isr(), "task other: notify_from_isr"),
    ],
)
def test_a_task_cannot_make_the_calls_of_interrupts(call, who):
    kernel = Kernel()
    objects = objects_of(kernel)
    start(kernel, task=(2, doing(lambda _: call(objects) and ()), kernel))
    with pytest.raises(
        TaskError, match=f"KernelError: {who} is for interrupts, and was called by task task$"
    ):
        kernel.run(0)
    assert (len(objects.queue), len(objects.semaphore), objects.other.notification) == (0, 0, 0)


@pytest.mark.parametrize(
    "call",
    [
        lambda o: o.queue.send_nowait("item"),
        lambda o: o.queue.reset(),
        lambda o: o.queue.receive_nowait(),
        lambda o: o.queue.wait_for_item(FOREVER),
        lambda o: o.semaphore.give_nowait(),
        lambda o: o.kernel.delay(1),
        lambda o: o.kernel.delay_until(5),
        lambda o: o.kernel.suspend_all(),
        lambda o: o.kernel.enter_critical(),
        lambda o: o.other.suspend(),
        lambda o: o.other.resume(),
        lambda o: o.other.priority_set(2),
    ],
)
@pytest.mark.parametrize("traced", [False, True])
def test_an_interrupt_cannot_make_the_calls_of_tasks(call, traced):
    kernel = Kernel(trace=(lambda *line: None) if traced else None)
    objects = objects_of(kernel)
    kernel.start()
    for instant_us in (0, 300):  # the first one comes before any task ran
        with pytest.raises(KernelError, match=r"is for tasks, and was called from an interrupt$"):
            call(objects)
        kernel.run(instant_us)


def test_a_board_whose_task_has_raised_still_takes_interrupts():
    kernel = Kernel()
    semaphore = kernel.create_binary_semaphore("semaphore")
    start(kernel, task=(1, doing(lambda kernel: kernel.resume_all()), kernel))
    with pytest.raises(TaskError):
        kernel.run(0)
    assert semaphore.give_from_isr()


@pytest.mark.parametrize(
    "give",
    [
        lambda kernel, semaphore: semaphore.give_nowait(),
        lambda kernel, semaphore: (semaphore.give_nowait(), kernel.yield_if_pending())[-1],
        lambda kernel, semaphore: semaphore.give(),
    ],
)
def test_a_give_lets_a_taker_of_higher_priority_run_at_once(give):
    order = []
    lines = []
    kernel = Kernel(trace=lambda *line: lines.append(line))
    semaphore = kernel.create_binary_semaphore("semaphore")

    def low():
        yield from kernel.delay(1)
        yield from give(kernel, semaphore)
        order.append("low")

    def high():
        yield from semaphore.take()
        order.append("high")

    start(kernel, low=(1, low), high=(2, high))
    kernel.run(1_000)
    assert order == ["high", "low"]
    assert [who for _, event, who, *_ in lines if event == "Q_SEND"] == ["low"]


def test_giving_a_full_semaphore_is_counted_and_wakes_no_task():
    lines = []
    kernel = Kernel(trace=lambda *line: lines.append(line))
    semaphore = kernel.create_binary_semaphore("semaphore")

    def body():
        yield from semaphore.give_nowait()
        yield from semaphore.give_nowait()

    start(kernel, task=(1, body))
    kernel.run(0)
    assert (len(semaphore), semaphore.dropped) == (1, 1)
    assert [event for _, event, who, *_ in lines if who == "task" and event.startswith("Q_")] == [
        "Q_SEND",
        "Q_SEND_FAIL",
    ]


def test_waking_a_lower_task_leaves_no_pending_yield():
    kernel = Kernel()
    semaphore = kernel.create_binary_semaphore("semaphore")
    pending = []

    def high():
        yield from kernel.delay(1)
        semaphore.give_nowait()
        pending.append(tuple(kernel.yield_if_pending()))

    start(kernel, high=(2, high), low=(1, doing(lambda _: semaphore.take()), kernel))
    kernel.run(2_000)
    assert pending == [()]


def test_waiting_for_a_held_mutex_fails_when_its_lent_priority_returns():
    kernel = Kernel()
    mutex = kernel.create_mutex("lock")

    def holder():
        yield from mutex.take()
        yield from kernel.delay(2)
        yield from mutex.take(3)

    def lender():
        yield from kernel.delay(1)
        yield from mutex.take()

    def boss():
        yield from kernel.delay(3)
        yield from lender_task.suspend()  # what it lent stays lent

    kernel.create_task("holder", 1, holder)
    lender_task = kernel.create_task("lender", 3, lender)
    start(kernel, boss=(4, boss))
    with pytest.raises(
        TaskError, match=r"^task holder at 5\.000 ms: .*lock: holder waited for it and holds it"
    ):
        kernel.run(10_000)


def test_a_late_timer_that_finds_no_place_for_its_reload_is_an_error_of_the_timer_service():
    """The start is obeyed at 3 ms, later than the timer's period; the callback that is due then lasts until 5 ms."""
    kernel = Kernel()
    timer = kernel.create_timer("late", 1, True, lambda timer: kernel.work(2_000))

    def body():
        yield from timer.start()
        yield from kernel.work(3_000)
        yield from kernel.delay(1)
        for _ in range(COMMAND_QUEUE_LENGTH):
            yield from timer.stop()

    start(kernel, task=(2, body))
    with pytest.raises(TaskError, match=r"^task Tmr Svc at 5\.000 ms: .* timer late: no place to reload it"):
        kernel.run(10_000)


def test_a_timer_callback_that_leaves_the_scheduler_suspended_is_an_error_of_the_timer_service():
    kernel = Kernel()

    def callback(timer):
        kernel.suspend_all()
        yield from ()

    timer = kernel.create_timer("timer", 1, False, callback)
    start(kernel, task=(2, doing(lambda _: timer.start()), kernel))
    with pytest.raises(TaskError, match=rf"^task Tmr Svc at 1\.000 ms: .*{NO_WAIT}"):
        kernel.run(2_000)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda kernel: kernel.create_queue(0, "q"), "queue q: length 0"),
        (lambda kernel: kernel.create_counting_semaphore(2, 3, "s"), "semaphore s: initial count 3"),
        (lambda kernel: kernel.create_counting_semaphore(0, 0, "s"), "semaphore s: length 0"),
        (lambda kernel: kernel.create_queue(1, "q").send_from_isr(None), "queue q: None cannot be sent"),
        (lambda kernel: kernel.create_timer("t", 0, True, iter), "timer t: period 0"),
        (lambda kernel: kernel.create_task("t", -1, wrong_yield, kernel), "task t: priority -1"),
        (
            lambda kernel: kernel.create_task("t", 7, wrong_yield, kernel),
            "task t: priority 7 is outside 0..6",
        ),
        (
            lambda kernel: kernel.create_task("t", 1, lambda: 5),
            "task t: its function returned int, not a generator",
        ),
        (lambda kernel: kernel.run(0), "run before start"),
        (lambda kernel: (kernel.start(), kernel.start()), "started already"),
        (lambda kernel: (kernel.start(), kernel.run(5), kernel.run(4)), "time runs backwards"),
        (lambda kernel: (kernel.start(), kernel.advance(4)), "advance(4)"),
        (lambda kernel: Statistics(kernel, {"nobody": 5}), "deadline of 'nobody'"),
    ],
)
def test_misuse_from_outside_is_named(make, complaint):
    with pytest.raises(KernelError) as caught:
        make(Kernel())
    assert complaint in str(caught.value)


def test_statistics_count_time_responses_and_missed_deadlines():
    kernel = Kernel()
    ready = kernel.create_binary_semaphore("ready")

    def urgent():
        while True:
            yield from ready.take()
            yield from kernel.work(300)

    def late():
        while True:
            yield from kernel.delay(2)
            yield from kernel.work(1_000)

    kernel.create_task("urgent", 2, urgent)
    kernel.create_task("late", 1, late)
    statistics = Statistics(kernel, {"late": 1_200})
    kernel.start()
    # "late" works from 2000, 5000 and 8000 on; the first interrupt costs it 300 us, the second finds it waiting.
    run_until(kernel, 8_500, [(2_500, ready.give_from_isr), (7_000, ready.give_from_isr)])
    urgent_report, late_report = statistics.reports()
    assert urgent_report.run_time_us == 600
    assert urgent_report.activations == 1 + 2  # up to its first wait, and two interrupts
    assert urgent_report.worst_response_us == 300
    assert late_report.run_time_us == 2_000 + 500
    assert late_report.worst_response_us == 1_300
    assert late_report.deadline_misses == 1
    assert ProcessorLoad(kernel)() == pytest.approx(3_100 / 8_500)
    assert kernel.run_time_us(kernel.tasks[2]) == 8_500 - 3_100  # of the idle task


@pytest.mark.parametrize(("deadline_us", "misses"), [(1_299, 1), (1_300, 0)])
@pytest.mark.parametrize("end_us", [2_300, 4_000])
def test_a_response_exactly_at_its_deadline_is_no_miss(deadline_us, misses, end_us):
    """Both while the activation still lasts and when it is over: the task works from 1 to 2.3 ms."""
    kernel = Kernel()

    def body():
        yield from kernel.delay(1)
        yield from kernel.work(1_300)
        if end_us > 2_300:
            yield from kernel.delay(5)
        yield from kernel.work(1)

    kernel.create_task("task", 2, body)
    statistics = Statistics(kernel, {"task": deadline_us})
    kernel.start()
    kernel.run(end_us)
    assert statistics.reports()[0].deadline_misses == misses


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize(("place", "bound_us"), list(enumerate(LATENCY_BOUNDS_US)))
def test_a_latency_equal_to_a_class_bound_belongs_to_the_class_above(place, bound_us, first):
    """Of the activation with which a task begins, or of the next one."""
    kernel = Kernel()

    def low():
        yield from kernel.delay(1)

    def high():
        yield from kernel.delay(0 if first else 1)
        yield from kernel.work(bound_us)

    kernel.create_task("low", 2, low)
    kernel.create_task("high", 3, high)
    statistics = Statistics(kernel, {})
    kernel.start()
    kernel.run(20_000)
    low_report = statistics.reports()[0]
    assert low_report.worst_latency_us == bound_us
    assert low_report.latency_histogram[place + 1] == 1


def test_statistics_show_a_task_that_starves():
    kernel = Kernel()

    def greedy():
        while True:
            yield from kernel.work(1_000)

    def starving():
        yield from kernel.delay(1)

    kernel.create_task("greedy", 2, greedy)
    kernel.create_task("starving", 1, starving)
    statistics = Statistics(kernel, {"starving": 5_000})
    kernel.start()
    kernel.run(9_000)
    _, report = statistics.reports()
    assert (report.activations, report.worst_response_us, report.deadline_misses) == (0, 9_000, 1)
    assert ProcessorLoad(kernel)() == 1.0
