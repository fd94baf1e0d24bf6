"""Pictures that the toybox's training sees in a second of one core, by stage.

    python -m benchmarks.models.training_rate

Each stage continues from the bundled weights for some CPU seconds, in a temporary folder, with two
shards of pictures, which are rendered before and not counted. ``unet-small``, which isn't bundled,
begins with random weights. Writes ``benchmarks/results/training_rate.csv``.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.markdown import markdown, read, write
from benchmarks.quality.runs import ROOT, commit, machine

RESULTS = ROOT / "benchmarks/results/training_rate.csv"
COLUMNS = ("stage", "images", "cpu_seconds", "machine", "commit")
WARM_UP = 3
"""Steps before the measured ones."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=25, help="of the CPU, of each stage")
    arguments = parser.parse_args()
    import torch

    from threestudio_gaussiandreamer.models.bundled import FOLDER
    from threestudio_gaussiandreamer.toybox.loop import Options, Training
    from threestudio_gaussiandreamer.toybox.train import STAGES
    from threestudio_gaussiandreamer.toybox.warm_start import start_from

    torch.set_num_threads(1)
    common = {"machine": machine(), "commit": commit()}
    with tempfile.TemporaryDirectory() as folder:
        options = Options(folder=Path(folder), pool=2)
        start_from(FOLDER, options, STAGES)
        rows = [
            {"stage": name, **measured(Training(stage(options)), arguments.seconds), **common}
            for name, stage in tqdm(STAGES.items(), unit="stage")
        ]
    write(RESULTS, COLUMNS, rows)


def measured(training: Any, seconds: float) -> dict[str, str]:
    """Train a stage; return the pictures that it saw, and its CPU seconds."""
    batches = training.stage.batches(training.progress.step)
    for _ in range(WARM_UP):
        training.train_step(next(batches))
    seen, start = training.progress.images, time.process_time()
    while time.process_time() - start < seconds:
        training.train_step(next(batches))
    took = time.process_time() - start
    return {"images": str(training.progress.images - seen), "cpu_seconds": f"{took:.1f}"}


def table() -> str:
    """Return pictures per CPU second of each stage, and the hours of its full number of them."""
    from threestudio_gaussiandreamer.toybox.train import STAGES

    rows, total, lines = read(RESULTS), 0.0, []
    for row in rows:
        rate = int(row["images"]) / float(row["cpu_seconds"])
        hours = STAGES[row["stage"]].images / rate / 3600
        total += hours
        lines.append((f"`{row['stage']}`", f"{STAGES[row['stage']].images:,}", f"{rate:.0f}",
                      f"{hours:.1f}"))  # fmt: skip
    head = ("stage", "pictures or prompts", "per second of one core", "hours of one core")
    return f"{markdown(head, [*lines, ('all', '', '', f'{total:.0f}')])}\n\n{rows[0]['machine']}."


if __name__ == "__main__":
    main()
