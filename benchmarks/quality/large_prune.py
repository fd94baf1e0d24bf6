"""Time and memory of pruning a large cloud, and the quality of the result:

    python -m benchmarks.quality.large_prune [--gaussians 2000000] [--count 100000] [--size 256]
        [--against another/checkout]

Writes the scene of the rasteriser's benchmark as a PLY to a temporary folder and prunes it with the
command of each checkout, in a process of its own. Adds wall seconds, processor seconds, peak memory
and dB to the original, on the test views, to ``benchmarks/results/large_prune.csv``."""

import csv
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import torch

from benchmarks.splatting.bench_scenes import make_scene
from benchmarks.start.launched import ROOT, checkouts_of, commit_of, paired_parser
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0

RESULTS = ROOT / "benchmarks/results/large_prune.csv"
CASE = ("gaussians", "count", "size")
MEASURED = ("seconds", "cpu_seconds", "peak_gb", "psnr")
COLUMNS = ("checkout", "commit", *CASE, *MEASURED)


def surface(count: int) -> Gaussians:
    """Return the benchmark's torus and sphere as a cloud."""
    scene = make_scene(count)
    sh = rgb_to_sh0(scene.colors)[:, None]
    opacities = torch.logit(scene.opacities)
    return Gaussians(scene.means, scene.quats, scene.scales.log(), opacities, sh).arrays()


def prune(checkout: Path, folder: Path, options: list[str]) -> dict[str, float]:
    """Run a checkout's command on ``folder/in.ply``; return its costs and dB.

    Raises:
        RuntimeError: the command failed.
    """
    command = [sys.executable, "-m", "threestudio_gaussiandreamer.prune"]
    command += [str(folder / "in.ply"), str(folder / "out.ply"), *options]
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    started = time.perf_counter()
    process = os.posix_spawn(sys.executable, command, environment)
    _, status, usage = os.wait4(process, 0)
    if status:
        raise RuntimeError(f"{' '.join(command)} failed")
    report = json.loads((folder / "out.ply.json").read_text())
    return {
        "seconds": round(time.perf_counter() - started, 1),
        "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_gb": round(usage.ru_maxrss / 1e6, 2),
        "psnr": round(report["psnr_on_unseen_views"], 2),
    }


def add_row(row: dict[str, object]) -> None:
    """Add a row to the CSV; the first one is preceded by the names of the columns."""
    new = not RESULTS.exists()
    with open(RESULTS, "a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)


def main() -> None:
    parser = paired_parser(__doc__, rounds=1)
    for name, default in zip(CASE, (2_000_000, 100_000, 256), strict=True):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()
    case = {name: getattr(args, name) for name in CASE}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_cloud(str(folder / "in.ply"), StoredCloud(surface(args.gaussians), WORLD_UP))
        options = ["--count", str(args.count), "--size", str(args.size)]
        for _ in range(args.rounds):
            for name, checkout in checkouts_of(args.against).items():
                row = {"checkout": name, "commit": commit_of(checkout), **case}
                row |= prune(checkout, folder, options)
                print(row, flush=True)
                add_row(row)


if __name__ == "__main__":
    main()
