"""The folder of a run, ``exp_root_dir/name/tag@time``: its name, the checkpoint for
``resume=auto``, and its lock. Exactly one process creates it, one uses it at a time, and only the
process that created it and still holds the lock removes it.

The lock is the operating system's lock of the folder, which ends with the process. The file
``.lock`` names the host, the process and its command; on file systems without such locks, and on
Windows, it is itself the lock, by the library ``filelock``."""

import contextlib
import errno
import hashlib
import os
import re
import shlex
import shutil
import socket
import sys
import tempfile
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from difflib import get_close_matches
from glob import escape as glob_escape
from itertools import count
from pathlib import Path
from typing import Any, Optional

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

from omegaconf import OmegaConf

from ..core.checkpoint_file import newest_readable
from ..core.errors import UserError
from ..core.logs import info, warn
from ..core.options import escape
from ..view.run_files import read_yaml
from .options import PROGRAM

AUTO = "auto"
SAME = {
    "system.prompt_processor.prompt": None,
    "seed": None,
    "system.guidance_type": None,
    "system.guidance.mesh": None,
    "system.guidance.pretrained_model_name_or_path": None,
    "system.optimizer.name": "Adam",
}
"""Options that a resumed run usually has in common with the one before, and their defaults."""
SIZES = {
    "system.geometry.sh_degree": 0,
    "system.background_type": "gaussiandreamer-background",
    "system.background.mode": "fixed",
}
"""Options that decide which tensors a checkpoint has, and their sizes."""
NAMING = ("exp_root_dir", "name", "tag", "timestamp")
PARSED = Path("configs", "parsed.yaml")
"""The merged configuration of a run, in its folder."""
SLUG_BYTES = 64
HASH = r"-[0-9a-f]{8}$"
SLUG_SOURCE = 1024  # characters that are read: normalising takes quadratic time
SLUG_CHARACTERS = "-_.,+=()'! "
DEVICE = r"(?i)(con|prn|aux|nul|(com|lpt)[1-9\u00b9\u00b2\u00b3]) *(\.|$)"  # a name in Windows
SUBFOLDERS = ("ckpts", "configs", "code", "save", "tb_logs", "csv_logs")
FILES = ("ckpts/last.ckpt", "configs/parsed.yaml", "cmd.txt")  # the first two are replaced
LOCK_FILE = ".lock"


def name_folders(cfg: Any, paths: Sequence[str | os.PathLike] = ()) -> None:
    """Set ``exp_dir``, ``timestamp``, ``trial_name`` and ``trial_dir``; raise UserError if there is
    neither tag nor timestamp, or a component of the path is invalid. A run that is resumed from its
    ``parsed.yaml``, one of ``paths``, keeps its folder, also if that has been renamed or copied.
    """
    given, root = cfg.exp_root_dir, os.path.expanduser(cfg.exp_root_dir)
    if root.startswith("~"):
        raise UserError(f"exp_root_dir is {given!r}, and there is no such user")
    if "://" in root:
        only = "a single run writes to a folder, and only the farm to a URL"
        raise UserError(f"exp_root_dir is {given!r}; {only} (docs/farm.md)")
    tag, name = safe_name(cfg.tag) if cfg.tag else "", safe_name(cfg.name)
    cfg.exp_root_dir = escape(root)
    cfg.exp_dir = escape(os.path.join(cfg.exp_root_dir, name))
    if name != cfg.name:
        warn(f"name is {cfg.name!r}, which can't be a folder's: the run is in {cfg.exp_dir}")
    cfg.new_folder = cfg.timestamp is None and cfg.use_timestamp and cfg.n_gpus == 1
    if cfg.new_folder:
        cfg.timestamp = datetime.now().strftime("@%Y%m%d-%H%M%S")
    cfg.timestamp = cfg.timestamp or ""
    if not tag + cfg.timestamp:
        raise UserError("a run needs a tag when use_timestamp is false, and with several GPUs")
    if set(cfg.timestamp) & set("/\\\0") or tag + cfg.timestamp in (os.curdir, os.pardir):
        expected = "expected a part of a folder's name, such as @20260131-235959"
        raise UserError(f"timestamp is {cfg.timestamp!r}; {expected}")
    _set_trial(cfg, tag + cfg.timestamp)
    if cfg.resume is not None:
        _follow_config(cfg, paths)
    if cfg.resume == AUTO:
        _resume_newest(cfg, tag)
    elif cfg.resume is not None:
        cfg.resume = escape(os.path.expanduser(cfg.resume))
        is_near = get_close_matches(cfg.resume.lower(), [AUTO], cutoff=0.75)
        if is_near and not os.path.exists(cfg.resume):
            raise UserError(f"there is no checkpoint {cfg.resume}; did you mean resume={AUTO}?")
        run, here = _run_of(cfg.resume), os.path.abspath(cfg.trial_dir)
        if run.name == cfg.trial_name and not _is_same(str(run), here):
            warn(f"the checkpoint is of the run in {run}; this one writes to {here}")


