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
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import NamedTuple, Optional

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

from ..core.errors import UserError

SUBFOLDERS = ("ckpts", "configs", "code", "save", "tb_logs", "csv_logs")
FILES = ("ckpts/last.ckpt", "configs/parsed.yaml", "cmd.txt")
LONGEST_RESULT = 80
"""Upper bound of the length of paths that a run writes below its folder, bytes."""
LOCK_FILE = ".lock"
"""Name of the lock file."""


class Lock(NamedTuple):
    """A lock on a folder."""

    release: Callable[[], None]
    by_file: bool = False
    """Whether the file in the folder is the lock."""


class RunFolder:
    """The folder of a run, created by this process or found.

    Attributes:
        path: the folder.
        first_made: the topmost folder that :func:`make_folder` made on the way to it; None if the
            folder was there before.
        lock: None where it isn't locked.
    """

    def __init__(
        self, path: Path, first_made: Optional[Path] = None, lock: Optional[Lock] = None
    ) -> None:
        self.path, self.first_made, self.lock = path, first_made, lock

    def discard(self) -> None:
        """Remove the folder if this process created it, and the parents that were created with it
        if they are empty. If the folder isn't locked, it is removed only if it is empty.
        """
        if self.first_made is None:
            return
        with contextlib.suppress(OSError):  # not empty: another run has put something there
            if self.lock is not None:
                unused = self.path
                if self.lock.by_file:  # Windows removes no open file
                    self.release()
                    unused = unused.rename(unused.with_name(f".{unused.name}-{os.getpid()}"))
                shutil.rmtree(unused, ignore_errors=True)
            for folder in (self.path, *self.path.parents):
                if folder == self.first_made.parent:
                    break
                if folder.exists():
                    folder.rmdir()

    def release(self) -> None:
        """Release the lock. The operating system's lock also ends with the process."""
        if self.lock is not None:
            self.lock.release()
            self.lock = None


def claim_new(path: Path) -> tuple[RunFolder, int]:
    """Make and lock the first of ``path``, ``path-2``, ``path-3``, ... that doesn't exist.

    Returns:
        the folder, and the number in its name; 1 for none.

    Raises:
        UserError: no folder can be made there.
    """
    for number, candidate in enumerate(numbered(path), 1):
        first_made = make_folder(candidate)
        if first_made is not None:
            with contextlib.suppress(FolderInUse):  # another run has locked it in the meantime
                return RunFolder(candidate, first_made, _lock(candidate)), number
    raise AssertionError("unreachable")


def numbered(path: Path) -> Iterator[Path]:
    """Yield ``path``, ``path-2``, ``path-3``, ..."""
    yield path
    yield from (path.with_name(f"{path.name}-{number}") for number in count(2))


def claim(
    path: Path,
    busy: str = "another run is training",
    advice: str = ", or choose another tag",
) -> RunFolder:
    """Create ``path`` unless it exists, and lock it.

    Args:
        busy: what the message says of a process that uses it.
        advice: what can be done about it beside waiting.

    Raises:
        FolderInUse: another process uses it.
        UserError: no folder can be made there.
    """
    while True:
        first_made = make_folder(path)
        try:
            return RunFolder(path, first_made, _lock(path))
        except FileNotFoundError:  # the run that created it has just removed it
            continue
        except FolderInUse as error:
            raise FolderInUse(
                f"{busy} in {path}{_holder(path)}: wait until it ends{advice}{error}"
            ) from error


def free_number(folder: Path) -> int:
    """Return the smallest number from 2 on with which no folder of earlier results is named."""
    taken = {path.name for path in folder.glob("*-*")}
    return next(n for n in count(2) if not taken & {f"ckpts-{n}", f"save-{n}"})


def set_results_aside(folder: Path, number: int) -> Optional[Path]:
    """Rename ``save`` to ``save-<number>`` if it has results: the page of a run shows the cloud of
    the latest step. The prior's points, which may serve again, are copied.

    Returns:
        the new path; None if it wasn't renamed.

    Raises:
        UserError: the points can't be copied, for instance since the disk is full; everything is
            left in its place.
    """
    save, fresh = folder / "save", folder / "save-new"
    if not any(save.glob("it*")):
        return None
    try:
        shutil.rmtree(fresh, ignore_errors=True)  # of a process that was killed here
        if (save / "prior").is_dir():
            shutil.copytree(save / "prior", fresh / "prior")
    except OSError as error:
        shutil.rmtree(fresh, ignore_errors=True)
        # copytree lists the files that it couldn't copy
        listed = error.args[0] if isinstance(error, shutil.Error) else ()
        why = listed[0][2] if listed else error.strerror
        raise UserError(
            f"cannot copy the prior's points from {save / 'prior'}: {why}; make room, or choose "
            "another exp_root_dir or tag. The earlier run's results are in their place."
        ) from error
    aside = save.rename(folder / f"save-{number}")
    if fresh.is_dir():
        fresh.rename(save)
    return aside


def set_checkpoints_aside(folder: Path, number: int) -> Optional[Path]:
    """Rename ``ckpts`` to ``ckpts-<number>`` if it has checkpoints, which resume=auto could take.

    Returns:
        the new path; None if it wasn't renamed.
    """
    if not has_checkpoints(folder):
        return None
    return (folder / "ckpts").rename(folder / f"ckpts-{number}")


