"""Tasks of the subset: the C coroutines and the generators of Python do the same, instant by instant."""

import pytest

from firmware_py.compiling import bound_together
from firmware_py.core.subset import Struct, i64, step
from firmware_py.export.errors import ExportError
from firmware_py.export.kernels import translate
from firmware_py.rtos import Kernel
from firmware_py.rtos.awaited import Steps, delay, delay_until, give, receive, send, take, work
from firmware_py.rtos.compiled import compiled
from firmware_py.rtos.memory import FOREVER, TICK_US, KernelMemory
from firmware_py.rtos.scheduler import begin, resume

SAMPLES, IMU_READY, DATA_READY, RUN = 1, 2, 3, 4


class Counts(Struct):
    """What the tasks have done."""

    late: i64
    samples: i64
    waited: i64
    spent_us: i64


@compiled
def stabilizer(k: KernelMemory, counts: Counts) -> Steps:
    """Run on the tick edge after each sample."""
    turn = 0
    while True:
        came = yield from take(k, DATA_READY, 1)
        if came > 0:
            yield from delay_until(k, k.tick_count + 1)
        else:
            counts.late += 1
        turn = (turn + 1) % 10
        yield from give(k, RUN, 0)
        if turn == 0:
            yield from work(k, 170)
            counts.spent_us += 170


@compiled
def sensors(k: KernelMemory, counts: Counts) -> Steps:
    """Read the IMU whenever it has data."""
    counts.waited = 0
    while True:
        yield from take(k, IMU_READY, FOREVER)
        counts.waited += 1
        yield from work(k, 40 + counts.waited % 7)
        sent = yield from send(k, SAMPLES, 0)
        if sent > 0 and counts.waited % 50 != 0:
            yield from give(k, DATA_READY, 0)


@compiled
def estimator(k: KernelMemory, counts: Counts) -> Steps:
    """Drain the samples."""
    while True:
        yield from take(k, RUN, FOREVER)
        got = yield from receive(k, SAMPLES, 0)
        while got > 0:
            counts.samples += 1
            yield from work(k, 350)
            got = yield from receive(k, SAMPLES, 0)


@compiled
def stepped(k: KernelMemory, counts: Counts, first: int) -> int:
    """Take the steps of native tasks until a task of Python is the highest ready one."""
    task = first
    while task > 0 and task <= 3:
        yielded_us = 0
        if task == 1:
            yielded_us = step(stabilizer(k, counts))
        elif task == 2:
            yielded_us = step(sensors(k, counts))
        else:
            yielded_us = step(estimator(k, counts))
        task = resume(k, yielded_us)
    return task


@compiled
def begin_native(k: KernelMemory, counts: Counts, now_us: int, until_us: int) -> int:
    """Begin a run."""
    task = begin(k, now_us, until_us)
    return stepped(k, counts, task)


@compiled
def resume_native(k: KernelMemory, counts: Counts, yielded_us: int) -> int:
    """Go on after a step of a task of Python."""
    task = resume(k, yielded_us)
    return stepped(k, counts, task)


def nothing(*_):
    yield from ()


def meddler(memory, counts):
    """Take samples away, as a task of Python among native ones."""
    while True:
        yield from delay(memory, 7)
        yield from receive(memory, SAMPLES, 3)
        yield from work(memory, 900)


class Bench:
    """A kernel with three tasks of the subset and one of Python."""

    def __init__(self, native):
        self.kernel, self.counts = Kernel(), Counts.allocate()
        self.kernel.create_queue(20, "samples")
        for name in ("imuReady", "dataReady", "run"):
            self.kernel.create_binary_semaphore(name)
        bodies = stabilizer, sensors, estimator
        for priority, body in zip((5, 4, 2), bodies, strict=True):
            given = self.kernel.memory, self.counts.fields
            self.kernel.create_task(body.__name__, priority, nothing if native else body, *given)
        self.kernel.create_task("meddler", 3, meddler, *given)
        self.kernel.start()
        self.begin, self.resume = self.kernel.calls.begin, self.kernel.calls.resume
        if native:
            self.begin, self.resume = bound_together(
                (begin_native, resume_native), self.kernel.tables, self.counts
            )

    def run(self, now_us):
        task = self.begin(now_us, now_us)
        while task > 0:
            task = self.resume(self.kernel._steps[task]())
        assert task == 0

    def state(self):
        memory = self.kernel.tables.memory
        kept = {name: memory[name].tobytes() for name in memory.dtype.names if name != "frames"}
        return kept | {"counts": self.counts.memory.tolist()}


def test_c_coroutines_do_what_generators_do_at_every_instant():
    benches = Bench(native=True), Bench(native=False)
    for tick in range(300):
        for bench in benches:
            bench.run(tick * TICK_US + 299)
            bench.kernel.advance(tick * TICK_US + 300)
            bench.kernel.calls.send_from_isr(IMU_READY)
            bench.run(tick * TICK_US + 300)
        assert benches[0].state() == benches[1].state()
    late, samples, waited, spent_us = benches[0].counts.memory[0].tolist()
    assert min(late, samples, spent_us) > 0
    assert waited > 250


@compiled
def forgetful(k: KernelMemory, counts: Counts) -> Steps:
    """Keep too much between two waits."""
    a, b, c, d, e, f, g = 1, 2, 3, 4, 5, 6, 7
    h, i, j, m, n, o, p = 1, 2, 3, 4, 5, 6, 7
    while True:
        yield from delay(k, a + b + c + d + e + f + g + h + i + j + m + n + o + p)
        counts.late += 1


@compiled
def remembering(k: KernelMemory, counts: Counts) -> Steps:
    """Keep as much as there is room for."""
    a, b, c, d, e, f, g = 1, 2, 3, 4, 5, 6, 7
    h, i, j, m, n, o = 1, 2, 3, 4, 5, 6
    while True:
        yield from delay(k, a + b + c + d + e + f + g + h + i + j + m + n + o)
        counts.late += 1


@compiled
def looping(k: KernelMemory, counts: Counts) -> Steps:
    """Wait in a loop over a range."""
    for tick in range(3):
        yield from delay(k, tick)
        counts.late += 1


@compiled
def waits_for_python(k: KernelMemory, counts: Counts) -> Steps:
    """Wait for something other than a call of the scheduler."""
    while True:
        yield from iter(k)
        counts.late += 1


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        (forgetful, "14 locals: a task has at most 13"),
        (looping, "for in a task: its variable would be lost"),
        (waits_for_python, "yield from iter, which is no call of the scheduler"),
    ],
)
def test_what_a_task_of_c_cannot_do_is_refused(task, reason):
    memory = KernelMemory.allocate().memory, Counts.allocate().memory
    assert "frame[15] = 6" in translate((remembering,), memory)
    with pytest.raises(ExportError, match=reason):
        translate((task,), memory)
