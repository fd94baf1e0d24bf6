"""The models that the package contains: the name ``toybox``, wherever a model is named.

The folder of any training's export (``toybox/export.py``) can be named in its place. Of either, the
option for a diffusion model takes the sub-folder ``stable-diffusion``, that for a CLIP takes
``clip``, and that for Point-E's weights takes ``points.safetensors``. Digests of the bundled files
detect damage before anything is loaded.
"""

import functools
import hashlib
from pathlib import Path

from ..core.errors import UserError
from ..core.files import atomic_file

NAME = "toybox"
FOLDER = Path(__file__).parents[1] / "assets" / NAME
RECORD, DIGESTS = "training.json", "SHA256SUMS"
"""The export's record of its training, which marks such a folder, and the digests of its other
files in the format of ``sha256sum``.
"""
DIFFUSION, CLIP, POINTS, JUDGE = (
    "stable-diffusion",
    "clip",
    "points.safetensors",
    "judge.safetensors",
)
REINSTALL = (
    "install the package again (pip install --force-reinstall --no-deps "
    "threestudio-gaussiandreamer; in a clone: git checkout -- "
    f"threestudio_gaussiandreamer/assets/{NAME})"
)

UNTRAINED = (
    f"{NAME}: this version of the package contains no trained models; train them (make "
    "train-toybox), export them (python -m threestudio_gaussiandreamer.toybox.export .toybox "
    f"models) and give the folder models instead of {NAME}"
)


def model_part(name: str, part: str) -> str:
    """Return the path of one of the bundled models if ``name`` is their name, or that of one in the
    folder of an export; return any other ``name`` unchanged.

    Args:
        part: DIFFUSION, CLIP, POINTS or JUDGE.

    Raises:
        UserError: a bundled file is missing or damaged; the message says how to install it again,
            or how to train the models if the package has none.
    """
    if name == NAME:
        require_intact(FOLDER, part)
        return str(FOLDER / part)
    folder = Path(name).expanduser()
    return str(folder / part) if _is_export(folder) else name


def _is_export(folder: Path) -> bool:
    try:
        return (folder / RECORD).is_file() and (folder / DIFFUSION).is_dir()
    except (OSError, ValueError):  # the name is too long, or contains NUL
        return False


@functools.lru_cache
def require_intact(folder: Path, part: str) -> None:
    """Compare the files of a part with their digests, once per process.

    Raises:
        UserError: one is missing or differs.
    """
    digests = read_digests(folder)
    for name, expected in digests.items():
        if name.partition("/")[0] == part:
            _require_file(folder / name, expected)
    if not digests:
        raise UserError(UNTRAINED)
    if not any(name.partition("/")[0] == part for name in digests):
        raise UserError(f"the bundled model {str(folder / part)!r} is missing: {REINSTALL}")


def read_digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file by its path below ``folder``; empty without a list."""
    path = folder / DIGESTS
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    pairs = (line.split(maxsplit=1) for line in lines if line.strip())
    return {name: digest for digest, name in pairs}


def write_digests(folder: Path) -> None:
    """Write the list of digests of the files below ``folder``."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != DIGESTS)
    lines = [f"{digest_of(path)}  {path.relative_to(folder).as_posix()}\n" for path in paths]
    with atomic_file(folder / DIGESTS) as file:
        file.write("".join(lines).encode())


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _require_file(path: Path, expected: str) -> None:
    try:
        found = digest_of(path)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"the bundled model file {str(path)!r}: {reason}; {REINSTALL}") from error
    if found != expected:
        raise UserError(f"the bundled model file {str(path)!r} is damaged: {REINSTALL}")