def has_checkpoints(folder: Path) -> bool:
    """Return whether a run's folder has checkpoints."""
    return any((folder / "ckpts").glob("*.ckpt"))


def make_folder(path: Path) -> Optional[Path]:
    """Create a folder and its missing parents. ``mkdir`` is atomic, so of several processes exactly
    one creates ``path``.

    Returns:
        the topmost created folder, or None if ``path`` existed already.

    Raises:
        UserError: it can't be created.
    """
    try:
        missing = [folder for folder in (path, *path.parents) if not folder.exists()]
        _make_parent(path)
        path.mkdir()
        return missing[-1] if missing else path
    except FileExistsError as error:
        if path.is_dir():
            return None
        raise unwritable(path, error) from error
    except (OSError, ValueError) as error:
        raise unwritable(path, error) from error


def _make_parent(path: Path, attempts: int = 10) -> None:
    for attempt in range(attempts):
        try:
            return path.parent.mkdir(parents=True, exist_ok=True)
        except FileNotFoundError:  # another run has just removed a parent that it had created
            if attempt == attempts - 1:
                raise


def require_writable(folder: Path, option: str = "exp_root_dir") -> None:
    """Check that a run could write its results into ``folder``, which may not exist yet.

    Args:
        option: what chooses the folder, for the message.

    Raises:
        UserError: the nearest existing folder can't be written, a file or folder that a run writes
            can't be replaced, or the paths would be too long.
    """
    existing: Optional[Path] = None
    try:
        existing = next(
            parent for parent in (folder, *folder.absolute().parents) if parent.exists()
        )
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(b"0")
        _require_replaceable(folder)
        _require_short(folder.absolute(), existing)
    except (OSError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise unwritable(folder, error, f" ({existing})" if existing else "", option) from error


def _require_replaceable(folder: Path) -> None:
    """Raise OSError if a path that a run writes exists, but can't be replaced.

    A path for a folder must be a writable folder, and a path for a file a regular file: writing to
    a FIFO waits for a reader.
    """
    for name in SUBFOLDERS:
        path = folder / name
        if path.is_dir() and not os.access(path, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        if (path.exists() or path.is_symlink()) and not path.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, f"{path} is no folder")
    for name in FILES:
        if (folder / name).exists() and not (folder / name).is_file():
            raise IsADirectoryError(errno.EISDIR, f"{folder / name} is no file")


def _require_short(folder: Path, existing: Path) -> None:
    """Raise OSError if paths of files in the folder would exceed the system's limits."""
    longest = os.pathconf(existing, "PC_PATH_MAX") if hasattr(os, "pathconf") else 260
    if len(os.fsencode(folder)) + LONGEST_RESULT > longest:
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))


def unwritable(
    folder: Path, error: Exception, where: str = "", option: str = "exp_root_dir"
) -> UserError:
    """Make the error for a folder into which the results can't be written."""
    why = getattr(error, "strerror", None) or str(error)
    return UserError(
        f"the output folder {folder} can't be written: {why}{where}; choose another {option}"
    )


class FolderInUse(UserError):
    """Raised if another process has locked the folder."""


def _holder(folder: Path) -> str:
    """Return, in brackets, which process has locked a folder; "" if that isn't known."""
    with contextlib.suppress(OSError):
        text = (folder / LOCK_FILE).read_text(encoding="utf-8", errors="replace")
        host, process, command = [*text.split(" ", 2), "", "", ""][:3]
        if process.isdecimal() and command:
            return f" (process {process} on {host}: {command})"
    return ""


def _lock(path: Path) -> Lock:
    """Lock a folder.

    Raises:
        FolderInUse: another process has locked it; the message is further advice.
        FileNotFoundError: it was removed before it was locked.
        UserError: it can't be opened, or no lock file can be written.
    """
    file = path / LOCK_FILE
    if fcntl is None:
        return _lock_by_file(file)
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError as error:
        raise unwritable(path, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not os.path.samestat(os.fstat(descriptor), os.stat(path)):
            raise FileNotFoundError(errno.ENOENT, "replaced by another folder", str(path))
    except OSError as error:
        os.close(descriptor)
        if isinstance(error, FileNotFoundError):
            raise
        if isinstance(error, BlockingIOError):
            raise FolderInUse("") from error
        return _lock_by_file(file)  # a file system without locks
    with contextlib.suppress(OSError):  # it is only for messages
        owner = f"{socket.gethostname()} {os.getpid()} {shlex.join(sys.argv)[:500]}"
        file.write_text(owner, encoding="utf-8")

    def release() -> None:
        with contextlib.suppress(OSError):
            file.unlink()
        os.close(descriptor)

    return Lock(release)


def _lock_by_file(file: Path) -> Lock:
    """Create the lock file, which exactly one process can.

    Raises:
        FolderInUse: another process has created it, and may still run.
        FileNotFoundError: the folder was removed.
        UserError: the file can't be created.
    """
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
    return Lock(lock.release, by_file=True)
