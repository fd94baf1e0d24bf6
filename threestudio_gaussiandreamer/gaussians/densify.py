"""Densify and prune: which Gaussians are cloned, split and dropped, as pure functions of the cloud
and its statistics.

A :class:`Change` gives for every new row the old row that it comes from and whether the Gaussian is
new, so that a Gaussian keeps its moments.

Statistics are per view and unscaled. ``gradient`` is the norm of the gradient of one view's loss
(not divided by the batch) with respect to the projected centre in normalised device units (half the
image is 1), averaged over the views that saw the Gaussian, whatever resolution, batch size and loss
scale are. ``contribution`` is the largest sigma_i T_i over the pixels of recent
views (RadSplat, Niemeyer et al. 2024).

Clone and split rules: Kerbl et al. 2023, section 5.2, without their periodic opacity reset: score
distillation doesn't recover the opacities that it lowers, and pruning by contribution removes
floaters as well."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Mapping, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

logger = logging.getLogger(__name__)

PARAMETERS = ("means", "log_scales", "quats", "logit_opacities", "sh0", "sh_rest")
SPLIT_SHRINK = 1.6  # the two children of a split are this much smaller
LOG_SCALE_RANGE = (-20.0, 10.0)
"""Range in which the exponential and its square are within float32; logarithms outside are clamped
to it for rendering and splitting.
"""


class Change(NamedTuple):
    """A new cloud of M Gaussians, with the old row of each."""

    parents: Int[Tensor, " M"]
    """The old row of each new Gaussian."""
    is_new: Bool[Tensor, " M"]
    """True where the Gaussian is new: its optimiser rows start at zero."""
    values: dict[str, Tensor]
    """The new parameters, (M, ...) each."""


def screen_gradients(
    means2d_grad: Float[Tensor, "B N 2"], width: int, height: int, loss_scale: float = 1.0
) -> Float[Tensor, "B N"]:
    """Compute per-view gradient norms in normalised device units from gradients in pixels.

    ``means2d_grad`` is the gradient of a loss that is averaged over the batch and multiplied by
    ``loss_scale`` (that of automatic mixed precision); both are undone here. Non-finite gradients
    count as zero."""
    half = means2d_grad.new_tensor([0.5 * width, 0.5 * height])
    norms = (means2d_grad * half).norm(dim=-1) * (len(means2d_grad) / loss_scale)
    return torch.where(norms.isfinite(), norms, torch.zeros_like(norms))


def densify_and_prune(
    params: Mapping[str, Tensor],
    gradient: Float[Tensor, " N"],
    contribution: Float[Tensor, " N"],
    rules: Any,
    least: int,
    most: int,
    rng: torch.Generator,
) -> Change:
    """Clone small and split large Gaussians whose positional gradient is above the threshold, and
    drop those with a low opacity or a large scale.

    A Gaussian that no view has seen has no gradient and is neither cloned nor split; nor are those
    with a low opacity. At least ``least`` and at most ``most``, counted after the low opacities are
    dropped, stay, those with the largest contribution.

    Args:
        gradient, contribution: see above, of the steps since the last densification.
        rules: ``grad_threshold``, ``min_opacity``, and in world units ``split_scale``, from which
            on Gaussians are split rather than cloned, and ``max_scale``.
    """
    faint = torch.sigmoid(params["logit_opacities"].detach()) < rules.min_opacity
    chosen = (gradient > rules.grad_threshold) & ~faint
    # each clone or split adds one; where there is no room for all, those with the largest gradients
    room = max(most - int((~faint).sum()), 0)
    ranked = torch.where(chosen, gradient, torch.full_like(gradient, -1.0))
    chosen[torch.argsort(ranked, descending=True, stable=True)[room:]] = False
    large = params["log_scales"].exp().amax(-1) > rules.split_scale
    change = clone_and_split(params, clone=chosen & ~large, split=chosen & large, rng=rng)
    huge = change.values["log_scales"].exp().amax(-1) > rules.max_scale
    wanted = ~(faint[change.parents] | huge)
    # every wanted row before every unwanted one, so that the floor is filled from the best of these
    rank = torch.argsort(contribution[change.parents], descending=True, stable=True)
    rank = rank[torch.argsort(wanted[rank].int(), descending=True, stable=True)]
    left, floor = int(wanted.sum()), min(least, len(wanted))
    if left < floor:
        few = "only %d of %d Gaussians would be left: the %d that contribute most stay (%s)"
        logger.warning(few, left, len(wanted), floor, "min_gaussians")
    return select(change, rank[: min(max(left, floor), most)].sort().values)


def clone_and_split(
    params: Mapping[str, Tensor],
    *,
    clone: Bool[Tensor, " N"],
    split: Bool[Tensor, " N"],
    rng: torch.Generator,
) -> Change:
    """Append the clones, and replace each split Gaussian by two smaller samples of it."""
    rows = torch.arange(len(clone), device=clone.device)
    stay, clones, splits = rows[~split], rows[clone], rows[split]
    parents = torch.cat([stay, clones, splits, splits])
    is_new = torch.arange(len(parents), device=clone.device) >= len(stay)
    values = {name: value.detach()[parents].clone() for name, value in params.items()}
    children = slice(len(stay) + len(clones), None)
    scales = values["log_scales"][children].clamp(*LOG_SCALE_RANGE).exp()
    offsets = torch.randn(2 * len(splits), 3, generator=rng).to(clone.device) * scales
    values["means"][children] += rotate(values["quats"][children], offsets)
    values["log_scales"][children] -= torch.log(torch.tensor(SPLIT_SHRINK))
    return Change(parents, is_new, values)


def highest(scores: Float[Tensor, " N"], count: int) -> Int[Tensor, " M"]:
    """Return the rows with the ``count`` highest scores, in ascending order."""
    return torch.argsort(scores, descending=True, stable=True)[:count].sort().values


def select(change: Change, rows: Int[Tensor, " M"]) -> Change:
    """Keep some rows of a change."""
    values = {name: value[rows] for name, value in change.values.items()}
    return Change(change.parents[rows], change.is_new[rows], values)


def unchanged(params: Mapping[str, Tensor]) -> Change:
    """Return the change of a cloud into a copy of itself."""
    rows = torch.arange(len(params["means"]), device=params["means"].device)
    values = {name: value.detach().clone() for name, value in params.items()}
    return Change(rows, torch.zeros_like(rows, dtype=torch.bool), values)


def rotate(quats: Float[Tensor, "N 4"], vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Rotate ``vectors`` by quaternions wxyz (normalised here): v + 2 u x (u x v + w v)."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    w, u = quats[:, :1], quats[:, 1:]
    return vectors + 2 * torch.linalg.cross(u, torch.linalg.cross(u, vectors) + w * vectors)


@contextmanager
def steps_by_size(
    means: Float[Tensor, "N 3"], scales: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"]
) -> Iterator[None]:
    """Let a step of an optimiser see the means as u with mean + R diag(scales) u, which starts at
    zero: with a rate in standard deviations, each Gaussian has a trust region in its own metric.
    """
    scales, quats, before = scales.detach(), quats.detach().clone(), means.detach().clone()
    means.grad = scales * rotate(quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0]), means.grad)
    yield
    with torch.no_grad():
        means.copy_(before + rotate(quats, scales * (means - before)))


def update_optimizer(
    optimizer: torch.optim.Optimizer,
    old: Mapping[str, nn.Parameter],
    new: Mapping[str, nn.Parameter],
    change: Change,
) -> None:
    """Replace the ``old`` parameters by the ``new`` ones; Gaussians keep their moments, and the
    moments of new Gaussians are zero.
    """
    replaced = {id(old[name]): new[name] for name in new}
    for group in optimizer.param_groups:
        for param in group["params"]:
            if id(param) in replaced and param in optimizer.state:
                state = optimizer.state.pop(param)
                for key, value in state.items():
                    # others, such as Adam's step and Adafactor's mean over Gaussians, stay
                    if isinstance(value, Tensor) and value.shape[:1] == param.shape[:1]:
                        state[key] = value[change.parents]
                        state[key][change.is_new] = 0
                optimizer.state[replaced[id(param)]] = state
        group["params"] = [replaced.get(id(param), param) for param in group["params"]]
