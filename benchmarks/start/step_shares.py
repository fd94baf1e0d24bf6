"""Processor seconds of a training step, and the share of each of its parts.

    python -m benchmarks.start.step_shares [--against another/checkout] [--rounds 2]

Runs the demo's step (4 views of 256 x 256 pixels, the exact score), one of 4 x 512 x 512 with empty
networks of Stable Diffusion's shapes, and that of toybox.yaml, 4 x 128 x 128 with learned models.
Early steps of the first two have up to 20,000 Gaussians, late ones 5,000. Both checkouts alternate,
each run in a new process with one thread. Replaces the rows of these workloads in
``benchmarks/results/step.csv``; those of workloads that no longer exist are dropped."""

from pathlib import Path
from typing import NamedTuple

from benchmarks.markdown import read, write_rows
from benchmarks.quality.runs import machine
from benchmarks.start.launched import ROOT, checkouts_of, commit_of, paired_parser, run_with_probe

RESULTS = ROOT / "benchmarks/results/step.csv"
PROBE = Path(__file__).with_name("step_probe.py")
COLUMNS = ("workload", "steps", "checkout", "commit", "machine", "round", "part", "cpu_ms")
EARLY, LATE = (50, 100), (350, 400)
"""The first step of a window, and the one after its last. In the early one the demo samples the
removal error and prunes."""
NO_PICTURES = ("trainer.limit_val_batches=0",)
FEW_VIEWS = ("data.train_views=24", "system.evaluation.views=1", "system.evaluation.size=16")
"""What only matters before and after these steps: target images and evaluation."""


class Workload(NamedTuple):
    options: tuple[str, ...]
    config: str = "configs/demo.yaml"
    windows: tuple[tuple[int, int], ...] = (EARLY, LATE)


WORKLOADS = {
    "demo": Workload(FEW_VIEWS),
    "empty networks, 4 × 512²": Workload(
        (
            *FEW_VIEWS, "data.width=512", "data.height=512",
            "system.guidance_type=empty-networks-guidance",
        )
    ),
    "learned models, 4 × 128²": Workload(
        ("system.prompt_processor.prompt=a red fox with a green scarf",),
        "configs/toybox.yaml",
        (EARLY,),
    ),
}  # fmt: skip
THREADS = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def main() -> None:
    parser = paired_parser(__doc__, rounds=2)
    parser.add_argument("--workloads", nargs="+", choices=[*WORKLOADS], default=[*WORKLOADS])
    args = parser.parse_args()
    checkouts = checkouts_of(args.against)
    earlier = read(RESULTS) if RESULTS.exists() else []
    kept = WORKLOADS.keys() - args.workloads
    rows = [tuple(row.values()) for row in earlier if row["workload"] in kept]
    for number in range(args.rounds):
        for workload in args.workloads:
            for name, checkout in checkouts.items():
                for steps, parts in milliseconds(checkout, WORKLOADS[workload]).items():
                    total = sum(parts.values())
                    print(f"{workload}, {steps}, {name}: {total:.1f} ms", parts, flush=True)
                    place = (workload, steps, name, commit_of(checkout), machine(), number)
                    rows += [(*place, part, f"{ms:.3f}") for part, ms in parts.items()]
    order = [*WORKLOADS]
    write_rows(RESULTS, COLUMNS, sorted(rows, key=lambda row: order.index(row[0])))


def milliseconds(checkout: Path, workload: Workload) -> dict[str, dict[str, float]]:
    """Return the processor milliseconds of each part of a step, the means of each window."""
    options, config, windows = workload
    limits = [str(step) for window in windows for step in window]
    environment = {**THREADS, "STEP_WINDOWS": " ".join(limits)}
    overrides = (*options, *NO_PICTURES)
    found = run_with_probe(PROBE, checkout, *overrides, config=config, environment=environment)
    return {
        f"{first}–{last}": {part: 1000 * value / (last - first) for part, value in parts.items()}
        for (first, last), parts in zip(windows, found["windows"], strict=True)
    }


if __name__ == "__main__":
    main()
