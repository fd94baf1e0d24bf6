"""What it costs to share one asset between two processes of the same machine, on the CPU.

    python -m benchmarks.robustness.ddp [--rounds 2] [--steps 200]

Trains the demo for some steps with one process and with two, alternately, each process on one
thread. CPU seconds are those of the steps: of all processes together, and of the busiest training
thread, without the threads that ray cast the target images. Rows go to docs/charts/ddp.csv.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.markdown import markdown, read
from benchmarks.quality.runs import CHARTS, append_rows
from threestudio_gaussiandreamer.host import pl
from threestudio_gaussiandreamer.launch import experiment
from threestudio_gaussiandreamer.launch.options import parse_arguments

ROOT = Path(__file__).resolve().parents[2]
COLUMNS = ("processes", "round", "steps", "gaussians", "all_s", "busiest_s", "machine", "commit")
LEAN = ("pages=false", "evaluation.views=1", "evaluation.size=32", "exporter.save_video=false")


class Meter(pl.Callback):
    """Write the CPU seconds of this process's steps."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_train_batch_start(self, trainer: Any, *others: Any) -> None:
        if trainer.global_step == 0:
            self.start = time.process_time(), time.thread_time()

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        process, thread = self.start
        found = {
            "all_s": time.process_time() - process,
            "busiest_s": time.thread_time() - thread,
            "gaussians": len(pl_module.geometry),
        }
        (self.folder / f"rank{trainer.global_rank}.json").write_text(json.dumps(found))


def train(processes: int, steps: int, folder: Path) -> None:
    """Train the demo; Lightning starts this program again for each further process."""
    overrides = [
        *(f"trainer.devices={processes}", f"trainer.max_steps={steps}", "data.n_test_views=1"),
        *(f"exp_root_dir={folder}", "use_timestamp=false", "tag=run"),
        *("trainer.limit_val_batches=0", "trainer.enable_progress_bar=false"),
        *(f"system.{option}" for option in LEAN),
    ]
    argv = ["--config", str(ROOT / "configs/demo.yaml"), "--train", "--gpu", "cpu", *overrides]
    experiment.prepare(parse_arguments(argv), argv, callbacks=[Meter(folder)]).run()


def run(processes: int, steps: int) -> dict[str, Any]:
    """Train in processes of their own; return the sum and the maximum of their seconds."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", __spec__.name, "--steps", str(steps)]
        done = subprocess.run(
            [*command, "--run", str(processes), "--folder", folder],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise RuntimeError(done.stderr[-3000:])
        found = [json.loads(path.read_text()) for path in Path(folder).glob("rank*.json")]
    return {
        "processes": len(found),
        "steps": steps,
        "gaussians": found[0]["gaussians"],
        "all_s": round(sum(rank["all_s"] for rank in found), 3),
        "busiest_s": round(max(rank["busiest_s"] for rank in found), 3),
    }


def table() -> str:
    """Return CPU seconds a step with one process and with two; medians over the rounds."""
    rows = read(CHARTS / "ddp.csv")
    shown = []
    for processes in sorted({int(row["processes"]) for row in rows}):
        ours = [row for row in rows if int(row["processes"]) == processes]
        milliseconds = [
            statistics.median(1000 * float(row[name]) / int(row["steps"]) for row in ours)
            for name in ("all_s", "busiest_s")
        ]
        shown.append((str(processes), *(f"{value:.1f}" for value in milliseconds)))
    head = (
        "processes",
        "all together, CPU ms a step",
        "the busiest training thread, CPU ms a step",
    )
    return markdown(head, shown)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--run", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        train(arguments.run, arguments.steps, arguments.folder)
        return
    for number in range(arguments.rounds):
        for processes in (1, 2):
            row = {"round": number, **run(processes, arguments.steps)}
            print(row, flush=True)
            append_rows("ddp", list(COLUMNS), [row])


if __name__ == "__main__":
    main()
