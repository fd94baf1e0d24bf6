"""The demo of two checkouts, side by side: dB on held-out views and processor seconds of training.

    python -m benchmarks.quality.default_against --against another/checkout [--objects toy.glb ...]

Trains ``configs/demo.yaml`` of both checkouts alternately with the same seeds, each run in a new
process with one thread. The other checkout needs its own kernels (``python setup.py build_ext
--inplace``). Both evaluate 24 held-out views of 256 x 256 pixels. Writes
``benchmarks/results/default.csv``."""

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.markdown import markdown, read, write
from benchmarks.quality.chart_runs import grouped
from benchmarks.quality.runs import machine
from benchmarks.quality.tables import spread
from benchmarks.start.launched import ROOT, checkouts_of, commit_of, launch, paired_parser
from benchmarks.start.step_shares import THREADS

RESULTS = ROOT / "benchmarks/results/default.csv"
COLUMNS = ("object", "checkout", "commit", "seed", "psnr", "cpu_seconds", "gaussians", "machine")
NUMBERS = ("psnr", "cpu_seconds")


def main() -> None:
    parser = paired_parser(__doc__, rounds=3)
    parser.add_argument("--objects", nargs="+", default=["toy.glb"], help="meshes")
    args = parser.parse_args()
    write(RESULTS, COLUMNS, rows(args.objects, checkouts_of(args.against), args.rounds))


def rows(objects: list[str], checkouts: dict[str, Path], rounds: int) -> Iterator[dict[str, str]]:
    """Train every object with every checkout, and with as many seeds as there are rounds."""
    for seed in range(rounds):
        for mesh in objects:
            for name, folder in checkouts.items():
                result = trained(folder, mesh, seed)
                row = {"object": Path(mesh).stem, "checkout": name, "commit": commit_of(folder)}
                row |= {key: str(result[key]) for key in (*NUMBERS, "gaussians")}
                print(row | {"seed": seed}, flush=True)
                yield row | {"seed": str(seed), "machine": machine()}


def trained(checkout: Path, mesh: str, seed: int) -> dict[str, float]:
    """Train a checkout's demo on a mesh; return the scores of the result.

    Raises:
        RuntimeError: the run failed.
    """
    mesh = str(Path(mesh).resolve()) if Path(mesh).is_file() else mesh
    with tempfile.TemporaryDirectory() as folder:
        options = {"exp_root_dir": folder, "name": "run", "tag": "run", "use_timestamp": "false"}
        options |= {"seed": seed, "system.guidance.mesh": mesh}
        words = [f"{key}={value}" for key, value in options.items()]
        done = launch(checkout, folder, *words, environment=THREADS)
        if done.returncode:
            raise RuntimeError(f"{checkout} failed:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
        return json.loads(Path(folder, "run/run/save/metrics.json").read_text())["result"]


def table() -> str:
    """Return the medians of both checkouts, and that of the pairs' ratios of seconds."""
    lines = []
    for mesh, same in grouped(read(RESULTS), lambda row: row["object"]).items():
        before, now = (
            [[float(row[key]) for row in same if row["checkout"] == side] for key in NUMBERS]
            for side in ("before", "now")
        )
        cells = [text for dB, seconds in (before, now) for text in (spread(dB), spread(seconds, 1))]
        ratios = [after / earlier for after, earlier in zip(now[1], before[1], strict=True)]
        lines.append((mesh, *cells, spread(ratios)))
    commits = {row["checkout"]: row["commit"] for row in read(RESULTS)}
    head = [f"{side} ({commits[side]}), {key}" for side in commits for key in ("dB", "CPU s")]
    return markdown(("object", *head, "seconds now / before"), lines)


if __name__ == "__main__":
    main()
