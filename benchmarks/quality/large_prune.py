"""Time and memory of pruning a large cloud, and the quality of the result:

    python -m benchmarks.quality.large_prune [--gaussians 2000000] [--count 100000 | --psnr 40]
        [--size 256] [--against another/checkout]

Writes the scene of the rasteriser's benchmark as a PLY to a temporary folder and prunes it with the
command of each checkout, in a process of its own. Adds wall seconds, processor seconds, peak memory
and dB to the original, on the test views, to ``benchmarks/results/large_prune.csv``. To measure on
two cores of a larger machine: ``taskset -c 0,1 python -m ...``."""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.markdown import markdown, read
from benchmarks.quality.runs import append_rows, require_kernel
from benchmarks.splatting.bench_scenes import make_scene
from benchmarks.splatting.bench_splatting import processor
from benchmarks.start.launched import ROOT, checkouts_of, commit_of, paired_parser
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0

RESULTS = ROOT / "benchmarks/results/large_prune.csv"
CASE = ["gaussians", "budget", "size"]
MEASURED = ["seconds", "cpu_seconds", "peak_gb", "left", "psnr"]
COLUMNS = ["machine", "cores", "commit", *CASE, *MEASURED]
AIM_CORES, AIM_SECONDS, AIM_GB = 2, 300, 4


def surface(count: int) -> Gaussians:
    """Return the benchmark's torus and sphere as a cloud."""
    scene = make_scene(count)
    sh = rgb_to_sh0(scene.colors)[:, None]
    opacities = torch.logit(scene.opacities)
    return Gaussians(scene.means, scene.quats, scene.scales.log(), opacities, sh).arrays()


def prune(checkout: Path, folder: Path, options: list[str]) -> dict[str, float]:
    """Run a checkout's command on ``folder/in.ply``; return its costs and what is left.

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
        "left": report["after"]["gaussians"],
        "psnr": round(report["psnr_on_unseen_views"], 2),
    }


def table() -> str:
    """Return what each run took, and whether that is within the aim."""
    aim = f"within {AIM_SECONDS} s and {AIM_GB} GB on {AIM_CORES} cores"
    head = ("Gaussians", "budget", "machine", "commit", "seconds", "CPU s", "peak memory, GB")
    lines = [
        (
            f"{int(row['gaussians']):,}",
            f"`{row['budget']}`",
            row["machine"] + (f", {row['cores']} cores" if row["cores"] else ""),
            *(row[name] for name in ("commit", "seconds", "cpu_seconds", "peak_gb")),
            f"{int(row['left']):,}",
            f"{float(row['psnr']):.1f}",
            _within_aim(row),
        )
        for row in read(RESULTS)
    ]
    return markdown((*head, "left", "dB to the original", aim), lines)


def _within_aim(row: dict[str, str]) -> str:
    """Return whether a run was within the aim; more cores than that of the aim show nothing."""
    if row["cores"] != str(AIM_CORES):
        return "not measured"
    within = float(row["seconds"]) <= AIM_SECONDS and float(row["peak_gb"]) <= AIM_GB
    return "yes" if within else "no"


def parse_arguments() -> argparse.Namespace:
    parser = paired_parser(__doc__, rounds=1)
    parser.add_argument("--gaussians", type=int, default=2_000_000)
    parser.add_argument("--size", type=int, default=256)
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--count", type=int, default=100_000)
    budget.add_argument("--psnr", type=float, help="dB to the original")
    arguments = parser.parse_args()
    if arguments.against and commit_of(arguments.against) == commit_of(ROOT):
        parser.error(f"{arguments.against} is of the same commit: there is nothing to compare")
    return arguments


def main() -> None:
    args = parse_arguments()
    require_kernel()
    budget = f"--psnr {args.psnr:g}" if args.psnr is not None else f"--count {args.count}"
    case: dict[str, Any] = {"gaussians": args.gaussians, "budget": budget, "size": args.size}
    place = {"machine": processor(), "cores": len(os.sched_getaffinity(0))}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_cloud(str(folder / "in.ply"), StoredCloud(surface(args.gaussians), WORLD_UP))
        options = [*budget.split(), "--size", str(args.size)]
        for _ in range(args.rounds):
            for checkout in checkouts_of(args.against).values():
                row = {"commit": commit_of(checkout), **place, **case}
                row |= prune(checkout, folder, options)
                print(row, flush=True)
                append_rows(RESULTS.stem, COLUMNS, [row], RESULTS.parent)


if __name__ == "__main__":
    main()
