"""The CUDA backend: all views in every launch, without waiting for the GPU, and the same bits in
every run.

How many entries (splats in tiles) a picture has is only known on the GPU, so their lists get room
for what earlier calls of this size needed, and a half more. A picture that needs still more is
drawn exactly all the same, slower and without lists; its backward pass makes whole ones, and later
calls have more room. Where memory is short, fewer views are treated at a time.

Only the first call of a size waits for the number. A backward pass waits until the GPU has counted
the entries of its own forward pass, which precedes whatever computed the loss; it must know, since
gradients without whole lists would be wrong.

No sum is taken in the order in which threads happen to finish. Kernels blend three channels; other
numbers of channels are drawn three at a time."""

import functools
import logging
from typing import Optional

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...core.errors import UserError
from .. import torch_backend
from ..channels import CHANNELS, groups, narrow, widen
from ..options import RasterizeOptions
from ..output import Rasterized
from . import driver as cuda_driver
from .memory import Demand, by_views, too_large, whole_steps
from .stages import (
    Frame,
    Inputs,
    Later,
    Lists,
    Pictures,
    Splats,
    Upstream,
    blend,
    blend_backward,
    empty_gradients,
    list_entries,
    no_lists,
    project,
    project_backward,
    viewmats_gradient,
)

MOST_SPLATS = 2**31 - 1  # views times Gaussians; kernels number them with 32 bits
MOST_VIEWS = 2**16 - 1  # the second side of a grid
VIEWMATS, BACKGROUND = 4, 6  # among the arguments of `_Rasterize`
_demands: dict[tuple, Demand] = {}
log = logging.getLogger(__name__)


def unavailable() -> Optional[str]:
    """Why no GPU can be used, or None; compiles nothing."""
    return cuda_driver.unavailable()


def rasterize(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    background,
    options: RasterizeOptions,
) -> Rasterized:
    """All views; arguments as in `splatting.rasterize`, already validated."""
    views, channels = len(viewmats), colors.shape[-1]
    if channels > CHANNELS and options.absgrad:
        # A sum of absolute values doesn't split into groups of channels.
        return torch_backend.rasterize(
            means,
            quats,
            scales,
            opacities,
            colors,
            viewmats,
            Ks,
            width,
            height,
            background,
            options,
        )
    _check_count(views, len(means))
    if background is None:
        background = means.new_zeros(views, channels)
    inputs = (means, quats, scales, opacities, viewmats)
    tracked = torch.is_grad_enabled() and any(
        x.requires_grad for x in (*inputs, colors, background)
    )
    means2d = means.new_zeros(views, len(means), 2).requires_grad_(tracked)
    if tracked and options.absgrad:
        means2d.absgrad = torch.zeros_like(means2d, requires_grad=False)
    frame = Frame(width, height, options, tracked, cuda_driver.machine(means.device))
    drawn = [
        _Rasterize.apply(*inputs, *group, means2d, Ks, frame)
        for group in groups(colors, background)
    ]
    image = drawn[0][0] if channels <= CHANNELS else torch.cat([group[0] for group in drawn], -1)
    _, alpha, depth, radii, contribution = drawn[0]
    return Rasterized(image, alpha, depth, means2d, radii, contribution)


def _check_count(views: int, gaussians: int) -> None:
    if views * gaussians > MOST_SPLATS or views > MOST_VIEWS:
        raise UserError(
            f"{views} views of {gaussians} Gaussians are too many for one call: draw fewer "
            "views at a time."
        )


class _Rasterize(torch.autograd.Function):
    """Up to three channels. ``means2d`` is filled in place, and is an input so that autograd hands
    it its gradient.
    """

    @staticmethod
    def forward(
        ctx, means, quats, scales, opacities, viewmats, colors, background, means2d, Ks, frame
    ):
        inputs = Inputs(
            means, quats, scales, opacities, widen(colors), viewmats, widen(background), Ks
        )
        ctx.set_materialize_grads(False)
        ctx.frame, ctx.means2d, ctx.channels = frame, means2d, colors.shape[-1]
        if len(means):
            splats, radii, contribution = project(inputs, means2d, frame)
            ctx.totals = frame.machine.read_later(splats.ends[:, -1])
            pictures = _empty_pictures(inputs, frame)
            lists = _draw(inputs, splats, ctx.totals, pictures, contribution, frame)
            state = (*splats, *lists, *pictures[3:]) if frame.tracked else ()
        else:
            pictures, state = _background_alone(inputs, frame), ()
            radii, contribution = means2d.new_zeros(2, *means2d.shape[:2])
        image, alpha, depth, *_ = pictures
        ctx.save_for_backward(*inputs, alpha, *state)
        ctx.mark_non_differentiable(radii, contribution)
        return narrow(image, ctx.channels), alpha, depth, radii, contribution

    @staticmethod
    @once_differentiable
    def backward(ctx, d_image, d_alpha, d_depth, *_):
        saved, frame = ctx.saved_tensors, ctx.frame
        inputs, alpha, state = Inputs(*saved[:8]), saved[8], saved[9:]
        upstream = [
            None if d is None else widen(d, channels)
            for d, channels in ((d_image, CHANNELS), (d_alpha, 1), (d_depth, 1))
        ]
        gradients = empty_gradients(
            inputs, frame.options.absgrad, viewmats=ctx.needs_input_grad[VIEWMATS]
        )
        if state:
            splats, lists, kept = Splats(*state[:5]), Lists(*state[5:8]), state[8:]
            sums = _sums_of_rows(
                inputs, splats, lists, ctx.totals.values(), Upstream(*upstream, *kept), frame
            )
            project_backward(inputs, splats, sums, gradients, frame)
        if gradients.absgrad is not None:
            ctx.means2d.absgrad += gradients.absgrad
        d_background = (
            _background_gradient(upstream[0], alpha, inputs.background)
            if ctx.needs_input_grad[BACKGROUND]
            else None
        )
        d_viewmats = None if gradients.viewmats is None else viewmats_gradient(gradients.viewmats)
        per_channel = narrow(gradients.colors, ctx.channels), narrow(d_background, ctx.channels)
        return *gradients[:4], d_viewmats, *per_channel, gradients.means2d, None, None


