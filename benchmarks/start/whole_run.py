"""Seconds and memory of whole runs of configs/toybox.yaml, from the command to the finished cloud.

    python -m benchmarks.start.whole_run

Runs ``launch.py`` in processes of its own, with as many threads as it takes by itself, and appends
to ``benchmarks/results/whole_run.csv``: seconds of the clock, those until the prior's points are
written, processor seconds of all threads, and the largest resident memory. Other programs on the
machine make the seconds longer.
"""

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.quality.runs import ROOT, commit, machine

RESULTS = ROOT / "benchmarks/results/whole_run.csv"
COLUMNS = "configuration,prompt,seconds,prior_seconds,cpu_seconds,peak_mb,cores,machine,commit"
CONFIGURATIONS = {
    "toybox.yaml": ["--config", "toybox.yaml"],
    "toybox.yaml, toybox-draft.yaml": ["--config", "toybox.yaml", "--config", "toybox-draft.yaml"],
}
PROMPT = "a red fox with a green scarf"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3, help="of each configuration, in turn")
    arguments = parser.parse_args()
    begins = not RESULTS.is_file()
    with open(RESULTS, "a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS.split(","), lineterminator="\n")
        if begins:
            writer.writeheader()
        for _ in range(arguments.repeats):
            for name in CONFIGURATIONS:
                writer.writerow(row := measured(name))
                file.flush()
                print(row)


def measured(name: str) -> dict[str, str]:
    """Run a configuration of CONFIGURATIONS; return its row.

    Raises:
        RuntimeError: the run failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        options = {"exp_root_dir": folder, "name": "runs", "tag": "run", "use_timestamp": "false"}
        options |= {"system.prompt_processor.prompt": PROMPT}
        options |= {"system.prompt_processor.cache_dir": f"{folder}/embeddings"}
        words = [f"{key}={value}" for key, value in options.items()]
        command = [sys.executable, "launch.py", *CONFIGURATIONS[name], "--train", *words]
        began = time.time()
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.time() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError(f"{name}: the run ended with {process.returncode}")
        points = Path(folder) / "runs/run/save/prior/points.npz"
        prior = points.stat().st_mtime - began
    return {
        "configuration": name, "prompt": PROMPT,
        "seconds": f"{seconds:.1f}", "prior_seconds": f"{prior:.1f}",
        "cpu_seconds": f"{usage.ru_utime + usage.ru_stime:.1f}",
        "peak_mb": f"{usage.ru_maxrss / 1000:.0f}", "cores": str(os.cpu_count()),
        "machine": machine(), "commit": commit(),
    }  # fmt: skip


if __name__ == "__main__":
    main()
