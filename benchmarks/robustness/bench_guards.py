"""The overhead of the checks: the time of each one relative to a training step, and of the finite
check relative to a forward pass.

    python -m benchmarks.robustness.bench_guards [--gaussians 10000 --size 256 --views 4]

A step is what the demo's is: four views drawn and differentiated, the shared path of score
distillation on their pixels, Adam. Guards are timed on their own, since a difference of two steps
drowns in their noise. Times are CPU times of one thread, which other programs change little. Prints
a table and writes ``benchmarks/results/guards.csv``. The bars: all guards of a step <= 2 % of it,
``non_finite="error"`` <= 2 % of a forward pass."""

import argparse
import statistics
import time
from pathlib import Path
from typing import Callable

import torch

from benchmarks.markdown import write
from benchmarks.splatting.bench_scenes import make_camera, make_scene
from tests.helpers.pixel_guidance import PixelGuidance
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0
from threestudio_gaussiandreamer.guidance.non_finite import find_bad_items
from threestudio_gaussiandreamer.splatting import RasterizeOptions, rasterize, validation
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.finite import (
    CHECK_EVERY,
    optimizer_tensors,
    require_finite,
)
from threestudio_gaussiandreamer.training.geometry import LOG_SCALE_RANGE, GaussianCloud

RESULTS = Path(__file__).parents[1] / "results/guards.csv"
LOG_EVERY = 10  # steps between two checks of the cloud's scales, as in configs/demo.yaml


class Pixels(PixelGuidance):
    """The shared path of score distillation, predicting the noisy image itself."""

    def predict(self, z, t, condition):
        return z, None


class Bench:
    """A cloud, its cameras, and the inputs of a step and its checks."""

    def __init__(self, gaussians: int, size: int, views: int):
        self.size, self.scene = size, make_scene(gaussians)
        self.geometry = GaussianCloud({})
        arrays = {
            "means": self.scene.means,
            "log_scales": self.scene.scales.log(),
            "quats": self.scene.quats,
        }
        logits = torch.logit(self.scene.opacities)
        self.geometry.set_arrays(
            **arrays, logit_opacities=logits, sh=rgb_to_sh0(self.scene.colors)[:, None]
        )
        cameras = [make_camera(size, azimuth=360.0 / views * view) for view in range(views)]
        self.cameras = [torch.stack(x) for x in zip(*cameras, strict=True)]
        self.optimizer = torch.optim.Adam(
            [{**group, "lr": 1e-5} for group in self.geometry.parameter_groups()]
        )
        self.guidance = Pixels({"guidance_scale": 1.0, "max_step_percent": 0.5})
        self.noised = self.guidance.add_noise(torch.rand(views, 3, size, size))
        self.grad = torch.randn(views, 3, size, size)
        self.means2d_grad = torch.randn(views, gaussians, 2)

    def forward(self, **options):
        cloud = self.geometry
        colors = cloud.colors(torch.zeros(len(self.cameras[0]), 3))
        gaussians = cloud.means, cloud.quats, cloud.scales(), cloud.opacities(), colors
        return rasterize(*gaussians, *self.cameras, self.size, self.size, preset="fast", **options)

    @torch.no_grad()
    def forward_only(self) -> None:
        self.forward()

    def step(self) -> None:
        out = self.forward()
        self.guidance(out.image)["loss_sds"].backward()
        DensityControl(self.geometry).after_backward(out, self.size, self.size)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    # -- the guards, as the step runs them ---------------------------------------------------------

    def tensors(self) -> tuple[dict, dict]:
        names = ("means", "quats", "scales", "opacities", "colors")
        return dict(zip(names, self.scene, strict=True)), {
            "viewmats": self.cameras[0],
            "Ks": self.cameras[1],
        }

    def arguments_are_checked(self) -> None:
        gaussians, cameras = self.tensors()
        validation.check_tensors(gaussians | cameras)
        validation.check_shapes(gaussians | cameras)
        validation.check_numbers(self.size, self.size, RasterizeOptions())
        validation.check_finite("drop", {})

    def everything_is_finite(self) -> None:
        gaussians, cameras = self.tensors()
        validation.check_finite("error", gaussians | cameras)

    @torch.no_grad()
    def log_scales_are_clamped(self) -> None:
        """Run the clamp forward, and the mask of its backward pass."""
        x = self.geometry.log_scales
        x.clamp(*LOG_SCALE_RANGE)
        torch.where((x >= LOG_SCALE_RANGE[0]) & (x <= LOG_SCALE_RANGE[1]), x, 0)

    def bad_items_are_counted(self) -> None:
        bad = find_bad_items(self.grad)
        if not bad.any():
            self.guidance._count_bad(bad)

    def gradients_of_the_statistics_are_finite(self) -> None:
        norms = self.means2d_grad[..., 0]
        torch.where(norms.isfinite(), norms, torch.zeros_like(norms))

    def sizes_are_looked_at(self) -> None:
        self.geometry.warn_of_clamped_sizes()

    def parameters_and_moments_are_finite(self) -> None:
        require_finite(optimizer_tensors(self.optimizer), step=0)


def milliseconds(function: Callable[[], None], seconds: float) -> float:
    """Return the median CPU time of a call, over as many as fit into ``seconds``, at least 5."""
    function()
    times: list[float] = []
    while len(times) < 5 or sum(times) < seconds:
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return 1e3 * statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in (("gaussians", 10_000), ("size", 256), ("views", 4), ("threads", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument(
        "--seconds",
        type=float,
        default=5.0,
        help="for each of the two things that guards are compared with",
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    bench = Bench(options.gaussians, options.size, options.views)
    step, forward = (milliseconds(f, options.seconds) for f in (bench.step, bench.forward_only))
    guards = {
        bench.arguments_are_checked: 1, bench.log_scales_are_clamped: 1,
        bench.bad_items_are_counted: 1, bench.gradients_of_the_statistics_are_finite: 1,
        bench.sizes_are_looked_at: LOG_EVERY, bench.parameters_and_moments_are_finite: CHECK_EVERY,
    }  # fmt: skip
    rows = [
        (f.__name__.replace("_", " "), milliseconds(f, options.seconds / 10) / every, step)
        for f, every in guards.items()
    ]
    rows.append(("all checks of a training step", sum(time for _, time, _ in rows), step))
    rows.append(
        (
            'non_finite="error" in a forward pass',
            milliseconds(bench.everything_is_finite, options.seconds / 10),
            forward,
        )
    )
    report(rows, options)


def report(rows: list[tuple[str, float, float]], options: argparse.Namespace) -> None:
    print(
        f"{options.gaussians:,} Gaussians, {options.views} views of {options.size}^2, "
        f"{options.threads} thread{'s' * (options.threads > 1)}"
    )
    for name, time_of_guard, whole in rows:
        print(
            f"{name:42} {time_of_guard:8.3f} ms of {whole:8.2f} ms: "
            f"{100 * time_of_guard / whole:5.2f} %"
        )
    place = {name: getattr(options, name) for name in ("gaussians", "size", "views", "threads")}
    found = [
        place
        | {
            "guard": name,
            "guard_ms": f"{time_of_guard:.4f}",
            "whole_ms": f"{whole:.3f}",
            "percent": f"{100 * time_of_guard / whole:.3f}",
        }
        for name, time_of_guard, whole in rows
    ]
    write(RESULTS, list(found[0]), found)


if __name__ == "__main__":
    main()
