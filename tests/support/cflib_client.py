"""Unmodified cflib as the tests use it, whatever the link."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Self

from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig

from support.serving import PATIENCE_S


class CflibClient:
    """A program with cflib: connected, in the end disconnected. No wait is longer than `PATIENCE_S`."""

    def __init__(self, uri: str, cache: Path) -> None:
        self.cf = Crazyflie(rw_cache=str(cache))
        self.connected, self.fully, self.gone = threading.Event(), threading.Event(), threading.Event()
        self.problem = ""
        self.console, self._spoken = "", threading.Condition()
        self.cf.connected.add_callback(lambda _: self.connected.set())
        self.cf.fully_connected.add_callback(lambda _: self.fully.set())
        self.cf.disconnected.add_callback(lambda _: self.gone.set())
        self.cf.connection_failed.add_callback(lambda _, text: self._fail(text))
        self.cf.console.receivedChar.add_callback(self._hear)
        self.cf.open_link(uri)

    def ready(self) -> Self:
        assert self.connected.wait(PATIENCE_S), "not connected"
        assert self.fully.wait(PATIENCE_S), "not fully connected"
        assert self.problem == ""
        return self

    def __enter__(self) -> Self:
        return self.ready()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _fail(self, text: str) -> None:
        self.problem = text
        self.connected.set()
        self.fully.set()

    def _hear(self, text: str) -> None:
        with self._spoken:
            self.console += text
            self._spoken.notify()

    def heard(self, text: str) -> bool:
        """Whether the console says it, or has said it."""
        with self._spoken:
            return self._spoken.wait_for(lambda: text in self.console, PATIENCE_S)

    def answer(self, ask: Callable[..., object], *arguments: object) -> tuple[object, ...]:
        """What a callback of cflib is called with."""
        done, answers = threading.Event(), []

        def called(*values: object) -> None:
            answers.append(values)
            done.set()

        ask(*arguments, called)
        assert done.wait(PATIENCE_S)
        return answers[0]

    def set(self, name: str, value: float) -> float:
        """Set a parameter and return what the board says it is now."""
        done, answers = threading.Event(), []

        def updated(_: str, text: str) -> None:
            answers.append(float(text))
            done.set()

        self.cf.param.add_update_callback(*name.split("."), updated)
        self.cf.param.set_value(name, value)
        assert done.wait(PATIENCE_S)
        self.cf.param.remove_update_callback(*name.split("."), updated)
        return answers[0]

    def rows(self, count: int, period_ms: int, *names: str) -> list[tuple[int, dict[str, float]]]:
        """That many rows of a log block: board time [ms] and values."""
        block, rows, done = LogConfig("rows", period_ms), [], threading.Event()
        for name in names:
            block.add_variable(name)

        def received(t_ms: int, values: dict[str, float], _: LogConfig) -> None:
            rows.append((t_ms, values))
            if len(rows) >= count:
                done.set()

        self.cf.log.add_config(block)
        block.data_received_cb.add_callback(received)
        block.start()
        assert done.wait(PATIENCE_S), f"{len(rows)} of {count} rows"
        block.stop()
        block.delete()
        return rows[:count]

    def close(self) -> None:
        self.cf.close_link()
        assert self.gone.wait(PATIENCE_S)
