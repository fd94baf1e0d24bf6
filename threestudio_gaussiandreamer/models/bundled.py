"""The models that the package contains: the name ``toybox``, wherever a model is named, or in its
place the folder of a training's export (``toybox/export.py``). Of either, each option takes its
part. Digests of the files detect damage before anything is loaded."""

import contextlib
import functools
import hashlib
import os
import re
from pathlib import Path

from ..core.errors import UserError
from ..core.files import write_file

NAME = "toybox"
FOLDER = Path(__file__).parents[1] / "assets" / NAME
RECORD, DIGESTS = "training.json", "SHA256SUMS"
"""The record of the training, which marks an export, and its digests as of ``sha256sum``."""
LINE = re.compile(rb"([0-9a-f]{64})  (.+)")
DIFFUSION, CLIP = "stable-diffusion", "clip"
POINTS, JUDGE = "points.safetensors", "judge.safetensors"
MOTION, BODY = "motion/model.pt", "body.npz"
WORDS_FILE = "tokenizer/words.txt"
"""Where a model may list the words that it was trained on; published models have no such file."""
REINSTALL = (
    "install the package again (pip install --force-reinstall --no-deps "
    "threestudio-gaussiandreamer; in a clone: git checkout -- "
    f"threestudio_gaussiandreamer/assets/{NAME})"
)
EXPORT_AGAIN = (
    "write the folder again (python -m threestudio_gaussiandreamer.toybox.export); if you changed "
    f"it yourself, delete its {DIGESTS}"
)


def model_part(name: str, part: str) -> str:
    """Return the path of a part, DIFFUSION, CLIP, POINTS ..., if ``name`` is the bundled models or
    an export, else ``name``. Raise UserError if a file is missing or damaged.
    """
    if name == NAME:
        require_intact(FOLDER, part)
        return str(FOLDER / part)
    folder = Path(name).expanduser()
    if not is_export(folder):
        return name
    if (folder / DIGESTS).is_file():
        require_intact(folder, part)
    return str(folder / part)


def is_export(folder: Path) -> bool:
    """Return whether ``toybox/export.py`` wrote this folder."""
    try:
        return (folder / RECORD).is_file() and (folder / DIFFUSION).is_dir()
    except (OSError, ValueError):  # the name is too long, or contains NUL
        return False


@functools.lru_cache
def require_intact(folder: Path, part: str) -> None:
    """Compare the files of a part with their digests, once per process."""
    digests = read_digests(folder)
    names = [name for name in digests if name.partition("/")[0] == part.partition("/")[0]]
    is_needed = folder == FOLDER or (folder / part).exists()  # an export needn't have all parts
    for name in names or [part] * is_needed:
        with contextlib.suppress(OSError):
            if digest_of(folder / name) == digests.get(name):
                continue
        path, remedy = str(folder / name), REINSTALL if folder == FOLDER else EXPORT_AGAIN
        raise UserError(f"the file {path!r} is missing or damaged: {remedy}")


def read_digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file by its path below ``folder``; empty without a whole list."""
    try:
        found = [LINE.fullmatch(line) for line in (folder / DIGESTS).read_bytes().splitlines()]
        return {os.fsdecode(line[2]): line[1].decode() for line in found}
    except (OSError, TypeError):  # TypeError: a line of another form
        return {}


def write_digests(folder: Path) -> None:
    """Write the list of digests of the files below ``folder``."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != DIGESTS)
    lines = [f"{digest_of(path)}  {path.relative_to(folder).as_posix()}\n" for path in paths]
    write_file(folder / DIGESTS, "".join(lines))


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
