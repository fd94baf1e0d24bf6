"""Parts of ``gpu_check`` in processes of their own, each with a time limit."""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

SECONDS = {
    "about": 60,
    "first_picture": 60,
    "comparison": 60,
    "errors": 120,
    "fallback": 60,
    "sanitize": 90,
    "speed": 60,
    "pip": 90,
    "gsplat_steps": 240,
    "prune_twice": 90,
    "make_model": 100,
    "train_steps": 150,
    "demo_runs": 150,
}
"""Time limit of each part."""


def guarded(
    section: Callable[[argparse.Namespace], dict[str, Any]], args: argparse.Namespace
) -> dict[str, Any]:
    """Return a section's result, or why it failed."""
    try:
        return section(args)
    except Exception as error:
        traceback.print_exc()
        return {"failed": f"{type(error).__name__}: {error}"[-2000:]}


def failures(found: Any) -> Iterator[str]:
    """Return all entries called "failed", at any depth."""
    for key, value in found.items() if isinstance(found, dict) else ():
        yield from [str(value)] if key == "failed" else failures(value)


def run(
    command: list[str], args: argparse.Namespace, limit: float, environment: dict[str, str]
) -> tuple[int, str]:
    """Return exit status and output of a command. Neither it nor its children outlive the limit.

    Raises:
        RuntimeError: it took too long, or there was no time for it.
    """
    limit = min(limit, args.deadline - time.monotonic())
    if limit <= 0:
        raise RuntimeError(f"the {args.minutes:g} minutes were over before {' '.join(command)}")
    with tempfile.TemporaryFile() as output:  # a pipe would stay open in a grandchild
        options = {
            "env": os.environ | environment,
            "stdout": output,
            "stderr": subprocess.STDOUT,
            "start_new_session": True,
        }
        process = subprocess.Popen(command, **options)
        try:
            status = process.wait(limit)
        except subprocess.TimeoutExpired:
            status = None
        finally:
            end_group(process)
        output.seek(0)
        text = output.read().decode(errors="replace")
    if status is None:
        raise RuntimeError(f"{' '.join(command)} took more than {limit:.0f} s: {text[-1500:]}")
    return status, text


def end_group(process: subprocess.Popen) -> None:
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.wait()


def in_process(
    name: str, args: argparse.Namespace, environment: dict[str, str] | None = None
) -> dict[str, Any]:
    """Return a part's result.

    Raises:
        RuntimeError: it failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "found.json"
        status, text = run(part_command(name, args, found), args, SECONDS[name], environment or {})
        if status:
            raise RuntimeError(f"{name} ended with {status}: {text[-1500:]}")
        return json.loads(found.read_text())


def part_command(name: str, args: argparse.Namespace, out: Path) -> list[str]:
    size = ["--small"] if args.small else []
    return [
        sys.executable,
        "-u",
        "-m",
        "benchmarks.splatting.gpu_check",
        "--only",
        name,
        "--device",
        args.device,
        "--out",
        str(out),
        *size,
    ]
