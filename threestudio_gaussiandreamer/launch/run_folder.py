"""Choose the name of a run's folder, ``exp_root_dir/name/tag@time``, and the checkpoint for
``resume=auto``. ``folder_lock.py`` creates the folder."""

import hashlib
import os
import re
import shlex
import unicodedata
from collections.abc import Mapping, Sequence
from datetime import datetime
from difflib import get_close_matches
from glob import escape as glob_escape
from pathlib import Path
from typing import Any, Optional

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..core.checkpoint_file import newest_readable
from ..core.errors import UserError
from ..core.options import escape
from ..host import info, warn
from .options import PROGRAM

AUTO = "auto"
"""The value of ``resume`` that means the newest checkpoint."""
SAME = {
    "system.prompt_processor.prompt": None,
    "seed": None,
    "system.guidance_type": None,
    "system.guidance.mesh": None,
    "system.guidance.pretrained_model_name_or_path": None,
    "system.optimizer.name": "Adam",
}
"""Options that a resumed run usually has in common with the one before; the values are the
defaults, None for options that are compared only where both runs give them."""
SIZES = {
    "system.geometry.sh_degree": 0,
    "system.background_type": "gaussiandreamer-background",
    "system.background.mode": "fixed",
}
"""Options that decide which tensors a checkpoint has, and their sizes, and their defaults."""
NAMING = ("exp_root_dir", "name", "tag", "timestamp")
"""Options that name a run's folder."""
PARSED = Path("configs", "parsed.yaml")
"""The merged configuration of a run, in its folder."""
SLUG_BYTES = 64
HASH = r"-[0-9a-f]{8}$"
"""The end of a name that :func:`safe_name` has made."""
SLUG_SOURCE = 1024
"""Characters of a text that its slug is made of: normalising takes quadratic time."""
SLUG_CHARACTERS = "-_.,+=()'! "
WINDOWS_DEVICES = {f"{port}{i}" for port in ("com", "lpt") for i in range(1, 10)}
WINDOWS_DEVICES |= {"con", "prn", "aux", "nul"}


def name_folders(cfg: Any, paths: Sequence[str | os.PathLike] = ()) -> None:
    """Set ``exp_dir``, ``timestamp``, ``trial_name`` and ``trial_dir``. A run that is resumed from
    its ``parsed.yaml`` keeps its folder, also if that has been renamed or copied.

    Args:
        paths: the files that the configuration was merged from.

    Raises:
        UserError: there is neither tag nor timestamp, or a component of the path is invalid.
    """
    tag = safe_name(cfg.tag) if cfg.tag else ""
    cfg.exp_root_dir = escape(_home_expanded(cfg.exp_root_dir))
    name = safe_name(cfg.name)
    cfg.exp_dir = escape(os.path.join(cfg.exp_root_dir, name))
    if name != cfg.name:
        warn(f"name is {cfg.name!r}, which can't be a folder's: the run is in {cfg.exp_dir}")
    cfg.new_folder = cfg.timestamp is None and cfg.use_timestamp and cfg.n_gpus == 1
    if cfg.new_folder:
        cfg.timestamp = datetime.now().strftime("@%Y%m%d-%H%M%S")
    cfg.timestamp = cfg.timestamp or ""
    _require_folder_name(tag, cfg.timestamp)
    _set_trial(cfg, tag + cfg.timestamp)
    if cfg.resume is not None:
        _follow_config(cfg, paths)
    if cfg.resume == AUTO:
        _resume_newest(cfg, tag)
    elif cfg.resume is not None:
        cfg.resume = escape(os.path.expanduser(cfg.resume))
        if get_close_matches(cfg.resume.lower(), [AUTO], cutoff=0.75):
            if not os.path.exists(cfg.resume):
                raise UserError(
                    f"resume={cfg.resume}: there is no such checkpoint; did you mean "
                    f"resume={AUTO}, the newest one of this run?"
                )
        run, here = _run_of(cfg.resume), os.path.abspath(cfg.trial_dir)
        if run.name == cfg.trial_name and not _is_same(str(run), here):
            warn(f"the checkpoint is of the run in {run}; this one writes to {here}")


def _follow_config(cfg: Any, paths: Sequence[str | os.PathLike]) -> None:
    """Let a run continue in the folder of the ``parsed.yaml`` that it is given with, unless an
    override names another folder, or the checkpoint is of another run.
    """
    for path in map(Path, map(os.path.abspath, paths)):
        run = path.parent.parent
        if path != run / PARSED or _is_same(str(run), cfg.trial_dir):
            continue
        stored = _run_files(run).config
        is_own = cfg.resume == AUTO or _is_same(str(_run_of(cfg.resume)), str(run))
        if is_own and all(stored.get(name) == cfg.get(name) for name in NAMING):
            cfg.exp_dir, cfg.trial_name = escape(str(run.parent)), run.name
            cfg.trial_dir = escape(str(run))
            info(f"the run continues in {run}")
            return


