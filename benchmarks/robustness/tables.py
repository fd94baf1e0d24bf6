"""The measured parts of reports/robustness.md, from fuzz.csv and long_run.json of results/."""

import json
from pathlib import Path

from benchmarks.markdown import markdown, read

RESULTS = Path(__file__).resolve().parents[1] / "results"


def fuzz() -> str:
    """Return inputs, failures, refusals and seconds of each target, and their sums."""
    columns = ("target", "unit", "inputs", "failures", "refused", "seconds")
    rows = read(RESULTS / "fuzz.csv")
    minutes = sum(float(row["seconds"]) for row in rows) / 60
    failures = sum(int(row["failures"]) for row in rows)
    total = f"{failures} failures in {minutes:.0f} minutes of one core, all targets together."
    return f"{total}\n\n{markdown(columns, ([row[column] for column in columns] for row in rows))}"


def damaged_files() -> str:
    """Return how many damaged files were tried, and the failures of all targets."""
    rows = read(RESULTS / "fuzz.csv")
    files = sum(int(row["inputs"]) for row in rows if row["unit"] == "damaged files")
    return f"{files:,}, {sum(int(row['failures']) for row in rows)}"


def long_run() -> str:
    """Return what the interrupted run lost, against the uninterrupted one."""
    run = json.loads((RESULTS / "long_run.json").read_text())
    memory = run["memory"]
    rows = (
        ("steps, a checkpoint every", f"{run['steps']:,}, {run['checkpoint_every']}"),
        ("kills, of them before the first checkpoint of a process",
         f"{run['kills']}, {run['kills_before_a_checkpoint']}"),
        ("checkpointed steps lost", f"{run['written_steps_lost']}"),
        ("partially written files", f"{run['half_written_files']}"),
        ("same final state as the uninterrupted run", "yes" if run["same_final_state"] else "no"),
        ("memory growth of the uninterrupted run, second half",
         f"{memory['mb_per_1000_steps']:.2f} MB per 1000 steps, peak {memory['peak_mb']:.0f} MB"),
        ("duration on one thread", f"{run['minutes']:.0f} minutes"),
    )  # fmt: skip
    return markdown(("the interrupted run", ""), rows)
