"""An observer that keeps the rows that it is shown."""

import pyarrow as pa


class Watcher:
    def __init__(self) -> None:
        self.batches: list[pa.RecordBatch] = []
        self.notes: list[tuple[int, str, str]] = []

    def rows(self, batch: pa.RecordBatch) -> None:
        self.batches.append(batch)

    def note(self, t_us: int, source: str, text: str) -> None:
        self.notes.append((t_us, source, text))
