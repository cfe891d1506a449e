"""The telemetry of a flight: four fixed log blocks at 50 Hz, all with the same time stamp, while a client wants them.

A fifth carries the excitation while there is one.

The stream ends when its partner is gone, as log blocks do.
"""

from collections.abc import Callable, Sequence

from firmware_py.links.crtp_stack import CrtpStack, Task
from firmware_py.wire import telemetry

ReadBlock = Callable[[telemetry.Block], Sequence[telemetry.Number]]


class TelemetryStream:
    """`read_block` returns what the log variables of a telemetry block show now, `is_exciting` whether there is an
    excitation.
    """

    def __init__(self, stack: CrtpStack, read_block: ReadBlock, is_exciting: Callable[[], bool]) -> None:
        self._on = False
        self._stack = stack
        self._read_block = read_block
        self._is_exciting = is_exciting
        self._switched = stack.kernel.create_binary_semaphore("telemetry")
        stack.kernel.create_task("TELEMETRY", 1, self._task)

    @property
    def on(self) -> bool:
        """Whether the blocks are being sent."""
        return self._on

    def switch(self, on: bool) -> None:
        """Begin or end."""
        if on and not self._on:
            self._switched.give_nowait()
        self._on = on

    def _task(self) -> Task:
        kernel, cost = self._stack.kernel, self._stack.cost
        period = telemetry.PERIOD_MS
        while True:
            if not self._on:
                yield from self._switched.take()
                continue
            yield from kernel.delay_until(kernel.tick_count // period * period + period)
            if not self._stack.connected:
                self._on = False
                yield from self._stack.hang_up()
                continue
            stamp_ms = kernel.tick_count
            blocks = telemetry.ALL_BLOCKS if self._is_exciting() else telemetry.BLOCKS
            yield from kernel.work(cost.log_us * len(blocks))
            for block in blocks:
                packet = telemetry.encode_block(block, stamp_ms, self._read_block(block))
                yield from self._stack.offer(packet)
