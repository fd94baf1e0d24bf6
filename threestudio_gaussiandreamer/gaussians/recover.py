"""Recovery: after pruning, fit the remaining Gaussians to images of the original ones, by the mean
squared error and Adam. No diffusion model is involved, so the appearance stays the original's."""

import math
from collections.abc import Callable, Iterator
from dataclasses import InitVar, dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.streams import generator
from .densify import steps_by_size
from .gaussians import Gaussians
from .views import Views, psnr_lower_bound, rasterize_views, render_with_contribution

LEARNING_RATES = {
    "means": 0.05,
    "quats": 4e-3,
    "log_scales": 1e-2,
    "logit_opacities": 2e-2,
    "sh": 5e-3,
}
"""Rates of Adam after a round that prunes 20 %; of the means, in standard deviations by axis."""
LR_SCALES = (1.0, 1 / 4, 1 / 16, 1 / 64)
"""Learning-rate multipliers, tried from largest to smallest: the length of Adam's steps doesn't
decrease near an optimum, so a small error needs a small rate.
"""
VIEWS_PER_STEP = 4
MOST = 100_000
"""Of more Gaussians a recovery takes fewer steps, and no longer, since further rounds follow."""


class Round(NamedTuple):
    """Gaussians after a round of pruning and recovery."""

    cloud: Gaussians
    psnr: float
    """:func:`psnr_lower_bound` of the validation views to images of the original, dB."""

    @property
    def count(self) -> int:
        return len(self.cloud.means)


@dataclass(eq=False)
class Recovery:
    """Recovers Gaussians after each round of pruning; never lowers the validation PSNR.

    Args:
        original: the Gaussians before the first round, whose images are the targets.
        train_views: the views that are fitted.
        val_views: other views, on which a recovery is accepted or rejected, since the PSNR of the
            fitted views improves even when that of others falls by a dB.
        steps: of Adam, for at most ``MOST`` Gaussians.
        seed: for the order of the views.
        as_stored: converts to what is read back from the file, whose quality is measured.
        sh_reach: largest absolute value of the constant harmonic that the file can store.
    """

    original: InitVar[Gaussians]
    train_views: Views
    val_views: Views
    steps: int = 60
    seed: int = 0
    as_stored: Callable[[Gaussians], Gaussians] = lambda cloud: cloud
    sh_reach: float = math.inf

    def __post_init__(self, original: Gaussians) -> None:
        self.train_images, trained = render_with_contribution(original, self.train_views)
        self.val_images, validated = render_with_contribution(original, self.val_views)
        self.contribution = torch.maximum(trained, validated)  # (N,) of the original
        self.first_scale = 0  # index into LR_SCALES

    def __call__(self, cloud: Gaussians, round_number: int) -> Round:
        """Recover with the largest rates that don't lower the validation PSNR, if any does.
        The search starts one step above the previous round's rates.
        """
        constant = cloud.sh[:, :1].clamp(-self.sh_reach, self.sh_reach)
        cloud = best = cloud._replace(sh=torch.cat([constant, cloud.sh[:, 1:]], 1))
        reached = self.quality(cloud)
        steps = math.ceil(self.steps * min(1.0, MOST / len(cloud.means)))
        for tried in range(self.first_scale, len(LR_SCALES)):
            self.first_scale = max(0, tried - 1)
            targets = self.train_views, self.train_images
            seed, scale = self.seed + round_number, LR_SCALES[tried]
            recovered = recover(cloud, *targets, steps, seed, self.sh_reach, scale)
            if (now := self.quality(recovered)) >= reached:
                best, reached = recovered, now
                break
        return Round(best, reached)

    def quality(self, cloud: Gaussians) -> float:
        """Return a lower bound of the PSNR of ``as_stored(cloud)`` to the original, dB."""
        return psnr_lower_bound(self.as_stored(cloud), self.val_views, self.val_images)


@torch.enable_grad()
def recover(
    cloud: Gaussians,
    views: Views,
    images: Float[Tensor, "V H W 3"],
    steps: int,
    seed: int,
    sh_reach: float = math.inf,
    lr_scale: float = 1.0,
) -> Gaussians:
    """Fit Gaussians to the images of views in Adam steps on four views each, with rates that fall
    linearly from ``lr_scale`` times ``LEARNING_RATES`` to zero; return new ones.
    """
    leaves = cloud.map(lambda values: values.detach().clone().requires_grad_())
    rates = {name: lr_scale * rate for name, rate in LEARNING_RATES.items()}
    groups = [{"params": [leaf], "name": name} for name, leaf in leaves._asdict().items()]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    for step, rows in enumerate(_batches(len(images), steps, seed)):
        for group in adam.param_groups:
            group["lr"] = rates[group["name"]] * (1 - step / steps)
        image = rasterize_views(leaves, views, rows).image
        ((image - images[rows]) ** 2).mean().backward()
        with steps_by_size(leaves.means, leaves.log_scales.exp(), leaves.quats):
            adam.step()
        adam.zero_grad(set_to_none=True)
        leaves.sh.data[:, 0].clamp_(-sh_reach, sh_reach)
    return leaves.map(Tensor.detach)


def _batches(count: int, steps: int, seed: int) -> Iterator[Tensor]:
    """Yield the rows of the views of each step: every view once before any comes twice."""
    order, epoch = torch.empty(0, dtype=torch.long), 0
    for _ in range(steps):
        if len(order) < VIEWS_PER_STEP:
            shuffled = torch.randperm(count, generator=generator(seed, "simplify", epoch))
            order, epoch = torch.cat([order, shuffled]), epoch + 1
        yield order[:VIEWS_PER_STEP]
        order = order[VIEWS_PER_STEP:]