def _follow_config(cfg: Any, paths: Sequence[str | os.PathLike]) -> None:
    """Let a run that is resumed from its own ``parsed.yaml`` go on in the folder of that."""
    for path in map(Path, map(os.path.abspath, paths)):
        run = path.parent.parent
        if path != run / PARSED or _is_same(str(run), cfg.trial_dir):
            continue
        stored = read_yaml(path)
        is_own = cfg.resume == AUTO or _is_same(str(_run_of(cfg.resume)), str(run))
        if is_own and all(stored.get(name) == cfg.get(name) for name in NAMING):
            cfg.exp_dir = escape(str(run.parent))
            _set_trial(cfg, run.name)
            info(f"the run continues in {run}")
            return


def _run_of(checkpoint: str) -> Path:
    """Return the folder of the run that a checkpoint is of."""
    return Path(os.path.abspath(os.path.expanduser(checkpoint))).parent.parent


def changes_since(cfg: Any, options: Mapping[str, Any] = SAME) -> list[str]:
    """Return how some options, given with their defaults, differ from those in the ``parsed.yaml``
    of the run whose checkpoint is resumed; nothing if that can't be read.
    """
    earlier, now = read_yaml(_run_of(cfg.resume) / PARSED), OmegaConf.to_container(cfg)
    changed = {}
    for name, default in options.items() if earlier else ():
        old, new = (value_at(source, name, default) for source in (earlier, now))
        if None not in (old, new) and not _is_same(old, new):
            changed[name] = f"{name} was {old!r}, now it is {new!r}"
    parts = {name: f"{name.rpartition('.')[0]}_type" for name in changed}
    # options of another part say nothing
    return [text for name, text in changed.items() if parts[name] not in changed]


def value_at(source: Any, key: str, default: Any = None) -> Any:
    """Return the value at a dotted key of nested dictionaries; ``default`` if there is none."""
    for name in key.split("."):
        source = source.get(name) if isinstance(source, dict) else None
    return default if source is None else source


def _is_same(old: Any, new: Any) -> bool:
    """Return whether two values are equal, or paths of the same file."""
    if old == new or not (isinstance(old, str) and isinstance(new, str)):
        return old == new
    return os.path.realpath(os.path.expanduser(old)) == os.path.realpath(os.path.expanduser(new))


def program_anywhere() -> list[str]:
    """Return how this process was started, valid in any working folder."""
    return [os.path.abspath(part) if part.endswith("launch.py") else part for part in PROGRAM]


def resume_command(folder: Path, gpu: Optional[str]) -> str:
    """Return the command that resumes the run in ``folder``, valid in any working folder."""
    run, device = folder.absolute(), ["--gpu", gpu] if gpu else []
    words = [*program_anywhere(), "--config", str(run / PARSED), "--train", *device]
    return shlex.join([*words, f"resume={run / 'ckpts' / 'last.ckpt'}"])


def renumber(cfg: Any, name: str) -> None:
    """Name the folder of a new run ``<tag>@<time>-<number>``, where ``<tag>@<time>`` is taken."""
    cfg.timestamp += name.removeprefix(cfg.trial_name)
    _set_trial(cfg, name)


def safe_name(text: str) -> str:
    """Convert ``text`` to a valid folder name: unchanged if it is one of at most 64 bytes, or one
    that this function has returned, as a farm's asset; else a slug and a hash of the text.
    """
    hashed = re.search(HASH, text)
    if text and _slug(text, SLUG_BYTES + len(hashed[0]) if hashed else SLUG_BYTES) == text:
        return text
    digest = hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()[:8]
    return f"{_slug(text, SLUG_BYTES) or 'run'}-{digest}"


def _slug(text: str, most_bytes: int) -> str:
    """Return the beginning of ``text`` as a valid folder name, or an empty text."""
    slug = "".join(
        c if c.isalnum() or c in SLUG_CHARACTERS else "_"
        for c in unicodedata.normalize("NFC", text[:SLUG_SOURCE])
    )
    slug = slug.encode()[:most_bytes].decode(errors="ignore").lstrip("-. ").rstrip(". ")
    return f"_{slug}"[:most_bytes] if re.match(DEVICE, slug) else slug


def _set_trial(cfg: Any, trial_name: str) -> None:
    cfg.trial_name = trial_name
    cfg.trial_dir = escape(os.path.join(cfg.exp_dir, trial_name))


def _resume_newest(cfg: Any, tag: str) -> None:
    """Resolve ``resume=auto``: to a checkpoint of this folder, else of the newest of the tag."""
    cfg.resume = None
    newest_first = sorted(Path(cfg.exp_dir).glob(f"{glob_escape(tag)}@*"), reverse=True)
    for run in [Path(cfg.trial_dir), *newest_first]:
        if found := newest_readable(run / "ckpts"):
            cfg.new_folder = False
            if run != Path(cfg.trial_dir):
                cfg.timestamp = run.name.removeprefix(tag)
                _set_trial(cfg, run.name)
            path, step = found
            cfg.resume = escape(str(path))
            info(f"resume=auto: resuming from {path} (step {step})")
            return
    where = os.path.join(cfg.exp_dir, tag)
    info(f"resume=auto: no checkpoint of {where} to resume; starting from the prior")


