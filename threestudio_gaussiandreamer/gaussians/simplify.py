"""Fewer Gaussians for the same pictures: prune by what each shows, round by round, and recover by
self-distillation.

What the cloud looked like before is the only truth: no diffusion model, no prompt, so nothing can
drift. First duplicates become one (``merge.py``). Then each round keeps the best 0.8 by what they
show in the probe views (the score ``removal`` of ``importance.py``), re-scored every round, and
fits what stays to the probe views' first pictures (mean squared error, Adam). One-shot pruning of
more than that loses to training so few from scratch; rounds don't."""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..cameras import Orbit, intrinsics, to_opencv
from ..core.errors import UserError
from ..core.streams import generator
from ..metrics import MAX_PSNR, psnr
from ..splatting import rasterize
from . import importance as parsimony
from .gaussians import Gaussians
from .merge import merge_duplicates
from .sh import sh_to_colors

KEEP = 0.8
"""The least share that a round keeps."""
SMALLEST_DROP = 0.02
"""A round that can't drop this share isn't worth its recovery, and ends the search."""
RATES = {"means": 2e-4, "quats": 4e-3, "log_scales": 1e-2, "logit_opacities": 2e-2, "sh": 5e-3}
"""Adam's for a cloud that has just lost a fifth; that of the means in units of the cloud's radius.
"""
PACES = (1.0, 1 / 4, 1 / 16, 1 / 64)
"""Of these rates. What is nearly right needs small ones: Adam's steps are as long where the
gradient is mostly noise.
"""
LEAST_ERROR = 10 ** (-MAX_PSNR / 10)
MOST_ERROR = 1 / LEAST_ERROR
"""Mean squared; what is less can't be told from the rounding of float32."""
FOVY = math.radians(50.0)
EPS2D = 0.3
"""The screen-space dilation of viewers, square pixels."""
NEAR = 0.01
"""The nearest depth that is drawn, in units of the cloud's radius: clouds come in millimetres and
in kilometres. There is no farthest depth.
"""
MAX_RADIUS = 1e15
"""Of a cloud, in its units: squares of distances stay in float32's range."""


class Views(NamedTuple):
    """Square pictures from all around."""

    viewmats: Float[Tensor, "V 4 4"]
    Ks: Float[Tensor, "V 3 3"]
    positions: Float[Tensor, "V 3"]
    size: int
    near: float = NEAR
    """The nearest depth that is drawn."""
    backgrounds: Optional[Float[Tensor, "V 3"]] = None
    """What lies behind; None is grey."""
    eps2d: float = EPS2D
    """Screen-space dilation, square pixels."""
    antialias: bool = False


class Budget(NamedTuple):
    """Where to stop: at a count, or where views that nothing is fitted to would fall below a PSNR;
    one of both.
    """

    count: Optional[int] = None
    psnr: Optional[float] = None


class Round(NamedTuple):
    """What one round led to."""

    count: int
    psnr: float
    """To what the judging views showed at the beginning: :func:`assured_likeness`."""


def bounds(cloud: Gaussians) -> tuple[Float[Tensor, "3"], float]:
    """Centre and radius of what is visible: of the positions' opacity-weighted median, and 99 % of
    the opacity.
    """
    weights = cloud.logit_opacities.sigmoid()
    centre = torch.stack([_quantile(axis, weights, 0.5) for axis in cloud.means.unbind(1)])
    distances = (cloud.means - centre).norm(dim=1) + cloud.log_scales.exp().amax(1)
    return centre, float(_quantile(distances, weights, 0.99).clamp_min(1e-12))


def _quantile(values: Float[Tensor, " N"], weights: Float[Tensor, " N"], share: float) -> Tensor:
    order = values.argsort()
    mass = weights[order].cumsum(0)
    return values[order[int(torch.searchsorted(mass, share * mass[-1]).clamp_max(len(values) - 1))]]


def views_around(
    cloud: Gaussians,
    count: int,
    size: int,
    *,
    turn: float = 0.0,
    to_z_up: Optional[Float[Tensor, "3 3"]] = None,
) -> Views:
    """``count`` views on a spiral of golden angles that starts at ``turn`` degrees, near and far in
    turns; other turns, other views.

    Each has a background of its own, so that no colour of a Gaussian can hide it, and its opacity
    shows. ``to_z_up`` is the rotation from the cloud's axes to some with z up.

    Raises:
        UserError: the cloud is too large to be rendered.
    """
    centre, radius = bounds(cloud)
    if not radius <= MAX_RADIUS:
        raise UserError(
            f"the Gaussians reach {radius:g} units from their centre, further than "
            f"{MAX_RADIUS:g}, which float32 can't render: the largest scale is "
            f"{float(cloud.log_scales.amax().exp()):g}; rescale them or remove the largest"
        )
    index = torch.arange(count)
    elevation = torch.rad2deg(torch.asin(torch.linspace(-0.5, 0.9, count)))
    distance = radius / math.sin(FOVY / 2) * torch.tensor([1.0, 1.4])[index % 2]
    azimuth = (turn + index * 137.50776) % 360.0
    c2w = Orbit(elevation, azimuth, distance, torch.full((count,), FOVY)).c2w.to(centre)
    if to_z_up is not None:
        c2w[:, :3] = to_z_up.T.to(c2w) @ c2w[:, :3]
    c2w[:, :3, 3] += centre
    fovy = torch.full((count,), FOVY, device=centre.device)
    viewmats, _ = to_opencv(c2w, fovy, size, size)
    backgrounds = torch.rand(
        count, 3, generator=generator(0, "backgrounds", count, round(turn))
    ).to(centre)
    return Views(
        viewmats, intrinsics(fovy, size, size), c2w[:, :3, 3], size, NEAR * radius, backgrounds
    )


