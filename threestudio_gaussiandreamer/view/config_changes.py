"""Which values of a run's configuration differ from the file that it started from."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from .run_files import read_yaml

SECTIONS = ("data", "system", "trainer", "checkpoint")
USERS = ("name", "tag", "seed", "description", "exp_root_dir", "use_timestamp")
"""Keys at the top level that users set; the others are computed."""
MISSING = "–"


def config_changes(folder: Path) -> list[tuple[str, str, str]]:
    """Return key, value in the base file and value in the run, for those that differ.

    Args:
        folder: ``configs`` of the run: ``raw.yaml``, the file that the run names first, and
            ``parsed.yaml``. Values of the base file that refer to others are left out.
    """
    base = dict(leaves(read_yaml(folder / "raw.yaml")))
    run = dict(leaves(read_yaml(folder / "parsed.yaml")))
    keys = [key for key in run if _is_users(key) and "${" not in _shown(base.get(key))]
    return [
        (key, _shown(base[key]) if key in base else MISSING, _shown(run[key]))
        for key in keys
        if key not in base or base[key] != run[key]
    ]


def leaves(content: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted key and the value of everything that isn't a mapping."""
    for name, value in content.items():
        key = f"{prefix}{name}"
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{key}.")
        else:
            yield key, value


def _is_users(key: str) -> bool:
    return key in USERS or key.partition(".")[0] in SECTIONS


def _shown(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 200 else f"{text[:200]}..."
