"""Two builds of the CPU kernel, and the AVX-512 prototype, in turns in one process.

    python -m benchmarks.splatting.pairs --against another/checkout [--rounds 20]

Reports processor seconds of one thread, so that other programs on the machine matter little, and
ratios of the smallest of all rounds. `surface` is the scene of bench_splatting.py; `demo` is the
demo's step, four views of 256² of a trained cloud. Appends to ``benchmarks/results/kernel.csv``.

Both checkouts must have been built: ``python setup.py build_ext --inplace``."""

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch

from benchmarks.quality.runs import append_rows
from benchmarks.splatting.bench_scenes import Scene, make_camera, make_cotangents, make_scene
from benchmarks.splatting.bench_splatting import PROTOTYPE, contender
from benchmarks.splatting.scenes import trained
from benchmarks.start.launched import commit_of
from threestudio_gaussiandreamer.splatting import autograd
from threestudio_gaussiandreamer.splatting.autograd import Upstream, Wanted
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu
from threestudio_gaussiandreamer.splatting.options import RasterizeOptions
from threestudio_gaussiandreamer.splatting.scene import Scene as KernelScene

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks/results/kernel.csv"
COLUMNS = [
    "scene",
    "gaussians",
    "views",
    "size",
    "build",
    "contender",
    "commit",
    "forward_ms",
    "both_ms",
    "machine",
]
CASES = ("surface 512", "surface 1024", "demo 256")
VIEWS = 4  # of the demo
Pass = Callable[[], object]


class Case(NamedTuple):
    """A scene of B views, and how it is drawn."""

    name: str
    cloud: Scene
    viewmats: torch.Tensor
    Ks: torch.Tensor
    size: int
    options: RasterizeOptions


def make_case(name: str) -> Case:
    """Return one of ``CASES``; alphas below 1/255 are skipped, as by the prototype."""
    scene, _, size = name.partition(" ")
    if scene == "surface":
        cameras, cloud, eps2d = [make_camera(int(size))], make_scene(100_000), 0.3
    else:
        around = [(30 + 90 * i, 35 - 12 * i, 2 + 0.4 * i, 50 + 4 * i) for i in range(VIEWS)]
        cameras, cloud, eps2d = [make_camera(int(size), *c) for c in around], trained(), 0.1
    viewmats, Ks = map(torch.stack, zip(*cameras, strict=True))
    options = RasterizeOptions(alpha_min=1 / 255, eps2d=eps2d)
    return Case(scene, cloud, viewmats, Ks, int(size), options)


def kernel_passes(checkout: Path, build: str, case: Case) -> tuple[Pass, Pass]:
    """Return a forward and a backward pass of a checkout's kernel, without torch's autograd."""
    folder = checkout / cpu.FOLDER.relative_to(ROOT)
    library = cpu.load_library(folder / f"libsplat_{build}.so")
    views = len(case.viewmats)
    cloud, background = case.cloud, torch.zeros(views, 3)
    scene = KernelScene(
        *cloud[:4], case.viewmats, cloud.colors, background, case.Ks, case.size, case.size
    )
    image, depth, alpha = (
        x.expand(views, -1, -1, -1).contiguous() for x in make_cotangents(case.size)
    )
    kernel = cpu.CpuKernel(case.options, True, 1, library)
    means2d, saved = torch.zeros(views, len(cloud.means), 2), []

    def forward() -> None:
        saved[:] = kernel.forward(scene, means2d)[1]

    def backward() -> autograd.SceneGradients:
        upstream, wanted = Upstream(image, alpha, depth), Wanted(False, True)
        return kernel.backward(scene, means2d, tuple(saved), None, upstream, wanted)

    return forward, backward


def prototype_passes(case: Case) -> tuple[Pass, Pass]:
    """Return the same of the prototype, which draws one view."""
    draw, drawn = contender("prototype", case.size, "fast", 1), []
    leaves = Scene(*(x.clone().requires_grad_() for x in case.cloud))
    cotangents = make_cotangents(case.size)
    return (
        lambda: drawn.__setitem__(slice(None), draw(leaves)),
        lambda: torch.autograd.grad(drawn, leaves, cotangents),
    )


def best_times(contenders: dict[str, tuple[Pass, Pass]], rounds: int) -> dict[str, tuple]:
    """Return milliseconds of the forward pass and of both, the smallest of the rounds."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in contenders}
    for _ in range(rounds + 1):
        for name, (forward, backward) in contenders.items():
            start = time.thread_time()
            forward()
            middle = time.thread_time()
            backward()
            times[name].append((middle - start, time.thread_time() - start))
    return {
        name: tuple(round(1e3 * min(column), 2) for column in zip(*found[1:], strict=True))
        for name, found in times.items()
    }


def measure(name: str, build: str, checkouts: dict[str, Path], rounds: int) -> list[dict]:
    """Measure one case; return rows of the CSV."""
    case = make_case(name)
    contenders = {
        label: kernel_passes(checkout, build, case) for label, checkout in checkouts.items()
    }
    runs = "v4" in cpu.usable_builds() and (PROTOTYPE / "proto.cpp").exists()
    if runs and case.name == "surface":
        contenders["prototype"] = prototype_passes(case)
    best = best_times(contenders, rounds)
    first = next(iter(best.values()))[1]
    for label, (_, both) in best.items():
        print(f"{name:12} {build:4} {label:9} {both:7.2f} ms   {both / first:.2f}", flush=True)
    where = (case.name, len(case.cloud.means), len(case.viewmats), case.size, build)
    commits = {label: commit_of(checkout) for label, checkout in checkouts.items()}
    return [
        dict(zip(COLUMNS, (*where, label, commits.get(label, ""), *found), strict=False))
        for label, found in best.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, required=True, help="another checkout, built")
    parser.add_argument("--rounds", type=int, default=20)
    args = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(1)
    checkouts = {"before": args.against.resolve(), "now": ROOT}
    builds = [build for build in cpu.usable_builds() if build != "base"]
    rows = [
        row
        for build in builds
        for name in CASES
        for row in measure(name, build, checkouts, args.rounds)
    ]
    append_rows(RESULTS.stem, COLUMNS, rows, RESULTS.parent)


if __name__ == "__main__":
    main()
