"""Processor seconds of a training step, and the share of each of its parts.

    python -m benchmarks.start.step_shares [--against another/checkout] [--rounds 2]

Runs the demo's step (4 views of 256 x 256 pixels, the exact score), one of 4 x 512 x 512 with empty
networks of Stable Diffusion's shapes, and that of toybox.yaml, 4 x 128 x 128 with learned models;
both checkouts alternate, each run in a new process with one thread. Replaces the rows of these
workloads in ``benchmarks/results/step.csv``."""

from pathlib import Path
from typing import NamedTuple

from benchmarks.markdown import read, write_rows
from benchmarks.start.launched import ROOT, checkouts_of, commit_of, paired_parser, run_with_probe

RESULTS = ROOT / "benchmarks/results/step.csv"
PROBE = Path(__file__).with_name("step_probe.py")
COLUMNS = ("workload", "checkout", "commit", "round", "part", "cpu_ms")
WINDOW = (50, 100)
"""The first and the last step: the demo samples the removal error and prunes in them."""
FEW_VIEWS = ("data.train_views=24", "system.evaluation.views=1", "system.evaluation.size=16")
"""What only matters before and after these steps: target images and evaluation."""


class Workload(NamedTuple):
    options: tuple[str, ...]
    config: str = "configs/demo.yaml"


WORKLOADS = {
    "demo": Workload(FEW_VIEWS),
    "empty networks, 4 × 512²": Workload(
        (
            *FEW_VIEWS, "data.width=512", "data.height=512",
            "system.guidance_type=empty-networks-guidance",
        )
    ),
    "learned models, 4 × 128²": Workload(
        ("system.prompt_processor.prompt=a red fox with a green scarf",), "configs/toybox.yaml"
    ),
}  # fmt: skip
THREADS = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def main() -> None:
    parser = paired_parser(__doc__, rounds=2)
    parser.add_argument("--workloads", nargs="+", choices=[*WORKLOADS], default=[*WORKLOADS])
    parser.add_argument("--steps", nargs=2, type=int, default=WINDOW, metavar=("FIRST", "LAST"))
    args = parser.parse_args()
    checkouts = checkouts_of(args.against)
    earlier = read(RESULTS) if RESULTS.exists() else []
    rows = [tuple(row.values()) for row in earlier if row["workload"] not in args.workloads]
    for number in range(args.rounds):
        for workload in args.workloads:
            for name, checkout in checkouts.items():
                parts = milliseconds(checkout, WORKLOADS[workload], args.steps)
                print(f"{workload}, {name}: {sum(parts.values()):.1f} ms", parts, flush=True)
                place = (workload, name, commit_of(checkout), number)
                rows += [(*place, part, f"{ms:.3f}") for part, ms in parts.items()]
    write_rows(RESULTS, COLUMNS, rows)


def milliseconds(checkout: Path, workload: Workload, window: list[int]) -> dict[str, float]:
    """Return the processor milliseconds of each part of a step, the mean of a window of steps."""
    first, last = window
    environment = {**THREADS, "STEP_WINDOW": f"{first} {last}"}
    options, config = workload
    found = run_with_probe(PROBE, checkout, *options, config=config, environment=environment)
    return {part: 1000 * value / (last - first) for part, value in found.items()}


if __name__ == "__main__":
    main()
