"""A scene with a known answer: images of exactly M Gaussians. Starting from 4 M, with duplicates
and floaters, training and pruning should return to M.

    python -m benchmarks.quality.known_answer                   # M = 200, five seeds
    python -m benchmarks.quality.known_answer --count 1000 --seeds 0

*auto*: a training run of the base recipe (`recipe.py`) at 128^2 with `budget: auto`, a quarter of
its rates and a shorter memory, from the M true Gaussians, two copies of each a little beside it,
and M floaters anywhere, against pictures of the truth. *prune*: the prune command with `--psnr
40`, which knows nothing but its input: three copies of each in one place, which share its opacity,
and M floaters too faint to be seen. dB are to the truth, or to the prune command's input, on views
that were not fitted. Results go to docs/charts/known_answer.csv; runs that it contains are skipped.
"""

import argparse
import math
import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from benchmarks.quality.jobs import RATES
from benchmarks.quality.recipe import recipe
from benchmarks.quality.runs import append_rows, measured_in
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.cameras import held_out_orbit, to_opencv
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0, sh_to_colors
from threestudio_gaussiandreamer.gaussians.views import Views, psnr_to_original, render_all
from threestudio_gaussiandreamer.host import BaseObject, get_device, register
from threestudio_gaussiandreamer.launch.experiment import main as launch
from threestudio_gaussiandreamer.prune import command as prune
from threestudio_gaussiandreamer.splatting import rasterize

SIZE = 128
COLUMNS = "method,truth,start,seed,gaussians,psnr,machine,commit".split(",")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="M (default: 200)")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    parser.add_argument(
        "--steps", type=int, default=1200, help="of the training run (default: 1200)"
    )
    arguments = parser.parse_args()
    register_parts()
    measured = measured_in("known_answer", "method", "truth", "seed")
    for seed in arguments.seeds:
        true = torus(arguments.count, seed)
        with tempfile.TemporaryDirectory() as folder:
            for method, find in {
                "auto": partial(found_by_auto, steps=arguments.steps),
                "prune": found_by_prune,
            }.items():
                if (method, str(arguments.count), str(seed)) not in measured:
                    append(method, arguments.count, seed, *find(true, seed, folder=Path(folder)))


# ---- scenes --------------------------------------------------------------------------------------


def torus(count: int, seed: int) -> Gaussians:
    """Return flat Gaussians of random colours on a torus, each of which is visible from
    somewhere.
    """
    rng = torch.Generator().manual_seed(seed)
    u, v = 2 * math.pi * torch.rand(2, count, generator=rng)
    normals = torch.stack([u.cos() * v.cos(), u.sin() * v.cos(), v.sin()], 1)
    ring = torch.stack([u.cos(), u.sin(), torch.zeros(count)], 1)
    size = 0.5 * math.sqrt(4 * math.pi**2 * 0.7 * 0.3 / count)
    log_scales = torch.tensor([size, size, 0.2 * size]).log() + 0.3 * torch.randn(
        count, 3, generator=rng
    )
    # half a turn around the bisector takes +z to the normal
    quats = torch.cat(
        [
            torch.zeros(count, 1),
            torch.nn.functional.normalize(normals + torch.tensor([0, 0, 1.0]), dim=1),
        ],
        1,
    )
    opacities = 0.6 + 0.35 * torch.rand(count, generator=rng)
    return Gaussians(
        0.7 * ring + 0.3 * normals, quats, log_scales, opacities.logit(), colored(count, rng)
    )


def colored(count: int, rng: torch.Generator) -> Float[Tensor, "N 1 3"]:
    return rgb_to_sh0(torch.rand(count, 1, 3, generator=rng))


def floaters(count: int, seed: int) -> Gaussians:
    """Return Gaussians like those of the torus, uniformly in a box without cameras."""
    rng = torch.Generator().manual_seed(1000 + seed)
    return torus(count, seed + 1)._replace(
        means=1.6 * torch.rand(count, 3, generator=rng) - 0.8, sh=colored(count, rng)
    )


def mixed(clouds: list[Gaussians], seed: int) -> Gaussians:
    """Join clouds in random order."""
    together = Gaussians(*(torch.cat(values) for values in zip(*clouds, strict=True)))
    order = torch.randperm(len(together.means), generator=torch.Generator().manual_seed(seed))
    return together.rows(order)


def with_copies_and_floaters(true: Gaussians, seed: int) -> Gaussians:
    """Add copies, moved by about a third of the thinnest axis, and floaters as opaque as
    the rest.
    """
    rng = torch.Generator().manual_seed(seed)
    thinnest = true.log_scales.exp().amin(1, keepdim=True)
    moved = [
        true._replace(
            means=true.means + 0.3 * thinnest * torch.randn(true.means.shape, generator=rng)
        )
        for _ in range(2)
    ]
    return mixed([true, *moved, floaters(len(true.means), seed)], seed)


def with_shares_and_faint_floaters(true: Gaussians, seed: int) -> Gaussians:
    """Replace each Gaussian by three with the same total transmittance, and add floaters of opacity
    0.01.
    """
    shared = 1 - (1 - true.logit_opacities.sigmoid()) ** (1 / 3)
    faint = floaters(len(true.means), seed)._replace(
        logit_opacities=torch.full((len(true.means),), 0.01).logit()
    )
    return mixed([true._replace(logit_opacities=shared.logit())] * 3 + [faint], seed)