def draw(
    cloud: Gaussians, views: Views, rows: Tensor, opacities: Optional[Float[Tensor, " N"]] = None
) -> tuple[Tensor, Tensor]:
    """Pictures (B, size, size, 3) of some of the views, and each Gaussian's contribution to them
    (B, N).

    ``opacities`` stand for the cloud's own, to be differentiated by.
    """
    opacities = cloud.logit_opacities.sigmoid() if opacities is None else opacities
    dirs = torch.nn.functional.normalize(cloud.means.detach() - views.positions[rows, None], dim=-1)
    colors = sh_to_colors(cloud.sh, dirs)
    background = (
        torch.full((3,), 0.5, device=cloud.means.device)
        if views.backgrounds is None
        else views.backgrounds[rows]
    )
    out = rasterize(
        cloud.means, cloud.quats, cloud.log_scales.exp(), opacities, colors, views.viewmats[rows],
        views.Ks[rows], views.size, views.size, background=background, near=views.near,
        far=math.inf, eps2d=views.eps2d, antialias=views.antialias,
    )  # fmt: skip
    return out.image, out.contribution


@torch.no_grad()
def look(cloud: Gaussians, views: Views) -> Float[Tensor, "V H W 3"]:
    """All pictures."""
    return torch.cat([draw(cloud, views, rows)[0] for rows in _chunks(views)])


@torch.enable_grad()
def worth(cloud: Gaussians, views: Views, seed: int = 0) -> Float[Tensor, " N"]:
    """What each Gaussian shows in all views, by which they are ranked; 0 for one that isn't to be
    seen.
    """
    opacities, rng = (
        cloud.logit_opacities.detach().sigmoid().requires_grad_(),
        generator(seed, "worth"),
    )
    contribution, removal = torch.zeros(2, len(opacities), device=opacities.device)
    for rows in _chunks(views):
        image, contributed = draw(cloud, views, rows, opacities)
        contribution = torch.maximum(contribution, contributed.amax(0))
        removal = removal + parsimony.removal_error(image, opacities, rng)
    return parsimony.score(
        "removal", cloud.logit_opacities, parsimony.Seen(contribution, removal), rng
    )


def _chunks(views: Views) -> tuple[Tensor, ...]:
    """Rows of the views that are drawn together."""
    return torch.arange(len(views.viewmats)).split(4)


def likeness(cloud: Gaussians, views: Views, pictures: Float[Tensor, "V H W 3"]) -> float:
    """PSNR of a cloud's views to other pictures of them, over all pixels."""
    return float(psnr(look(cloud, views).flatten(0, 1), pictures.flatten(0, 1)))


def assured_likeness(cloud: Gaussians, views: Views, pictures: Float[Tensor, "V H W 3"]) -> float:
    """The PSNR that other views will have too: with two standard errors over these views added to
    their mean squared error.
    """
    errors = (look(cloud, views) - pictures).square().mean((1, 2, 3))
    errors = errors.nan_to_num(nan=MOST_ERROR).clamp_max(MOST_ERROR)
    return -10 * math.log10(
        max(float(errors.mean() + 2 * errors.std() / math.sqrt(len(errors))), LEAST_ERROR)
    )