def _run_of(checkpoint: str) -> Path:
    """Return the folder of the run that a checkpoint is of."""
    return Path(os.path.abspath(os.path.expanduser(checkpoint))).parent.parent


def changes_since(cfg: Any, options: Mapping[str, Any] = SAME) -> list[str]:
    """Return how some options, given with their defaults, differ from those in the ``parsed.yaml``
    of the run whose checkpoint is resumed; nothing if that can't be read.
    """
    earlier = OmegaConf.create(_run_files(_run_of(cfg.resume)).config)
    try:
        pairs = {
            name: [OmegaConf.select(source, name, default=default) for source in (earlier, cfg)]
            for name, default in (options.items() if earlier else ())
        }
    except OmegaConfBaseException:  # of an interpolation, which only an edited file has
        return []
    changed = {
        name: f"{name} was {old!r}, now it is {new!r}"
        for name, (old, new) in pairs.items()
        if None not in (old, new) and not _is_same(old, new)
    }
    # options of another part say nothing
    return [
        text for name, text in changed.items() if f"{name.rpartition('.')[0]}_type" not in changed
    ]


def _run_files(folder: Path) -> Any:
    """Return the :class:`.run_files.RunFiles` of a run's folder."""
    # only here, since a run that isn't resumed needs no reader
    from ..view.run_files import RunFiles

    return RunFiles(folder)


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
    program = program_anywhere()
    run = folder.absolute()
    device = ["--gpu", gpu] if gpu else []
    parsed, last = run / PARSED, run / "ckpts" / "last.ckpt"
    return shlex.join([*program, "--config", str(parsed), "--train", *device, f"resume={last}"])


def renumber(cfg: Any, count: int) -> None:
    """Name the folder of a new run ``<tag>@<time>-<count>``, if ``<tag>@<time>`` is taken."""
    suffix = f"-{count}"
    cfg.timestamp += suffix
    _set_trial(cfg, cfg.trial_name + suffix)


def _home_expanded(path: str) -> str:
    """Replace a leading ``~`` or ``~user`` by that home folder."""
    expanded = os.path.expanduser(path)
    if expanded.startswith("~"):
        raise UserError(
            f"exp_root_dir is {path!r}, and there is no such user; for a folder of this name write "
            f"{'./' + path!r}"
        )
    if "://" in expanded:
        raise UserError(
            f"exp_root_dir is {path!r}; a single run writes to a folder, and only the farm to a "
            "URL (docs/farm.md)"
        )
    return expanded


def _require_folder_name(tag: str, timestamp: str) -> None:
    """Raise UserError unless ``tag + timestamp`` names one folder below the run's ``exp_dir``."""
    if not tag + timestamp:
        raise UserError(
            "a run needs a tag when use_timestamp is false, and with several GPUs: its folder has "
            "no time in its name then"
        )
    if set(timestamp) & set("/\\\0") or tag + timestamp in (os.curdir, os.pardir):
        raise UserError(
            f"timestamp is {timestamp!r}; expected a part of a folder's name, such as "
            "@20260131-235959"
        )


def safe_name(text: str) -> str:
    """Convert ``text`` to a valid folder name: unchanged if it is valid on all systems and at most
    64 bytes long, else a slug of at most 64 bytes and a hash of the text. A name that this function
    has returned stays as it is, since a farm's worker passes its asset's name as a run's tag.

    Valid characters are letters, digits, ``-_.,+=()'!`` and inner spaces. A name may not begin with
    a dot or hyphen or end with a dot, or be that of a Windows device."""
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
    # Windows ignores what follows a dot, and reads a raised digit as that digit
    device = unicodedata.normalize("NFKC", slug.split(".")[0]).strip().lower()
    return f"_{slug}"[:most_bytes] if device in WINDOWS_DEVICES else slug


def _set_trial(cfg: Any, trial_name: str) -> None:
    cfg.trial_name = trial_name
    cfg.trial_dir = escape(os.path.join(cfg.exp_dir, trial_name))


def _resume_newest(cfg: Any, tag: str) -> None:
    """Resolve ``resume=auto`` to the checkpoint of this run's own folder, else to that of the
    newest run with the same tag, else to None.
    """
    cfg.resume = None
    newest_first = sorted(Path(cfg.exp_dir).glob(f"{glob_escape(tag)}@*"), reverse=True)
    for run in [Path(cfg.trial_dir), *newest_first]:
        found = newest_readable(run / "ckpts")
        if found:
            cfg.new_folder = False
            if run != Path(cfg.trial_dir):
                cfg.timestamp = run.name.removeprefix(tag)
                _set_trial(cfg, run.name)
            path, step = found
            cfg.resume = escape(str(path))
            info(f"resume=auto: resuming from {path} (step {step})")
            return
    info(
        f"resume=auto: no checkpoint of {os.path.join(cfg.exp_dir, tag)} to resume; starting from "
        "the prior"
    )
