"""What a run has made: the content of an asset's ``result.json``."""

import contextlib
import hashlib
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Optional

from ..models.loaded import load_counts
from .recipe import Job

NOT_EXPORTED = (".json", ".html", ".png")
"""Reports and pages beside the exported files, which may hold times."""
PICTURES = ("it*-export/poster.png", "it*-test/0.png", "it*.png")


def result_of(job: Job, folder: Path, run: Any) -> dict[str, Any]:
    """Return what a finished run has made, and where."""
    geometry = run.system.geometry
    pictures = (newest(folder, pattern) for pattern in PICTURES)
    return {
        "key": job.row.key,
        "hash": digest(folder),
        "files": [path.relative_to(folder).as_posix() for path in exported(folder)],
        "picture": next(filter(None, pictures), None),
        "page": newest(folder, "it*-export/view.html"),
        "scores": scores(folder),
        "steps": run.trainer.global_step,
        "gaussians": len(geometry) if hasattr(geometry, "__len__") else 0,
        "megabytes": peak_megabytes(),
        "bytes": sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
        "saves_memory": job.saves_memory,
        "host": socket.gethostname(),
        "process": os.getpid(),
        "loads": load_counts(),
    }


def exported(folder: Path) -> Iterator[Path]:
    """Yield the exported files of an asset, sorted."""
    found = folder.glob("save/it*-export/**/*")
    yield from sorted(p for p in found if p.is_file() and p.suffix not in NOT_EXPORTED)


def digest(folder: Path) -> str:
    """Return the digest of the names and contents of the exported files, which a single run of the
    same arguments reproduces.
    """
    total = hashlib.sha256()
    for path in exported(folder):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return total.hexdigest()


def newest(folder: Path, pattern: str) -> Optional[str]:
    """Return the last of the files below ``save`` with this pattern, relative to ``folder``."""
    found = sorted(folder.glob(f"save/{pattern}"))
    return found[-1].relative_to(folder).as_posix() if found else None


def scores(folder: Path) -> dict[str, float]:
    """Return the numbers that a run has measured on its result."""
    try:
        measured = json.loads((folder / "save" / "metrics.json").read_bytes())["result"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    names = ("psnr", "ssim", "multi_face")
    return {name: measured[name] for name in names if isinstance(measured.get(name), (int, float))}


def reset_peak_memory() -> None:
    """Begin to measure the peak of this process's memory (Linux), or of the GPU's."""
    import torch

    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def peak_megabytes() -> float:
    """Return the peak since :func:`reset_peak_memory`, of the GPU where there is one."""
    import torch

    if torch.cuda.is_available():
        return round(torch.cuda.max_memory_allocated() / 2**20, 1)
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    peaks = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")]
    return round(int(peaks[0]) / 1024, 1) if peaks else 0.0
