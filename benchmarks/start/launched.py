"""Runs of a checkout's ``launch.py`` in a new process, with an extension that measures them,
and the options of measurements that compare two checkouts."""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Optional

ROOT = Path(__file__).resolve().parents[2]
MARK = "MEASURED "
"""The extension prints one line of this and a JSON object."""


def run_with_probe(probe: Path, checkout: Path, *overrides: str) -> dict[str, Any]:
    """Train the demo with a checkout on the CPU, in an empty folder, until its extension ends the
    run.

    Args:
        probe: the extension's source.
        checkout: the folder of ``launch.py``.
        overrides: further arguments, such as ``trainer.max_steps=300``.

    Returns:
        the object that the extension printed.

    Raises:
        RuntimeError: the run ended without it.
    """
    command = [sys.executable, checkout / "launch.py", "--config", checkout / "configs/demo.yaml"]
    command += ["--train", "--gpu", "cpu", *overrides]
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    with tempfile.TemporaryDirectory() as folder:
        extension = Path(folder, "custom", "probe")
        extension.mkdir(parents=True)
        shutil.copy(probe, extension / "__init__.py")
        options: dict[str, Any] = {"capture_output": True, "text": True}
        done = subprocess.run([*map(str, command)], cwd=folder, env=environment, **options)
    for line in done.stdout.splitlines():
        if line.startswith(MARK):
            return json.loads(line.removeprefix(MARK))
    raise RuntimeError(f"{checkout} measured nothing:\n{done.stdout}\n{done.stderr}")


def commit_of(checkout: Path) -> str:
    """Return the checkout's commit; "unknown" without git or outside of a repository."""
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True)
    except OSError:  # there is no git
        return "unknown"
    return answer.stdout.strip() or "unknown"


def paired_parser(doc: str, rounds: int) -> argparse.ArgumentParser:
    """Return a parser with ``--against`` and ``--rounds``, which is ``rounds`` by default."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, help="another checkout, such as a git worktree")
    parser.add_argument("--rounds", type=int, default=rounds)
    return parser


def checkouts_of(against: Optional[Path]) -> dict[str, Path]:
    """Return the checkouts to compare: that of ``--against``, if given, and this one."""
    return ({"before": against.resolve()} if against else {}) | {"now": ROOT}
