"""Create, lock and remove the folder of a run: exactly one process creates it, one uses it at a
time, and only the process that created it and still holds the lock removes it.

The lock is the operating system's lock of the folder, which ends with the process. The file
``.lock`` names the host, the process and its command; on file systems without such locks, and on
Windows, it is itself the lock, by the library ``filelock``."""

import contextlib
import errno
import os
import shlex
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Optional

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

from ..core.errors import UserError

SUBFOLDERS = ("ckpts", "configs", "code", "save", "tb_logs", "csv_logs")
FILES = ("ckpts/last.ckpt", "configs/parsed.yaml", "cmd.txt")
LOCK_FILE = ".lock"


class FolderInUse(UserError):
    """Raised if another process has locked the folder."""


@dataclass
class RunFolder:
    """The folder of a run, created by this process or found.

    Attributes:
        path: the folder.
        first_made: the topmost folder that was created on the way to it; None if it was there.
        release: releases the lock, which also ends with the process.
        by_file: whether the file in the folder is the lock.
    """

    path: Path
    first_made: Optional[Path] = None
    release: Callable[[], None] = field(default=lambda: None)
    by_file: bool = False

    def discard(self) -> None:
        """Remove the folder if this process created it, and the parents that were created with it
        if they are empty.
        """
        first, self.first_made = self.first_made, None
        if first is None:
            return
        with contextlib.suppress(OSError):  # another run has put something there
            if self.by_file:  # later it would remove that of another run; Windows: it is open
                self.release()
            unused = self.path.with_name(f".{self.path.name}-{os.getpid()}")
            try:
                self.path.rename(unused)
                self.release()
            except OSError:  # a file system that renames no folders
                if self.by_file:  # another run may have locked it by now
                    raise
                unused = self.path
            shutil.rmtree(unused, ignore_errors=True)
            self.release()
            for folder in self.path.parents:
                if not folder.is_relative_to(first):
                    break
                folder.rmdir()


def claim_new(path: Path) -> tuple[RunFolder, int]:
    """Create and lock the first of ``path``, ``path-2``, ``path-3``, ... that doesn't exist.

    Returns:
        the folder, and the number in its name; 1 for none.

    Raises:
        UserError: no folder can be created there.
    """
    for number in count(1):
        candidate = path.with_name(f"{path.name}-{number}") if number > 1 else path
        first_made = make_folder(candidate)
        if first_made is not None:
            with contextlib.suppress(FolderInUse):  # another run has locked it in the meantime
                return RunFolder(candidate, first_made, *_lock(candidate)), number
    raise AssertionError("unreachable")


def claim(
    path: Path, busy: str = "another run is training", advice: str = ", or choose another tag"
) -> RunFolder:
    """Create ``path`` unless it exists, and lock it.

    Args:
        busy: what the message says of a process that uses it.
        advice: what can be done about it beside waiting.

    Raises:
        FolderInUse: another process uses it.
        UserError: no folder can be created there.
    """
    while True:
        first_made = make_folder(path)
        try:
            return RunFolder(path, first_made, *_lock(path))
        except FileNotFoundError:  # the run that created it has just removed it
            continue
        except FolderInUse as error:
            raise FolderInUse(
                f"{busy} in {path}{_holder(path)}: wait until it ends{advice}{error}"
            ) from error


def make_folder(path: Path) -> Optional[Path]:
    """Create a folder and its missing parents. ``mkdir`` is atomic, so of several processes exactly
    one creates ``path``.

    Returns:
        the topmost created folder, or None if ``path`` existed already.

    Raises:
        UserError: it can't be created.
    """
    for attempt in count(1):
        try:
            missing = [folder for folder in (path, *path.parents) if not folder.exists()]
            path.mkdir(parents=True)
            return missing[-1] if missing else path
        except (OSError, ValueError) as error:
            if isinstance(error, FileExistsError) and path.is_dir():
                return None
            # another run may have just removed a parent that it had created
            if not isinstance(error, FileNotFoundError) or attempt == 10:
                raise unwritable(path, error) from error
    raise AssertionError("unreachable")


def require_writable(folder: Path, option: str = "exp_root_dir") -> None:
    """Check that a run could write its results into ``folder``, which may not exist yet.

    Args:
        option: what chooses the folder, for the message.

    Raises:
        UserError: the nearest existing folder can't be written, or something is in the place of a
            file or folder of the results.
    """
    try:
        parents = (folder, *folder.absolute().parents)
        with tempfile.TemporaryFile(dir=next(p for p in parents if p.exists())) as file:
            file.write(b"0")
        for name in (*SUBFOLDERS, *FILES):
            path, wanted = folder / name, "folder" if name in SUBFOLDERS else "file"
            fits = path.is_dir() if name in SUBFOLDERS else path.is_file()  # no FIFO
            # these two are replaced by renaming, also if they are protected or a broken link
            is_replaced = name in FILES[:2]
            exists = path.exists() if is_replaced else os.path.lexists(path)
            if exists and not (fits and (is_replaced or os.access(path, os.W_OK))):
                raise OSError(errno.EEXIST, f"{path} is no writable {wanted}")
    except (OSError, ValueError) as error:
        raise unwritable(folder, error, option) from error


def unwritable(folder: Path, error: Exception, option: str = "exp_root_dir") -> UserError:
    """Make the error for a folder into which the results can't be written."""
    why = getattr(error, "strerror", None) or str(error)
    return UserError(f"the output folder {folder} can't be written: {why}; choose another {option}")


def _holder(folder: Path) -> str:
    """Return, in brackets, which process has locked a folder; "" if that isn't known."""
    with contextlib.suppress(OSError, ValueError):
        text = (folder / LOCK_FILE).read_text(encoding="utf-8", errors="replace")
        host, process, command = text.split(" ", 2)
        return f" (process {process} on {host}: {command})"
    return ""


def _lock(path: Path) -> tuple[Callable[[], None], bool]:
    """Lock a folder, and return what releases it, and whether its file is the lock.

    Raises:
        FolderInUse: another process has locked it; the message is further advice.
        FileNotFoundError: it was removed before it was locked.
        UserError: it can't be opened, or no lock file can be written.
    """
    file = path / LOCK_FILE
    with contextlib.ExitStack() as opened:
        try:
            descriptor = os.open(path, os.O_RDONLY)
            opened.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderInUse("") from error
        except FileNotFoundError:
            raise
        except OSError:  # a file system without locks; Windows, which opens no folder
            return _lock_by_file(file), True
        if not os.path.samestat(os.fstat(descriptor), os.stat(path)):
            raise FileNotFoundError(errno.ENOENT, "replaced by another folder", str(path))
        with contextlib.suppress(OSError):  # it is only for messages
            owner = f"{socket.gethostname()} {os.getpid()} {shlex.join(sys.argv)[:500]}"
            file.write_text(owner, encoding="utf-8")
        opened.enter_context(contextlib.suppress(OSError))  # of a disk that is read-only by then
        opened.callback(file.unlink)
        return opened.pop_all().close, False


def _lock_by_file(file: Path) -> Callable[[], None]:
    """Create the lock file, which exactly one process can."""
    from filelock import SoftFileLock, Timeout

    lock = SoftFileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise FolderInUse(f". If none is, here or on another machine, remove {file}") from error
    except FileNotFoundError:
        raise
    except OSError as error:
        raise unwritable(file.parent, error) from error
    return lock.release
