"""The farm's folder: on this machine, or below an fsspec URL such as ``s3://bucket/farm``.

Below a URL, an asset is made in a scratch folder of its worker and uploaded when it is finished,
``result.json`` last: a reader that goes by ``result.json`` never sees half an asset. During
training its checkpoint is uploaded too, to ``parts/<name>``, from where any worker goes on."""

import fnmatch
import hashlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Optional, TypeVar

from ..core.errors import UserError
from ..core.files import atomic_file
from . import assets
from .rows import Row

LAST, FETCHED = "ckpts/last.ckpt", "ckpts/fetched.ckpt"
NOT_UPLOADED = ("ckpts/epoch=*", "ckpts/*-prev.ckpt", FETCHED, "ckpts/.*", "ckpts-*/*", "tb_logs/*")
TRIES, FIRST_WAIT = 4, 0.5
"""Attempts of one transfer, and the seconds before the second one; they double."""
Answer = TypeVar("Answer")


class Unreachable(UserError):
    """Raised when a URL can't be read or written: other assets would fail in the same way."""


def is_url(text: str) -> bool:
    return "://" in text


def place_of(out: str) -> "Place":
    """Return the farm's folder for ``--out``."""
    return RemotePlace(out) if is_url(out) else Place(Path(out).expanduser().absolute())


