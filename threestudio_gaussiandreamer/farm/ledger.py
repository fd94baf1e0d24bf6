"""The ledger of a farm: what is running, finished and failed, one JSON object per line.

The file is only appended to, by one process, and a line is on the disk before the farm goes on. The
last line of an asset counts, but ``worker_seconds``, which a line has when a worker is done with
the asset, are added up; ``all_worker_seconds`` in place of earlier lines is their sum. A process
that was killed may leave half a line: it is skipped when the file is read, and the next line begins
below it."""

import json
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

from ..core.errors import UserError
from ..core.files import json_text
from .assets import has_files
from .rows import Row, name_number

FILE = "ledger.jsonl"
RUNNING, FINISHED, FAILED = "running", "finished", "failed"
STATES = (RUNNING, FINISHED, FAILED)


class Entry(NamedTuple):
    """The last line of an asset."""

    offset: int
    """Of the line in the file, bytes."""
    state: int
    """Index in :data:`STATES`."""
    key: str
    """:attr:`.rows.Row.key` of the row that the asset was made from."""
    worker_seconds: float
    """The sum of all lines' ``worker_seconds``."""


class Ledger:
    """The ledger in a folder. Reading it builds an index of one :class:`Entry` per asset, about
    280 bytes each; the lines stay on the disk.

    Args:
        path: the file; it may not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damaged = 0
        self.index: dict[int, Entry] = {}
        self._file: Any = None
        self._reader: Any = None
        for offset, line in self._read():
            self._note(line, offset)

    def _read(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield offset and content of each line; count damaged lines."""
        if not self.path.exists():
            return
        with open(self.path, "rb") as file:
            offset = 0
            for content in file:
                line = parse_line(content)
                if line is None:
                    self.damaged += 1
                else:
                    yield offset, line
                offset += len(content)

    def _note(self, line: dict[str, Any], offset: int) -> None:
        number = name_number(line["name"])
        earlier = self.index[number].worker_seconds if number in self.index else 0.0
        spent = line.get("all_worker_seconds", earlier + line.get("worker_seconds", 0.0))
        self.index[number] = Entry(offset, STATES.index(line["state"]), line["key"], spent)

    def _entry(self, row: Row) -> Optional[Entry]:
        return self.index.get(name_number(row.name))

    def state(self, row: Row) -> Optional[str]:
        """Return the last state of a row's asset; None if it was never begun.

        Raises:
            UserError: the asset of this name was made from another row.
        """
        entry = self._entry(row)
        if entry is None:
            return None
        if entry.key != row.key:
            raise UserError(
                f"line {row.line} of the prompt list: {row.name!r} was begun in this farm with "
                "another prompt, seed, config or overrides; give it another name, or choose "
                "another --out"
            )
        return STATES[entry.state]

    def last(self, row: Row) -> Optional[dict[str, Any]]:
        """Return the last line of a row's asset, read from the disk; None if there is none."""
        entry = self._entry(row)
        if entry is None:
            return None
        if self._reader is None:
            self._reader = open(self.path, "rb")
        self._reader.seek(entry.offset)
        return parse_line(self._reader.readline())

    def worker_seconds(self, row: Row) -> float:
        """Return the seconds that workers have spent on a row's asset, in all attempts."""
        entry = self._entry(row)
        return entry.worker_seconds if entry else 0.0

    def append(self, lines: Iterable[dict[str, Any]]) -> None:
        """Append lines, each with name, key and state, and flush them to the disk.

        Raises:
            UserError: the disk is full or the file can't be written; what was written before can
                still be read.
        """
        try:
            if self._file is None:
                self._file = _opened(self.path)
            for line in lines:
                content = json_text({"time": round(time.time(), 3), **line}).encode() + b"\n"
                offset = self._file.tell()
                self._file.write(content)
                self._note(line, offset)
                self.copy(content)
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise UserError(
                f"the ledger {self.path} can't be written: {error.strerror or error}; make room "
                "and give the same command again"
            ) from error

    def copy(self, content: bytes) -> None:
        """Do nothing; a subclass copies each appended line to another place here."""

    def close(self) -> None:
        for file in (self._file, self._reader):
            if file is not None:
                file.close()
        self._file = self._reader = None


def _opened(path: Path) -> Any:
    """Open the ledger for appending; end its last line if a killed process left it incomplete."""
    file = open(path, "ab")
    if file.tell():
        with open(path, "rb") as reader:
            reader.seek(-1, os.SEEK_END)
            if reader.read() != b"\n":
                file.write(b"\n")
    return file


def parse_line(content: bytes) -> Optional[dict[str, Any]]:
    """Return the content of a line; None if it is incomplete or no line of a ledger."""
    if not content.endswith(b"\n"):
        return None
    try:
        line = json.loads(content)
        if line["state"] == FINISHED and not has_files(line):
            line["state"] = RUNNING
        known = line["state"] in STATES and isinstance(line["name"], str)
        return line if known and isinstance(line["key"], str) else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
