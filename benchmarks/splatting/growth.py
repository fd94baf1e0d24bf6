"""How time and memory of the CPU kernel grow with the number of Gaussians, at 1024²:

    python -m benchmarks.splatting.growth [--from-csv]

Forward and backward of one view by one thread, each count in a process of its own: processor
seconds (the smallest of three), and peak memory above the inputs. The scene is that of
bench_splatting.py: the same surface, of which more Gaussians are smaller ones. Writes
``docs/charts/growth.csv`` and ``growth.png``, with the slopes from a million on."""

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from benchmarks.figures import pyplot
from benchmarks.markdown import markdown, read, write
from benchmarks.quality.runs import CHARTS, commit, require_kernel
from benchmarks.splatting.bench_scenes import make_cotangents
from benchmarks.splatting.bench_splatting import (
    contender,
    make_leaves,
    memory_now,
    processor,
    reset_peak,
)

CSV = CHARTS / "growth.csv"
COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000, 4_000_000)
SIZE, ROUNDS = 1024, 3
FROM = 1_000_000  # fewer are dominated by the pixels
MEASURED = ("gaussians", "cpu_seconds", "memory_mb")
PLACE = ("machine", "commit")
PANELS = {"cpu_seconds": "processor seconds", "memory_mb": "peak memory above the inputs, MB"}


def measure_here(gaussians: int) -> dict[str, float]:
    """Measure one count in this process."""
    torch.set_num_threads(1)
    draw = contender("cpu", SIZE, "fast", 1)
    leaves, cotangents, seconds = make_leaves(gaussians), make_cotangents(SIZE), []
    reset_peak()
    before = memory_now("VmRSS")
    for _ in range(ROUNDS):
        for leaf in leaves:
            leaf.grad = None
        start = time.process_time()
        torch.autograd.backward(draw(leaves), cotangents)
        seconds.append(time.process_time() - start)
    return {"cpu_seconds": min(seconds), "memory_mb": memory_now("VmHWM") - before}


def measure(gaussians: int) -> dict[str, Any]:
    """Measure one count in a process of its own; return a row of the CSV."""
    command = [sys.executable, "-m", "benchmarks.splatting.growth", "--count", str(gaussians)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    row = json.loads(done.stdout.splitlines()[-1])
    print(f"{gaussians:>9,}  {row['cpu_seconds']:.3f} CPU s  {row['memory_mb']:.0f} MB", flush=True)
    figures = {name: f"{value:.4g}" for name, value in row.items()}
    return {"gaussians": gaussians} | figures | {"machine": processor(), "commit": commit()}


def slope(rows: Sequence[Mapping[str, Any]], column: str) -> float:
    """Return d log(column) / d log(Gaussians) from ``FROM`` Gaussians on."""
    first, last = next(row for row in rows if float(row["gaussians"]) == FROM), rows[-1]
    rise, run = (math.log(float(last[name]) / float(first[name])) for name in (column, "gaussians"))
    return rise / run


def table() -> str:
    """Return seconds and memory of each number of Gaussians, and how they grow."""
    rows = read(CSV)
    places = "; ".join(dict.fromkeys(f"{row['machine']}, commit {row['commit']}" for row in rows))
    seconds, memory = (f"{slope(rows, column):.2f}" for column in PANELS)
    lines = (
        (
            f"{int(row['gaussians']):,}",
            f"{float(row['cpu_seconds']):.2f}",
            f"{float(row['memory_mb']):.0f}",
        )
        for row in rows
    )
    return (
        f"Measured on {places}. From {FROM:,} to {int(rows[-1]['gaussians']):,} Gaussians the "
        f"logarithms rise with slopes of {seconds} (seconds) and {memory} (memory):\n\n"
        f"{markdown(('Gaussians', 'CPU s', 'peak memory above the inputs, MB'), lines)}"
    )


def draw_chart(rows: Sequence[Mapping[str, Any]]) -> None:
    plt = pyplot()

    figure, panels = plt.subplots(1, 2, figsize=(9, 3.6))
    for panel, (column, title) in zip(panels, PANELS.items(), strict=True):
        counts, values = ([float(row[name]) for row in rows] for name in ("gaussians", column))
        label = f"slope from {FROM:,} on: {slope(rows, column):.2f}"
        panel.loglog(counts, values, "o-", markersize=4, label=label)
        panel.set(xlabel="Gaussians", ylabel=title)
        panel.legend(frameon=False, fontsize=8)
        panel.grid(alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(CSV.with_suffix(".png"), dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--from-csv", action="store_true", help="draw what was measured")
    parser.add_argument("--count", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.count:
        return print(json.dumps(measure_here(args.count)))
    if not args.from_csv:
        require_kernel()
        write(CSV, (*MEASURED, *PLACE), [measure(count) for count in COUNTS])
    draw_chart(read(CSV))


if __name__ == "__main__":
    main()
