"""The folder of a run: ``exp_root_dir/name/tag@time``, and the checkpoint that ``resume=auto`` goes
on from."""

import hashlib
import os
import unicodedata
from datetime import datetime
from glob import escape as glob_escape
from pathlib import Path
from typing import Any

from ..core.checkpoint_file import newest_readable
from ..core.errors import UserError
from ..core.interpolation import escape
from ..host import info

SLUG_BYTES = 64
SLUG_CHARACTERS = "-_.,+=()'! "
WINDOWS_DEVICES = {
    "con",
    "prn",
    "aux",
    "nul",
    *(f"{port}{i}" for port in ("com", "lpt") for i in range(1, 10)),
}


def name_folders(cfg: Any) -> None:
    """``exp_root_dir/name/tag@time``; a run that is resumed from its ``parsed.yaml`` keeps its
    time, and so its folder.
    """
    if not cfg.tag and not cfg.use_timestamp:
        raise UserError("a run needs a tag when use_timestamp is false: both name its folder")
    if "\0" in cfg.exp_root_dir:
        raise UserError(f"exp_root_dir is {cfg.exp_root_dir!r}; no folder's name has a NUL")
    tag = safe_name(cfg.tag) if cfg.tag else ""
    cfg.exp_dir = escape(os.path.join(cfg.exp_root_dir, safe_name(cfg.name)))
    if cfg.timestamp is None:
        cfg.timestamp = (
            _new_timestamp(os.path.join(cfg.exp_dir, tag))
            if cfg.use_timestamp and cfg.n_gpus == 1
            else ""
        )
    _set_trial(cfg, tag + cfg.timestamp)
    if cfg.resume == "auto":
        _resume_newest(cfg, tag)


def safe_name(text: str) -> str:
    """``text`` as one folder name: itself if it is harmless, else a slug of at most 64 bytes and a
    hash of the text.

    Harmless means letters, digits and ``-_.,+=()'!`` or inner spaces, no leading dot or hyphen, and
    no device of Windows."""
    slug = "".join(
        c if c.isalnum() or c in SLUG_CHARACTERS else "_"
        for c in unicodedata.normalize("NFC", text)
    )
    slug = slug.encode()[:SLUG_BYTES].decode(errors="ignore").lstrip("-. ").rstrip(". ")
    if slug and slug == text and slug.split(".")[0].lower() not in WINDOWS_DEVICES:
        return slug
    return f"{slug or 'run'}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _set_trial(cfg: Any, trial_name: str) -> None:
    cfg.trial_name = trial_name
    cfg.trial_dir = escape(os.path.join(cfg.exp_dir, trial_name))


def _new_timestamp(prefix: str) -> str:
    timestamp = datetime.now().strftime("@%Y%m%d-%H%M%S")
    # two runs of one prompt that start within the same second
    count = 1
    while os.path.exists(prefix + timestamp + (f"-{count}" if count > 1 else "")):
        count += 1
    return timestamp + (f"-{count}" if count > 1 else "")


def _resume_newest(cfg: Any, tag: str) -> None:
    """``resume=auto``: go on with this run if it was started before, else with the newest of its
    tag, else start.

    In its folder it is the readable checkpoint with most steps: where the last one is damaged, the
      one before it.
    """
    cfg.resume = None
    newest_first = sorted(Path(cfg.exp_dir).glob(f"{glob_escape(tag)}@*"), reverse=True)
    for run in [Path(cfg.trial_dir), *newest_first]:
        found = newest_readable(run / "ckpts")
        if found:
            cfg.timestamp = run.name.removeprefix(tag)
            _set_trial(cfg, run.name)
            path, step = found
            cfg.resume = escape(str(path))
            info(f"resume=auto: going on from {path} (step {step})")
            return
    info(
        f"resume=auto: no checkpoint of {os.path.join(cfg.exp_dir, tag)} to go on from; "
        "starting anew"
    )
