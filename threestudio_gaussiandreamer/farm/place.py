"""The farm's folder, on this machine or below an fsspec URL such as ``s3://bucket/farm``, and the
records of its assets: ``result.json``, the last file of a complete asset, and ``failed.json`` of an
attempt that ended without a result. Below a URL, an asset is made in a cache folder of its worker
and uploaded when it is finished; its checkpoint during training, to ``parts/<name>``, from where
any worker goes on."""

import contextlib
import fnmatch
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Optional

from ..core.errors import UserError
from ..core.files import json_text, write_file
from ..launch.run_folder import make_folder
from .rows import Row

ASSETS, PARTS = "assets", "parts"
"""The folders with a folder per asset: of its run (also the ``name``), and of its checkpoint."""
RESULT, FAILURE = "result.json", "failed.json"
WAITING, RUNNING, STOPPED, FAILED, FINISHED = "waiting", "running", "stopped", "failed", "finished"
CHANGED = "changed"
"""States of an asset: not begun; begun, and without a record; an attempt was stopped; an attempt
failed; complete; its record is of another row."""
LAST, FETCHED = "ckpts/last.ckpt", "ckpts/fetched.ckpt"
NOT_UPLOADED = ("ckpts/epoch=*", "ckpts/*-prev.ckpt", FETCHED, "ckpts/.*", "ckpts-*/*", "tb_logs/*")
NOT_UPLOADED += (RESULT,)  # comes last
NUMBERS = ("seconds", "worker_seconds", "megabytes", "steps", "gaussians", "bytes", "attempts")
MISSING = (FileNotFoundError, IsADirectoryError, NotADirectoryError)
BATCH = 1000
"""Records that are read together."""


class Unreachable(UserError):
    """Raised when a URL can't be read or written: other assets would fail in the same way."""


class AnotherRow(UserError):
    """Raised for an asset that was made from another row of its name."""

    def __init__(self, row: Row) -> None:
        super().__init__(
            f"line {row.line} of the prompt list: {row.name!r} was begun in this farm with another "
            "prompt, seed, config or overrides; give it another name, or choose another --out"
        )


