"""Time and memory of pruning a large cloud:

    python -m benchmarks.quality.large_prune [--gaussians 2000000] [--count 100000] [--size 256]

Writes the scene of the rasteriser's benchmark as a PLY to a temporary folder, prunes it with the
command in a process of its own, and prints wall seconds, processor seconds and peak memory."""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import torch

from benchmarks.splatting.bench_scenes import make_scene
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0


def surface(count: int) -> Gaussians:
    """Return the benchmark's torus and sphere as a cloud."""
    scene = make_scene(count)
    sh = rgb_to_sh0(scene.colors)[:, None]
    opacities = torch.logit(scene.opacities)
    return Gaussians(scene.means, scene.quats, scene.scales.log(), opacities, sh).arrays()


def prune(folder: Path, options: list[str]) -> dict[str, float]:
    """Run the command on ``folder/in.ply``; return its costs and its report.

    Raises:
        RuntimeError: the command failed.
    """
    command = [sys.executable, "-m", "threestudio_gaussiandreamer.prune"]
    command += [str(folder / "in.ply"), str(folder / "out.ply"), *options]
    started = time.perf_counter()
    process = os.posix_spawn(sys.executable, command, os.environ)
    _, status, usage = os.wait4(process, 0)
    if status:
        raise RuntimeError(f"{' '.join(command)} failed")
    return {
        "seconds": round(time.perf_counter() - started, 1),
        "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_gb": round(usage.ru_maxrss / 1e6, 2),
    } | json.loads((folder / "out.ply.json").read_text())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gaussians", type=int, default=2_000_000)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--size", type=int, default=256)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        write_cloud(str(Path(folder, "in.ply")), StoredCloud(surface(args.gaussians), WORLD_UP))
        options = ["--count", str(args.count), "--size", str(args.size)]
        print(json.dumps(prune(Path(folder), options), indent=2))


if __name__ == "__main__":
    main()