def simplify(
    cloud: Gaussians,
    probes: Views,
    judges: Views,
    budget: Budget,
    *,
    steps: int = 60,
    seed: int = 0,
    report: Callable[[Round], None] = lambda done: None,
    stored: Callable[[Gaussians], Gaussians] = lambda cloud: cloud,
    sh_reach: float = math.inf,
    rank: Callable[[Gaussians, Views, int], Float[Tensor, " N"]] = worth,
) -> Gaussians:
    """The smallest cloud of a series of rounds that meets the budget.

    Args:
        probes: what Gaussians are scored on and fitted to.
        judges: other views, on which a recovery and a budget of quality are measured: what is
            fitted to looks better than the rest.
        steps: of self-distillation after each round; four views each.
        report: called after each round that was kept.
        stored: what the file to be written makes of a cloud, which is what a budget of quality is
            measured on.
        sh_reach: the largest constant harmonic, either way, that the file holds.
        rank: what each Gaussian is worth in some views, given a seed.

    Raises:
        UserError: nothing of the cloud is to be seen, so that nothing says which Gaussians to keep.
    """
    pictures, before, scores = look(cloud, probes), look(cloud, judges), rank(cloud, probes, seed)
    if not scores.any():
        raise UserError(
            f"none of the {len(cloud.means)} Gaussians is to be seen from around: nothing says "
            "which ones to keep"
        )

    fastest = 0

    def judged(cloud: Gaussians) -> float:
        return assured_likeness(stored(cloud), judges, before)

    def refitted(cloud: Gaussians, done: int) -> tuple[Gaussians, Round]:
        """Recovered at the fastest pace that makes it no worse; as it was where none does.

        The judges say so: what is fitted to looks better while they may lose a dB. A round needs
            about the pace of the one before: the
        search begins one faster than that.
        """
        nonlocal fastest
        found = cloud = cloud._replace(
            sh=torch.cat([cloud.sh[:, :1].clamp(-sh_reach, sh_reach), cloud.sh[:, 1:]], 1)
        )
        reached = judged(cloud)
        for tried in range(fastest, len(PACES)):
            fastest = max(0, tried - 1)
            recovered = recover(cloud, probes, pictures, steps, seed + done, sh_reach, PACES[tried])
            if (now := judged(recovered)) >= reached:
                found, reached = recovered, now
                break
        return found, Round(len(found.means), reached)

    def holds(reached: Round) -> bool:
        return budget.psnr is None or reached.psnr >= budget.psnr

    done = 0
    if float(cloud.sh[:, 0].abs().amax()) > sh_reach:
        cloud, _ = refitted(cloud, done)
        scores = rank(cloud, probes, seed)
    fewer = Gaussians(**merge_duplicates(cloud._asdict(), at_least=budget.count or 1).values)
    if len(fewer.means) <= (1 - SMALLEST_DROP) * len(cloud.means):
        fewer, reached = refitted(fewer, done)
        if holds(reached):
            cloud, scores, done = fewer, rank(fewer, probes, seed), 1
            report(reached)
    keep, failed = KEEP, 0
    while failed < (count := _next_count(len(cloud.means), keep, budget)) < len(cloud.means):
        fewer, reached = refitted(only(cloud, scores, count), done)
        if holds(reached):
            cloud, scores, done, failed = fewer, rank(fewer, probes, seed), done + 1, 0
            report(reached)
        else:
            keep, failed = 0.5 * (1 + keep), count  # half as many
    return cloud


def rounds_to(count: int, here: int) -> int:
    """How many rounds lead from ``here`` Gaussians to ``count``."""
    rounds = 0
    while here > count:
        here, rounds = max(int(KEEP * here), count), rounds + 1
    return rounds


def _next_count(here: int, keep: float, budget: Budget) -> int:
    """How many a round leaves; all that are ``here`` where nothing is left to do, or too little for
    a round.
    """
    if budget.count is not None:
        return min(here, max(int(keep * here), budget.count))
    count = max(1, int(keep * here))
    return here if count >= (1 - SMALLEST_DROP) * here else count


def only(cloud: Gaussians, scores: Float[Tensor, " N"], count: int) -> Gaussians:
    """The ``count`` Gaussians with the highest scores, in their order."""
    rows = torch.argsort(scores, descending=True, stable=True)[:count].sort().values
    return cloud.rows(rows)


@torch.enable_grad()
def recover(
    cloud: Gaussians,
    views: Views,
    pictures: Float[Tensor, "V H W 3"],
    steps: int,
    seed: int,
    sh_reach: float = math.inf,
    pace: float = 1.0,
) -> Gaussians:
    """The cloud fitted to pictures of its former self at ``pace`` times ``RATES``, its constant
    harmonics within ``sh_reach``.
    """
    leaves = cloud.map(lambda values: values.detach().clone().requires_grad_())
    rates = {name: pace * rate for name, rate in RATES.items()}
    rates["means"] *= bounds(cloud)[1]
    groups = [
        {"params": [leaf], "lr": rates[name]}
        for name, leaf in zip(Gaussians._fields, leaves, strict=True)
    ]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    for step, rows in enumerate(_batches(len(pictures), steps, seed)):
        for group, name in zip(adam.param_groups, Gaussians._fields, strict=True):
            group["lr"] = rates[name] * (1 - step / steps)
        image, _ = draw(leaves, views, rows)
        ((image - pictures[rows]) ** 2).mean().backward()
        adam.step()
        adam.zero_grad(set_to_none=True)
        leaves.sh.data[:, 0].clamp_(-sh_reach, sh_reach)
    return leaves.map(Tensor.detach)


def _batches(count: int, steps: int, seed: int, size: int = 4) -> Iterator[Tensor]:
    """Rows of the views of each step: every view once before any comes twice."""
    order, drawn = torch.empty(0, dtype=torch.long), 0
    for _ in range(steps):
        if len(order) < size:
            order, drawn = (
                torch.cat(
                    [order, torch.randperm(count, generator=generator(seed, "simplify", drawn))]
                ),
                drawn + 1,
            )
        rows, order = order[:size], order[size:]
        yield rows
