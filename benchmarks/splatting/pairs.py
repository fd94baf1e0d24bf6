"""Two builds of the CPU kernel in turns in one process.

    python -m benchmarks.splatting.pairs --against another/checkout [--rounds 20] [--threads 1 2]
        [--cases "demo's settings 256"]

Reports processor seconds of one thread, so that other programs on the machine matter little, or
seconds of several, and ratios of the smallest of all rounds. `surface` is the scene of
bench_splatting.py; `demo` is four views of 256² of a small trained cloud; `demo's settings` is as
many views with the settings of configs/demo.yaml, of that cloud split twice, so that it has about
as many Gaussians as the demo in the middle of its pruning.

Both checkouts must have been built: ``python setup.py build_ext --inplace``."""

import argparse
import functools
import importlib.util
import os
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf

from benchmarks.quality.recipe import CONFIGS
from benchmarks.splatting.bench_scenes import Scene, make_camera, make_cotangents, make_scene
from benchmarks.splatting.bench_splatting import processor
from benchmarks.splatting.scenes import trained
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.gaussians.densify import clone_and_split
from threestudio_gaussiandreamer.splatting import RasterizeOptions
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu
from threestudio_gaussiandreamer.splatting.validation import smallest_alpha

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "threestudio_gaussiandreamer"
DEMO = "demo's settings"
CASES = ("surface 512", "surface 1024", "demo 256", f"{DEMO} 256")
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
    """Return one of ``CASES``; alphas below 1/255 are skipped."""
    scene, _, text = name.rpartition(" ")
    size = int(text)
    if scene == "surface":
        options = RasterizeOptions(alpha_min=1 / 255, eps2d=0.3)
        return Case(scene, make_scene(100_000), *stacked([make_camera(size)]), size, options)
    if scene == "demo":
        options = RasterizeOptions(alpha_min=1 / 255, eps2d=0.1)
        return Case(scene, trained(), *stacked(cameras_around(4, size)), size, options)
    demo = OmegaConf.load(CONFIGS / "demo.yaml")
    assert (demo.data.width, demo.data.height) == (size, size)
    cloud, views = split_all(split_all(trained())), cameras_around(demo.data.batch_size, size)
    return Case(scene, cloud, *stacked(views), size, options_of(demo.system.renderer))


def options_of(renderer: DictConfig) -> RasterizeOptions:
    """Return the options of a configuration's renderer."""
    alpha_min = smallest_alpha(renderer.preset, None)
    return RasterizeOptions(alpha_min=alpha_min, eps2d=renderer.eps2d, antialias=renderer.antialias)


def cameras_around(views: int, size: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return cameras on all sides, within the demo's ranges of elevation, distance and angle."""
    around = ((30 + 90 * i, 35 - 12 * i, 2 + 0.4 * i, 50 + 4 * i) for i in range(views))
    return [make_camera(size, *place) for place in around]


def stacked(cameras: list[tuple[torch.Tensor, torch.Tensor]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the viewmats and the Ks of all cameras."""
    viewmats, Ks = zip(*cameras, strict=True)
    return torch.stack(viewmats), torch.stack(Ks)


def split_all(cloud: Scene) -> Scene:
    """Replace each Gaussian by two smaller samples of it, as densification does."""
    every = torch.ones(len(cloud.means), dtype=torch.bool)
    rest = cloud._asdict()
    logarithms = {"log_scales": rest.pop("scales").log()}
    change = clone_and_split(
        rest | logarithms, clone=~every, split=every, rng=generator(0, "split")
    )
    scales = change.values.pop("log_scales").exp()
    return Scene(**change.values, scales=scales)


@functools.cache
def package_of(checkout: Path) -> str:
    """Import the package of a checkout, under a name of its own; return the name."""
    if checkout == ROOT:
        return PACKAGE
    name, folder = PACKAGE + re.sub(r"\W", "_", str(checkout)), checkout / PACKAGE
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])
    return name


def kernel_passes(checkout: Path, build: str, case: Case, threads: int) -> tuple[Pass, Pass]:
    """Return a forward and a backward pass of a checkout's kernel. The gradients of the background
    and the cameras aren't asked for, as few trainings need them.
    """
    package = package_of(checkout)
    backend, scenes = (
        importlib.import_module(f"{package}.splatting.{name}") for name in ("cpu.backend", "scene")
    )
    views, library = len(case.viewmats), backend._load(build)
    leaves = [x.detach().clone().requires_grad_() for x in case.cloud]
    background = torch.zeros(views, 3)
    scene = scenes.Scene(
        *leaves[:4], case.viewmats, leaves[4], background, case.Ks, case.size, case.size
    )
    upstream = [x.expand(views, -1, -1, -1).contiguous() for x in make_cotangents(case.size)]
    drawn = []

    def forward() -> None:
        backend.library = lambda: library
        torch.set_num_threads(threads)
        out = backend.rasterize(scene, case.options)
        drawn[:] = out.image, out.depth, out.alpha

    def backward() -> object:
        return torch.autograd.grad(drawn, leaves, upstream)

    return forward, backward


def best_times(
    contenders: dict[str, tuple[Pass, Pass]], rounds: int, clock: Callable[[], float]
) -> dict[str, tuple]:
    """Return milliseconds of the forward pass and of both, the smallest of the rounds."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in contenders}
    for _ in range(rounds + 1):
        for name, (forward, backward) in contenders.items():
            start = clock()
            forward()
            middle = clock()
            backward()
            times[name].append((middle - start, clock() - start))
    return {
        name: tuple(round(1e3 * min(column), 2) for column in zip(*found[1:], strict=True))
        for name, found in times.items()
    }


def measure(name: str, build: str, threads: int, checkouts: dict[str, Path], rounds: int) -> None:
    """Measure one case and print it."""
    case = make_case(name)
    contenders = {
        label: kernel_passes(checkout, build, case, threads)
        for label, checkout in checkouts.items()
    }
    clock = time.thread_time if threads == 1 else time.perf_counter
    best = best_times(contenders, rounds, clock)
    first = next(iter(best.values()))[1]
    for label, (forward, both) in best.items():
        place = f"{name:20} {threads} {build:4} {label:9}"
        print(f"{place} {forward:7.2f} {both:7.2f} ms   {both / first:.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, required=True, help="another checkout, built")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--threads", type=int, nargs="+", default=[1])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES)
    args = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(1)
    checkouts = {"before": args.against.resolve(), "now": ROOT}
    print(processor())
    for build in (build for build in cpu.usable_builds() if build != "base"):
        for name in args.cases:
            for threads in args.threads:
                measure(name, build, threads, checkouts, args.rounds)


if __name__ == "__main__":
    main()