# -- the lock --------------------------------------------------------------------------------------


class FolderInUse(UserError):
    """Raised if another process has locked the folder."""


@dataclass
class RunFolder:
    """The folder of a run, created by this process or found."""

    path: Path
    first_made: Optional[Path] = None
    """The topmost folder that was created on the way to it; None if it was there."""
    release: Callable[[], None] = field(default=lambda: None)
    by_file: bool = False
    """Whether the file in the folder is the lock."""

    def discard(self) -> None:
        """Remove the folder, and empty parents, if this process created them."""
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


def claim_new(path: Path) -> RunFolder:
    """Create and lock the first of ``path``, ``path-2``, ``path-3``, ... that doesn't exist."""
    for number in count(1):
        candidate = path.with_name(f"{path.name}-{number}") if number > 1 else path
        if (first_made := make_folder(candidate)) is not None:
            with contextlib.suppress(FolderInUse):  # another run has locked it in the meantime
                return RunFolder(candidate, first_made, *_lock(candidate))
    raise AssertionError("unreachable")


def claim(
    path: Path, busy: str = "another run is training", advice: str = ", or choose another tag"
) -> RunFolder:
    """Create ``path`` unless it exists, and lock it; raise UserError if no folder can be created
    there, FolderInUse, with the words ``busy`` and ``advice``, if another process uses it.
    """
    while True:
        first_made = make_folder(path)
        try:
            return RunFolder(path, first_made, *_lock(path))
        except FileNotFoundError:  # the run that created it has just removed it
            continue
        except FolderInUse as error:
            holder = ""
            with contextlib.suppress(OSError, ValueError):
                text = (path / LOCK_FILE).read_text(encoding="utf-8", errors="replace")
                host, process, command = text.split(" ", 2)
                holder = f" (process {process} on {host}: {command})"
            said = f"wait until it ends{advice}{error}"
            raise FolderInUse(f"{busy} in {path}{holder}: {said}") from error


def make_folder(path: Path, attempts: int = 10) -> Optional[Path]:
    """Create a folder and its missing parents; return the topmost created one, None if ``path``
    existed already: of several processes exactly one creates it. Raise UserError if it can't be.
    """
    try:
        missing = [folder for folder in (path, *path.parents) if not folder.exists()]
        path.mkdir(parents=True)
        return missing[-1] if missing else path
    except (OSError, ValueError) as error:
        if isinstance(error, FileExistsError) and path.is_dir():
            return None
        # another run may have just removed a parent that it had created
        if isinstance(error, FileNotFoundError) and attempts > 1:
            return make_folder(path, attempts - 1)
        raise unwritable(path, error) from error


def require_writable(folder: Path, option: str = "exp_root_dir") -> None:
    """Check that a run could write its results into ``folder``, which may not exist yet and which
    ``option`` chooses; raise UserError if the nearest existing folder can't be written, or
    something is in the place of a file or folder of the results.
    """
    try:
        parents = (folder, *folder.absolute().parents)
        with tempfile.TemporaryFile(dir=next(p for p in parents if p.exists())) as file:
            file.write(b"0")
        for name in (*SUBFOLDERS, *FILES):
            path = folder / name
            fits = path.is_dir() if name in SUBFOLDERS else path.is_file()  # no FIFO
            if path.exists() and not (fits and (name in FILES[:2] or os.access(path, os.W_OK))):
                wanted = "folder" if name in SUBFOLDERS else "file"
                raise OSError(errno.EEXIST, f"{path} is no writable {wanted}")
    except (OSError, ValueError) as error:
        raise unwritable(folder, error, option) from error


def unwritable(folder: Path, error: Exception, option: str = "exp_root_dir") -> UserError:
    """Make the error for a folder into which the results can't be written."""
    why = getattr(error, "strerror", None) or str(error)
    return UserError(f"the output folder {folder} can't be written: {why}; choose another {option}")


def _lock(path: Path) -> tuple[Callable[[], None], bool]:
    """Lock a folder, or raise FolderInUse; return what releases it, and whether it is its file."""
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
            from filelock import SoftFileLock, Timeout

            lock = SoftFileLock(file, timeout=0)
            try:
                lock.acquire()
            except Timeout as error:
                only = f". If none is, here or on another machine, remove {file}"
                raise FolderInUse(only) from error
            except FileNotFoundError:
                raise
            except OSError as error:
                raise unwritable(path, error) from error
            return lock.release, True
        if not os.path.samestat(os.fstat(descriptor), os.stat(path)):
            raise FileNotFoundError(errno.ENOENT, "replaced by another folder", str(path))
        with contextlib.suppress(OSError):  # it is only for messages
            owner = f"{socket.gethostname()} {os.getpid()} {shlex.join(sys.argv)[:500]}"
            file.write_text(owner, encoding="utf-8")
        opened.enter_context(contextlib.suppress(OSError))  # of a disk that is read-only by then
        opened.callback(file.unlink)
        return opened.pop_all().close, False
