"""The bookkeeping of each variant of score distillation, in CPU time of one thread.

    python -m benchmarks.quality.variant_overhead [--gaussians 10000 --sizes 256 512 --views 4]

A step: views drawn and differentiated, the shared path of score distillation on latents of an
eighth of the pictures' size, as Stable Diffusion's (512^2 in the paper), Adam. The score model is
empty: it returns its input, so a variant's further calls of it cost nothing, and what remains is
everything else that the variant does. Steps of SDS and of the variant alternate; the overhead is
the median of the differences of the guidance's seconds in two neighbouring steps, relative to the
median whole step of SDS. SDS against itself shows the scatter.
``evaluations``: calls of the score model per view and step, on average.
Writes ``benchmarks/results/variant_overhead.csv``. The bar: at most 2 %."""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from tqdm import tqdm

from benchmarks.markdown import write
from benchmarks.quality.runs import commit, machine
from benchmarks.robustness.bench_guards import Bench
from tests.helpers.pixel_guidance import PixelGuidance
from threestudio_gaussiandreamer.cameras import orbit_c2w
from threestudio_gaussiandreamer.guidance.variants import Variant
from threestudio_gaussiandreamer.host import find, names

RESULTS = Path(__file__).parents[1] / "results/variant_overhead.csv"
PIXELS_PER_LATENT = 8
BASELINE = "sds-variant"
COLUMNS = ["variant", "gaussians", "size", "views", "sds_ms", "extra_ms", "percent", "evaluations"]
COLUMNS += ["machine", "commit"]


class EmptyScore(PixelGuidance):
    """A score model without any computation, on pooled pixels."""

    def encode(self, rgb, **batch):
        return F.avg_pool2d(2 * rgb - 1, PIXELS_PER_LATENT)

    def predict(self, z, t, condition):
        self.evaluations += len(z)
        return z, z

    def unconditional(self, z, t, condition):
        self.evaluations += len(z)
        return z


class Seconds(NamedTuple):
    """CPU seconds of a step."""

    whole: float
    guidance: float


class VariantBench(Bench):
    """A training step with any variant."""

    def __init__(self, gaussians: int, size: int, views: int) -> None:
        super().__init__(gaussians, size, views)
        azimuths = torch.arange(views) * 360.0 / views
        c2w = orbit_c2w(torch.full((views,), 15.0), azimuths, torch.full((views,), 2.7))
        self.batch = {"c2w": c2w, "fovy": torch.full((views,), 0.87)}

    def step_with(self, guidance: EmptyScore) -> Seconds:
        """Make a step and time it."""
        start = time.process_time()
        out = self.forward()
        drawn = time.process_time()
        surface = {"depth": out.depth.detach(), "opacity": out.alpha.detach()}
        surface["depth"] = surface["depth"] / surface["opacity"].clamp_min(1e-6)
        loss = guidance(out.image, **self.batch, **surface)["loss_sds"]
        guidance.update_step(0, guidance.step + 1)
        guided = time.process_time()
        loss.backward()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        return Seconds(time.process_time() - start, guided - drawn)


def variant_names() -> list[str]:
    """Return the package's variants, without those of extensions."""
    own = Variant.__module__.rpartition(".")[0]
    found = {name: find(name) for name in names()}
    return [
        name
        for name, part in found.items()
        if issubclass(part, Variant) and part.__module__.startswith(own)
    ]


def measure(bench: VariantBench, name: str, pairs: int) -> dict[str, Any]:
    """Return the row of one variant."""
    options = {"guidance_scale": 7.5}
    plain, other = (EmptyScore(options | {"variant_type": variant}) for variant in (BASELINE, name))
    bench.step_with(plain), bench.step_with(other)
    calls, times = [], []
    for _ in range(pairs):
        times.append((bench.step_with(plain), bench.step_with(other)))
        calls.append(other.evaluations / len(bench.batch["c2w"]))
    sds = statistics.median(first.whole for first, _ in times)
    extra = statistics.median(second.guidance - first.guidance for first, second in times)
    return {
        "variant": name,
        "sds_ms": f"{1e3 * sds:.2f}",
        "extra_ms": f"{1e3 * extra:.3f}",
        "percent": f"{100 * extra / sds:.2f}",
        "evaluations": f"{statistics.mean(calls):.2f}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in (("gaussians", 10_000), ("views", 4), ("pairs", 150)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="pixels")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for size in options.sizes:
        bench = VariantBench(options.gaussians, size, options.views)
        setting = {"gaussians": options.gaussians, "size": size, "views": options.views}
        setting |= {"machine": machine(), "commit": commit()}
        for name in tqdm(variant_names(), unit="variant", disable=None):
            rows.append(measure(bench, name, options.pairs) | setting)
            line = "{size}: {variant:14} +{extra_ms} ms of {sds_ms}: {percent} %"
            tqdm.write(line.format(**rows[-1]))
    write(RESULTS, COLUMNS, rows)


if __name__ == "__main__":
    main()