class Place:
    """A farm's folder, on a disk of all its machines or below a URL; raises UserError."""

    def __init__(self, out: str | os.PathLike) -> None:
        import fsspec

        self.remote = "://" in str(out)
        self.folder = Path(out).expanduser().absolute()
        self.url = str(out).rstrip("/") if self.remote else str(self.folder)
        self.system = fsspec.filesystem("file")
        if not self.remote:
            return
        cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        digest = hashlib.sha256(self.url.encode()).hexdigest()[:16]
        self.folder = Path(cache, "threestudio_gaussiandreamer", "farm", digest)
        self.uploaded = 0.0
        try:
            self.system = fsspec.core.url_to_fs(self.url, use_listings_cache=False)[0]
        except Exception as error:  # each file system has its own
            install = "pip install 'threestudio-gaussiandreamer[cluster]'"
            raise UserError(f"{self.url} can't be used: {error}; s3:// needs {install}") from error

    def __str__(self) -> str:
        return self.url

    @contextlib.contextmanager
    def reached(self, may_lack: bool = False) -> Iterator[None]:
        """Raise Unreachable for errors of a URL, but not for a file that ``may_lack``."""
        try:
            yield
        except Exception as error:  # each file system of fsspec has its own
            if not self.remote or may_lack and isinstance(error, MISSING):
                raise
            raise Unreachable(
                f"{self.url} can't be reached: {type(error).__name__}: {error}; check the address "
                "and the credentials, and give the same command again"
            ) from error

    def names(self, below: str) -> set[str]:
        """List what is in a folder of the farm."""
        with contextlib.suppress(*MISSING), self.reached(may_lack=True):
            found = self.system.ls(f"{self.url}/{below}", detail=False)
            return {path.rstrip("/").rpartition("/")[2] for path in found}
        return set()

    def read(self, names: Sequence[str]) -> list[Optional[bytes]]:
        """Return the contents of files of the farm; None for those that don't exist."""
        with self.reached(may_lack=True):
            paths = [f"{self.url}/{name}" for name in names]
            found = self.system.cat_ranges(paths, None, None, on_error="return")
            for content in found:
                if not isinstance(content, (bytes, *MISSING)):
                    raise content
            return [content if isinstance(content, bytes) else None for content in found]

    def read_json(self, *names: str) -> list[Optional[dict[str, Any]]]:
        """Return JSON files, None for missing ones; raises UserError for what is no record."""
        found = []
        for name, content in zip(names, self.read(names), strict=True):
            try:
                found.append(None if content is None else {**json.loads(content)})
                record = found[-1] or {}
                scores = (record.get("scores") or {}).values()
                sum([*(record.get(key, 0) for key in NUMBERS), *filter(None, scores)])
            except (ValueError, TypeError, AttributeError, RecursionError) as error:
                advice = "delete it, or choose another --out"
                raise UserError(f"{self}/{name} is damaged ({error}): {advice}") from error
        return found

    def write(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file of the farm atomically, as object stores do by themselves."""
        text = json_text(content, indent=1).encode()
        if self.remote:
            with self.reached():
                self.system.pipe_file(f"{self.url}/{name}", text)
        else:
            make_folder((self.folder / name).parent)
            write_file(self.folder / name, text)

    def upload(self, name: str, path: Optional[Path] = None) -> None:
        """Make a file that was written below :attr:`folder` available to readers."""
        if self.remote:
            with self.reached():
                self.system.put_file(str(path or self.folder / name), f"{self.url}/{name}")

    def remove(self, names: Iterable[str]) -> None:
        for name in names:
            with contextlib.suppress(*MISSING), self.reached(may_lack=True):
                self.system.rm_file(f"{self.url}/{name}")

    def work_folder(self, row: Row) -> Path:
        """Return the folder in which an asset is made."""
        return self.folder / ASSETS / row.name

    def finished(self, row: Row) -> Optional[dict[str, Any]]:
        """Return the result of a finished asset; None if it isn't finished."""
        (record,) = self.read_json(f"{ASSETS}/{row.name}/{RESULT}")
        ours = record and record.get("key") == row.key
        return {"state": FINISHED, **record} if ours else None

    def fetch_checkpoint(self, row: Row, saves_memory: bool) -> None:
        """Bring the last checkpoint of one configuration beside what this machine has."""
        if self.remote:
            folder = self.work_folder(row)
            self.uploaded = _written(folder / LAST)  # may be older than the other
            (content,) = self.read([part_of(row, saves_memory)])
            if content is not None:
                (folder / FETCHED).parent.mkdir(parents=True, exist_ok=True)
                (folder / FETCHED).write_bytes(content)

    def keep_checkpoint(self, row: Row, saves_memory: bool) -> None:
        """Make the work folder's last checkpoint available to other workers."""
        path = self.work_folder(row) / LAST
        if self.remote and (written := _written(path)) > self.uploaded:
            self.upload(part_of(row, saves_memory), path)
            self.uploaded = written

    def publish(self, row: Row, result: Mapping[str, Any]) -> None:
        """Write the result of a finished asset after its other files; remove its failure."""
        folder, name = self.work_folder(row), f"{ASSETS}/{row.name}"
        for path in sorted(filter(Path.is_file, folder.rglob("*"))) if self.remote else ():
            file = path.relative_to(folder).as_posix()
            if not any(fnmatch.fnmatch(file, pattern) for pattern in NOT_UPLOADED):
                self.upload(f"{name}/{file}", path)
        self.write(f"{name}/{RESULT}", result)
        self.remove([f"{name}/{FAILURE}"])
        if self.remote:
            shutil.rmtree(folder, ignore_errors=True)
            self.remove(part_of(row, saves_memory) for saves_memory in (False, True))

    def records(self, rows: Iterable[Row]) -> Iterator[tuple[Row, dict[str, Any]]]:
        """Yield each row with its ``result.json``, else its ``failed.json``, and ``state``."""
        begun = self.names(ASSETS) | (self.names(PARTS) if self.remote else set())
        rows = iter(rows)
        while batch := list(islice(rows, BATCH)):
            found: dict[str, dict[str, Any]] = {}
            for file, state in ((RESULT, FINISHED), (FAILURE, FAILED)):
                asked = [row for row in batch if row.name in begun and row.name not in found]
                names = [f"{ASSETS}/{row.name}/{file}" for row in asked]
                for row, record in zip(asked, self.read_json(*names), strict=True):
                    if record is not None:
                        ours = record.get("key") == row.key
                        found[row.name] = {"state": state, **record} if ours else {"state": CHANGED}
            for row in batch:
                state = RUNNING if row.name in begun else WAITING
                yield row, found.get(row.name, {"state": state})


def variant(row: Row, saves_memory: bool) -> str:
    """Return what the checkpoints of a row that are made with one configuration are marked by."""
    return f"{row.key}{'-saves_memory' * saves_memory}"


def part_of(row: Row, saves_memory: bool) -> str:
    return f"{PARTS}/{row.name}/{variant(row, saves_memory)}.ckpt"


def _written(path: Path) -> float:
    """Return when a file was written; 0 without one."""
    return path.stat().st_mtime if path.exists() else 0.0
