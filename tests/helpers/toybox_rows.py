"""Rows of docs/charts/toybox.csv."""

from benchmarks.quality import toybox_jobs, toybox_tables
from benchmarks.quality.toybox_jobs import DEFAULT


def row(**changes: str) -> dict[str, str]:
    """Return a present row of toybox.yaml in which all is recognised, with these changes."""
    right = dict.fromkeys([*toybox_tables.RECOGNIZED, "haze", "gaussians", "cpu_seconds"], "1")
    right |= {"variant": DEFAULT, "x": "0", "index": "0", "seed": "0", "prompt": "a red fox"}
    return right | {"setup": toybox_jobs.setup(), "judge": toybox_jobs.judge_of()} | changes