def _draw(
    inputs: Inputs,
    splats: Splats,
    totals: Later,
    pictures: Pictures,
    contribution: Tensor,
    frame: Frame,
) -> Lists:
    """Fills the pictures; returns the lists, as far as there was room for them.

    They get the room that earlier calls suggest. Where there is no memory for it, parts of the
    views get just what they need, and their lists go at once; a view for which even that is too
    much is drawn without."""
    views, gaussians = inputs.shape
    demand = _demands.setdefault(
        (inputs.means.device, views, frame.width, frame.height), Demand(views)
    )

    def draw(first: int, last: int) -> Lists:
        whole, some = (
            last - first == views,
            (inputs.of_views(first, last), splats.of_views(first, last)),
        )
        try:
            room = (
                demand.room(totals, gaussians)
                if whole
                else whole_steps(sum(totals.values()[first:last]))
            )
            lists = list_entries(*some, room, frame)
        except torch.cuda.OutOfMemoryError:
            if last - first > 1:
                demand.refuse(gaussians)
                raise
            _report_short_memory()
            lists = no_lists(some[1], frame)
        blend(*some, lists, _of_views(pictures, first, last), contribution[first:last], frame)
        return lists

    parts = by_views(draw, 0, views)
    return parts[0] if len(parts) == 1 else no_lists(splats, frame)


@functools.cache
def _report_short_memory() -> None:
    log.warning(
        "the GPU's memory is too short for the lists of a view's tiles: it is drawn without "
        "them, which takes much longer."
    )


def _sums_of_rows(
    inputs: Inputs,
    splats: Splats,
    lists: Lists,
    totals: list[int],
    upstream: Upstream,
    frame: Frame,
) -> Tensor:
    """`blend_backward` of all views, or, where memory is short, of some at a time, whose lists are
    then made once more.

    Raises:
        UserError: there isn't even memory for one view.
    """
    views = len(totals)

    def sums(first: int, last: int) -> Tensor:
        total, some = (
            sum(totals[first:last]),
            (inputs.of_views(first, last), splats.of_views(first, last)),
        )
        complete = last - first == views and total <= lists.capacity
        entries = lists if complete else list_entries(*some, whole_steps(total), frame)
        return blend_backward(*some, entries, total, _of_views(upstream, first, last), frame)

    try:
        parts = by_views(sums, 0, views)
    except torch.cuda.OutOfMemoryError as error:
        raise too_large(max(totals)) from error
    return parts[0] if len(parts) == 1 else torch.cat(parts)


# ---- tensors -------------------------------------------------------------------------------------


def _of_views(tensors, first: int, last: int):
    """The same named tuple of some views."""
    return type(tensors)(*(None if x is None else x[first:last] for x in tensors))


def _empty_pictures(inputs: Inputs, frame: Frame) -> Pictures:
    size, new = (len(inputs.viewmats), frame.height, frame.width), inputs.means.new_empty
    kept = (new(*size, 4), new(size)) if frame.tracked else (None, None)
    return Pictures(
        *(new(*_shown_size(inputs, frame), channels) for channels in (CHANNELS, 1, 1)), *kept
    )


def _shown_size(inputs: Inputs, frame: Frame) -> tuple[int, int, int]:
    """Views, rows and columns after the downsampling."""
    return (
        len(inputs.viewmats),
        frame.height // frame.options.downsample,
        frame.width // frame.options.downsample,
    )


def _background_alone(inputs: Inputs, frame: Frame) -> Pictures:
    """Without Gaussians no kernel is launched."""
    size, new = _shown_size(inputs, frame), inputs.means.new_zeros
    return Pictures(
        new(*size, CHANNELS) + inputs.background[:, None, None],
        new(*size, 1),
        new(*size, 1),
        None,
        None,
    )


def _background_gradient(d_image: Optional[Tensor], alpha: Tensor, background: Tensor) -> Tensor:
    return torch.zeros_like(background) if d_image is None else (d_image * (1 - alpha)).sum((1, 2))
