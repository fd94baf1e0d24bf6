"""The ledger of a farm below a URL: object stores can't append to a file, so lines are uploaded as
a series of small files, which are joined again when the farm is started.

Lines of the last seconds may be missing after a kill. Nothing is made twice then: before it makes
an asset, a worker looks for its ``result.json``."""

import json
import time

from ..core.files import json_text
from .ledger import FILE, Ledger
from .storage import Place, RemotePlace

FOLDER = "ledger"
SECONDS_BETWEEN = 5.0
MOST_PARTS = 100
"""Above this number, the parts are joined into one at the start."""


def open_ledger(place: Place, *, only_read: bool = False) -> Ledger:
    """Return the ledger of a farm.

    Args:
        only_read: nothing will be appended, and another command may append at the same time.
    """
    if isinstance(place, RemotePlace):
        return RemoteLedger(place, only_read)
    return Ledger(place.folder / FILE)


class RemoteLedger(Ledger):
    """A local copy of the ledger, and its parts below the URL."""

    def __init__(self, place: RemotePlace, only_read: bool = False) -> None:
        self.place = place
        self.waiting: list[bytes] = []
        self.uploaded = time.monotonic()
        self.count = 0
        path = place.folder / (f"read-{FILE}" if only_read else FILE)
        path.parent.mkdir(parents=True, exist_ok=True)
        parts = place.names(FOLDER)
        with open(path, "wb") as file:
            for part in parts:
                file.write(place.read(part) or b"")
        super().__init__(path)
        if len(parts) > MOST_PARTS and not only_read:
            self._join(parts)

    def copy(self, content: bytes) -> None:
        self.waiting.append(content)
        if time.monotonic() >= self.uploaded + SECONDS_BETWEEN:
            self.upload()

    def upload(self) -> None:
        """Upload the lines that are waiting, as one part."""
        if self.waiting:
            self.count += 1
            # sorted by time, also between drivers
            name = f"{FOLDER}/{time.time_ns():020d}-{self.count:06d}.jsonl"
            self.place.write(name, b"".join(self.waiting))
            self.waiting = []
        self.uploaded = time.monotonic()

    def close(self) -> None:
        self.upload()
        super().close()

    def _join(self, parts: list[str]) -> None:
        """Replace the parts by one with the last line of each asset and the seconds of all."""
        with open(self.path, "rb") as file:
            last = []
            for entry in sorted(self.index.values()):
                file.seek(entry.offset)
                line = {**json.loads(file.readline()), "all_worker_seconds": entry.worker_seconds}
                last.append(json_text(line).encode() + b"\n")
        # a reader between the two steps sees these lines twice, which changes nothing, since the
        # name is sorted after that of the last part
        joined = parts[-1].removesuffix(".jsonl") + "_joined.jsonl"
        self.place.write(joined, b"".join(last))
        self.place.remove(parts)
