"""What survives a restart of the server: each board's EEPROM and deck memory, in two files of a folder."""

from pathlib import Path

from hil.devices.board import Memory
from hil.errors import LabError


class BoardFiles:
    """`board-N.eeprom` and `board-N.deck` are the bare bytes; `load` before the board boots, `keep` now and then."""

    def __init__(self, folder: Path, number: int, memory: Memory) -> None:
        self._memories = {
            folder / f"board-{number}.eeprom": memory.eeprom,
            folder / f"board-{number}.deck": memory.deck,
        }
        self._kept: dict[Path, bytes] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LabError(f"--state {folder}: {error.strerror}") from None

    def load(self) -> None:
        """Put into the memories what was kept; `LabError` for a file that is no such memory."""
        for path, memory in self._memories.items():
            try:
                content = path.read_bytes()
            except FileNotFoundError:
                continue
            except OSError as error:
                raise LabError(f"{path}: {error.strerror}") from None
            if len(content) != len(memory):
                raise LabError(f"{path}: {len(content)} bytes; this memory has {len(memory)}")
            memory[:] = self._kept[path] = content

    def keep(self) -> None:
        """Write what has changed; a file is never half written."""
        for path, memory in self._memories.items():
            if memory == self._kept.get(path, b""):
                continue
            self._kept[path] = bytes(memory)
            new = path.with_suffix(path.suffix + ".new")
            try:
                new.write_bytes(self._kept[path])
                new.replace(path)
            except OSError as error:
                raise LabError(f"{path}: {error.strerror}") from None