class Place:
    """A farm's folder on a disk that all its machines share.

    Args:
        folder: where assets are made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __str__(self) -> str:
        return str(self.folder)

    def work_folder(self, row: Row) -> Path:
        """Return the folder in which an asset is made."""
        return assets.asset_folder(self.folder, row)

    def finished(self, row: Row) -> Optional[dict[str, Any]]:
        """Return the result of a finished asset; None if it isn't finished."""
        return assets.read_result(self.work_folder(row), row)

    def discard(self, row: Row) -> None:
        """Remove an asset that isn't finished."""
        shutil.rmtree(self.work_folder(row), ignore_errors=True)

    def fetch_checkpoint(self, row: Row) -> None:
        """Bring the last checkpoint into the work folder."""

    def keep_checkpoint(self, row: Row) -> None:
        """Make the work folder's last checkpoint available to other workers."""

    def publish(self, row: Row) -> None:
        """Make a finished asset, with its result, available to readers."""

    def read(self, name: str) -> Optional[bytes]:
        """Return the content of a file of the farm; None if there is none."""
        path = self.folder / name
        return path.read_bytes() if path.is_file() else None

    def write(self, name: str, content: bytes) -> None:
        """Write a file of the farm atomically."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(content)

    def upload(self, name: str) -> None:
        """Make a file that was written below :attr:`folder` available to readers."""


class RemotePlace(Place):
    """A farm's folder below a URL, and a scratch folder on each machine.

    Args:
        url: of the farm's folder.
        scratch: holds the scratch folders; by default the user's cache folder.
    """

    def __init__(self, url: str, scratch: Optional[Path] = None) -> None:
        self.url = url.rstrip("/")
        root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        root = scratch or Path(root, "threestudio_gaussiandreamer", "farm")
        super().__init__(root / hashlib.sha256(self.url.encode()).hexdigest()[:16])
        self._system: Any = None
        self._kept: dict[str, float] = {}

    def __str__(self) -> str:
        return self.url

    def __getstate__(self) -> dict[str, Any]:
        # connections can't be sent to other processes
        return {**self.__dict__, "_system": None}

    def system(self) -> Any:
        """Return fsspec's file system of the URL.

        Raises:
            UserError: the URL's protocol is unknown, or its package isn't installed.
        """
        if self._system is None:
            import fsspec

            try:
                self._system = fsspec.core.url_to_fs(self.url, use_listings_cache=False)[0]
            except (ImportError, ValueError) as error:
                raise UserError(
                    f"{self.url} can't be used: {error}; s3:// needs pip install "
                    "'threestudio-gaussiandreamer[cluster]'"
                ) from error
        return self._system

    def read(self, name: str) -> Optional[bytes]:
        def cat() -> Optional[bytes]:
            try:
                return self.system().cat_file(f"{self.url}/{name}")
            except FileNotFoundError:
                return None

        return self._tried(cat)

    def write(self, name: str, content: bytes) -> None:
        # object stores replace an object at once
        self._tried(lambda: self.system().pipe_file(f"{self.url}/{name}", content))

    def upload(self, name: str) -> None:
        self._put(self.folder / name, name)

    def names(self, below: str) -> list[str]:
        """List the files in a folder of the farm, sorted."""

        def find() -> list[str]:
            self.system().invalidate_cache()
            return self.system().find(f"{self.url}/{below}")

        return sorted(f"{below}/{Path(path).name}" for path in self._tried(find))

    def remove(self, names: list[str]) -> None:
        """Remove files of the farm."""
        for name in names:
            self._tried(lambda path=f"{self.url}/{name}": self.system().rm_file(path))

    def finished(self, row: Row) -> Optional[dict[str, Any]]:
        content = self.read(f"{assets.ASSETS}/{row.name}/{assets.RESULT}")
        return None if content is None else assets.parse_result(content, row)

    def discard(self, row: Row) -> None:
        super().discard(row)
        self._drop_part(row)

    def fetch_checkpoint(self, row: Row) -> None:
        """Bring it beside what this machine has of the asset, of which ``resume=auto`` takes the
        checkpoint with the highest step.
        """
        folder = self.work_folder(row)
        self._kept = {row.name: _written(folder / LAST)}  # which may be older than the other
        content = self.read(self._part(row))
        if content is not None:
            (folder / FETCHED).parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(folder / FETCHED) as file:
                file.write(content)

    def keep_checkpoint(self, row: Row) -> None:
        path = self.work_folder(row) / LAST
        written = _written(path)
        if written > self._kept.get(row.name, 0.0):
            self._put(path, self._part(row))
            self._kept = {row.name: written}

    def publish(self, row: Row) -> None:
        """Upload an asset, its result last, and remove the scratch folder."""
        folder = self.work_folder(row)
        for path in uploaded_files(folder):
            self._put(path, f"{assets.ASSETS}/{row.name}/{path.relative_to(folder).as_posix()}")
        self._drop_part(row)
        shutil.rmtree(folder, ignore_errors=True)

    def _part(self, row: Row) -> str:
        return f"parts/{row.name}/last.ckpt"

    def _drop_part(self, row: Row) -> None:
        if self.read(self._part(row)) is not None:
            self.remove([self._part(row)])

    def _put(self, path: Path, name: str) -> None:
        self._tried(lambda: self.system().put_file(str(path), f"{self.url}/{name}"))

    def _tried(self, act: Callable[[], Answer]) -> Answer:
        """Return ``act()``, tried again after an error.

        Raises:
            Unreachable: it has failed :data:`TRIES` times.
        """
        for attempt in range(TRIES):
            try:
                return act()
            except UserError:
                raise
            except Exception as error:  # each file system of fsspec has its own
                if attempt == TRIES - 1:
                    raise Unreachable(
                        f"{self.url} can't be reached: {type(error).__name__}: {error}; check "
                        "the address and the credentials, and give the same command again"
                    ) from error
                time.sleep(FIRST_WAIT * 2**attempt)
        raise AssertionError("unreachable")


def _written(path: Path) -> float:
    """Return when a file was written; 0 without one."""
    return path.stat().st_mtime if path.exists() else 0.0


def uploaded_files(folder: Path) -> Iterator[Path]:
    """Yield the files of a finished asset that readers get, its result last."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for path in files:
        name = path.relative_to(folder).as_posix()
        if name != assets.RESULT and not any(fnmatch.fnmatch(name, p) for p in NOT_UPLOADED):
            yield path
    yield folder / assets.RESULT