def held_out(size: int = SIZE) -> Views:
    """Return the views that runs are scored on."""
    orbit = held_out_orbit(24)
    return Views(*to_opencv(orbit.c2w, orbit.fovy, size, size), orbit.c2w[:, :3, 3], size)


# ---- finding -------------------------------------------------------------------------------------


class CloudTruth:
    """Renders of a cloud of degree 0 as the ground truth; see ``guidance/known_truth.py``."""

    mesh = None

    def __init__(self, cloud: Gaussians) -> None:
        self.cloud = cloud

    def render(
        self, batch: dict[str, Any], background: Tensor, *, size: tuple[int, int]
    ) -> Float[Tensor, "B H W 3"]:
        cloud, c2w = self.cloud, batch["c2w"].to(self.cloud.means)
        viewmats, Ks = to_opencv(c2w, batch["fovy"].to(c2w), *size)
        shape = cloud.means, cloud.quats, cloud.log_scales.exp(), cloud.logit_opacities.sigmoid()
        colors = sh_to_colors(cloud.sh, cloud.means)  # of degree 0: any direction will do
        out = rasterize(*shape, colors, viewmats, Ks, size[1], size[0])
        return out.image + (1 - out.alpha) * background

    def prefetch(self, *views: Any) -> None:
        """Do nothing: rendering is fast enough."""


@register("known-cloud-guidance")
class KnownCloud(BaseObject):
    """Score distillation with one image per camera, that of a cloud, and no noise: the mean squared
    error to it.
    """

    @dataclass
    class Config(BaseObject.Config):
        path: str = ""

    cfg: Config

    def configure(self) -> None:
        self.truth = CloudTruth(read_cloud(self.cfg.path).gaussians.tensors(get_device()))

    def __call__(
        self, rgb: Tensor, prompt_utils: Any, comp_rgb_bg: Tensor, **batch: Any
    ) -> dict[str, Any]:
        difference = rgb - self.truth.render(batch, comp_rgb_bg.detach(), size=rgb.shape[1:3])
        loss = 0.5 * difference.square().sum() / len(rgb)
        return {
            "loss_sds": loss,
            "grad_norm": difference.detach().norm(),
            "min_step": 0,
            "max_step": 0,
        }


def auto_config(folder: Path, steps: int) -> dict[str, Any]:
    """Return the recipe with a known cloud as its ground truth and
    ``budget: auto``.
    """
    cfg = recipe()
    cfg["system"] |= {
        "guidance_type": "known-cloud-guidance",
        "guidance": {"path": str(folder / "true.ply")},
    }
    cfg["system"]["renderer"] = {}  # the ground truth is rendered with the default preset too
    # the start is nearly right; the recipe's rates and long averages would move it away again
    cfg["system"]["optimizer"]["args"]["betas"] = [0.7, 0.9]
    for name, (first, last) in RATES.items():
        cfg["system"]["geometry"][name] = [0, first / 4, last / 4, steps]
    cfg["system"]["geometry"] |= {
        "prior_type": "gaussians-prior",
        "prior": {"path": str(folder / "start.ply")},
        "budget": "auto",
    }
    return cfg


def found_by_auto(true: Gaussians, seed: int, steps: int, folder: Path) -> tuple[int, int, float]:
    """Return Gaussians before and after, and dB to the ground truth."""
    start = with_copies_and_floaters(true, seed)
    write_cloud(str(folder / "true.ply"), StoredCloud(true.arrays()))
    write_cloud(str(folder / "start.ply"), StoredCloud(start.arrays()))
    (folder / "known.yaml").write_text(yaml.safe_dump(auto_config(folder, steps)))
    overrides = {
        "exp_root_dir": folder, "use_timestamp": "false", "tag": "run", "seed": seed,
        "data.width": SIZE, "data.height": SIZE, "data.n_test_views": 1, "data.eval_width": 64,
        "data.eval_height": 64, "trainer.max_steps": steps, "trainer.val_check_interval": 100000,
        "trainer.enable_progress_bar": "false",
    }  # fmt: skip
    arguments = ["--config", str(folder / "known.yaml"), "--train"]
    if launch(arguments + [f"{key}={value}" for key, value in overrides.items()]):
        raise SystemExit("the training run failed")
    exported = read_cloud(str(folder / f"demo/run/save/it{steps}-export/gaussians.ply"))
    found = exported.in_axes(WORLD_UP).gaussians.tensors(get_device())
    return (
        len(start.means),
        len(found.means),
        psnr_to_original(found, held_out(), render_all(true, held_out())),
    )


def found_by_prune(true: Gaussians, seed: int, folder: Path) -> tuple[int, int, float]:
    """Return Gaussians before and after, and dB to the original."""
    start = with_shares_and_faint_floaters(true, seed)
    write_cloud(str(folder / "shared.ply"), StoredCloud(start.arrays()))
    report = prune.run(
        prune.parse(
            [
                str(folder / "shared.ply"),
                str(folder / "pruned.ply"),
                "--psnr",
                "40",
                "--size",
                str(SIZE),
            ]
        )
    )
    return len(start.means), report["after"]["gaussians"], report["psnr_on_unseen_views"]


def append(method: str, truth: int, seed: int, start: int, found: int, psnr: float) -> None:
    print(
        f"{method}: {truth} are true, {start} at the start, {found} found ({found / truth:.2f} "
        f"M), {psnr:.1f} dB",
        flush=True,
    )
    values = (method, truth, start, seed, found, round(psnr, 2))
    append_rows("known_answer", COLUMNS, [dict(zip(COLUMNS, values, strict=False))])


if __name__ == "__main__":
    sys.exit(main())
