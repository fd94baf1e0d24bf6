"""Time the prune command: clouds of 100,000 Gaussians to a count and to a quality, into
docs/charts/prune.csv.

    python -m benchmarks.quality.bench_prune
    python -m benchmarks.quality.bench_prune --count 10000

*torus*: `known_answer.py`'s, of random colours, every Gaussian to be seen. *torus and sphere*:
`bench_splatting.py`'s shells of 2 % thickness, whose inside is hidden. Seconds are the pruning's,
on all cores, reading and the report's pictures left out; dB are to the unpruned cloud, on test
views."""

import argparse
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks.quality.known_answer import torus
from benchmarks.quality.runs import append_rows, measured_in
from benchmarks.splatting.bench_scenes import make_scene
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0
from threestudio_gaussiandreamer.prune import command as prune

COLUMNS = "scene,x,budget,gaussians,psnr,seconds,threads,load,machine,commit".split(",")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--count", type=int, default=100_000, help="Gaussians at the start (default: 100000)"
    )
    arguments = parser.parse_args()
    register_parts()
    for row in rows(arguments.count, measured_in("prune", "scene", "x", "budget")):
        print(
            "{scene}, {x} Gaussians, {budget}: {gaussians} left, {psnr} dB, {seconds} s".format(
                **row
            ),
            flush=True,
        )
        append_rows("prune", COLUMNS, [row])


def rows(count: int, measured: set[tuple[str, ...]]) -> Iterator[dict[str, Any]]:
    """Yield the CSV's rows that aren't among those ``measured``."""
    with tempfile.TemporaryDirectory() as folder:
        for scene, make in SCENES.items():
            source = Path(folder) / "source.ply"
            write_cloud(str(source), StoredCloud(make(count).arrays()))
            for budget in (["--count", str(count // 4)], ["--psnr", "40"]):
                if (scene, str(count), " ".join(budget)) in measured:
                    continue
                load = round(os.getloadavg()[0], 1)
                report = prune.run(
                    prune.parse([str(source), str(Path(folder) / "pruned.ply"), *budget])
                )
                found = {
                    "gaussians": report["after"]["gaussians"],
                    "psnr": round(report["psnr_on_unseen_views"], 2),
                    "seconds": report["seconds"],
                }
                yield found | {
                    "scene": scene,
                    "x": count,
                    "budget": " ".join(budget),
                    "threads": torch.get_num_threads(),
                    "load": load,
                }


def torus_and_sphere(count: int) -> Gaussians:
    means, quats, scales, opacities, colors = make_scene(count)
    return Gaussians(means, quats, scales.log(), opacities.logit(), rgb_to_sh0(colors[:, None]))


SCENES: dict[str, Callable[[int], Gaussians]] = {
    "torus": lambda count: torus(count, 0),
    "torus and sphere": torus_and_sphere,
}


if __name__ == "__main__":
    main()
