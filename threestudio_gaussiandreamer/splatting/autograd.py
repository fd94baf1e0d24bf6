"""The autograd function of the compiled kernels, CPU and CUDA.

Kernels render three colour channels; other numbers of channels are rendered in groups of three.
A kernel is one call of a backend, with its options and device: its ``forward`` draws a scene into a
:class:`Drawn`, fills ``means2d`` (B, N, 2), and returns tensors to save and any other state for
``backward``, which fills :class:`SceneGradients` and adds the sums over pixels of absolute
gradients to ``means2d.absgrad`` if it is there."""

from typing import Any, NamedTuple, Optional

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import torch_backend
from .scene import TENSORS, Rasterized, RasterizeOptions, Scene

CHANNELS = 3


class Drawn(NamedTuple):
    """Output of a kernel, with up to three channels; sizes are after the downsampling."""

    image: Tensor  # (B, H, W, 3)
    alpha: Tensor  # (B, H, W, 1)
    depth: Tensor  # (B, H, W, 1)
    radii: Tensor  # (B, N)
    contribution: Tensor  # (B, N)

    @classmethod
    def empty(cls, scene: Scene, downsample: int) -> "Drawn":
        new, (views, gaussians) = scene.means.new_empty, scene.shape
        size = (views, scene.height // downsample, scene.width // downsample)
        images = (new(*size, channels) for channels in (CHANNELS, 1, 1))
        return cls(*images, new(views, gaussians), new(views, gaussians))


class SceneGradients(NamedTuple):
    """Gradients of the loss with respect to the fields of a Scene, but for the background, and to
    means2d (B, N, 2); None for viewmats that need none.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    viewmats: Optional[Tensor]
    colors: Tensor
    means2d: Tensor


Upstream = tuple[Optional[Tensor], ...]
"""Gradients of the loss with respect to image, alpha and depth, contiguous; None means zero."""


def rasterize(kernel: Any, scene: Scene, options: RasterizeOptions) -> Rasterized:
    """Render a scene with any number of channels by a kernel for three."""
    if scene.channels > CHANNELS and options.absgrad:
        # |sum over channels| can't be computed from groups of channels.
        return torch_backend.rasterize(scene, options)
    tracked = scene.tracked
    means2d = scene.means.new_zeros(*scene.shape, 2).requires_grad_(tracked)
    if tracked and options.absgrad:
        means2d.absgrad = torch.zeros_like(means2d, requires_grad=False)
    call = kernel, options.downsample, scene.size, means2d
    drawn = [Drawn(*_Rasterize.apply(*call, *part.tensors)) for part in groups(scene)]
    image = torch.cat([part.image for part in drawn], -1) if len(drawn) > 1 else drawn[0].image
    return Rasterized(image, *drawn[0][1:3], means2d, *drawn[0][3:])


class _Rasterize(torch.autograd.Function):
    """Runs a kernel on up to three channels; fills ``means2d``, the caller's, for its gradient."""

    @staticmethod
    def forward(ctx, kernel: Any, downsample: int, size, means2d: Tensor, *tensors: Tensor):
        scene = Scene(*tensors, *size)
        ctx.kernel, ctx.size, ctx.means2d, ctx.channels = kernel, size, means2d, scene.channels
        scene = scene._replace(colors=widen(scene.colors), background=widen(scene.background))
        drawn = Drawn.empty(scene, downsample)
        saved, ctx.state = kernel.forward(scene, means2d, drawn)
        alpha = drawn.alpha if _needed(ctx).background else None
        ctx.save_for_backward(*scene.tensors, alpha, *saved)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(drawn.radii, drawn.contribution)
        return narrow(drawn.image, ctx.channels), *drawn[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Optional[Tensor]):
        saved = ctx.saved_tensors  # hooks run at each reading
        scene, needed = Scene(*saved[:TENSORS], *ctx.size), _needed(ctx)
        alpha, *of_kernel = saved[TENSORS:]
        sizes = zip(grads[:3], (CHANNELS, 1, 1), strict=True)
        upstream = tuple(None if grad is None else widen(grad, n) for grad, n in sizes)
        found = SceneGradients(*map(torch.empty_like, (*scene[:6], ctx.means2d)))
        found = found if needed.viewmats else found._replace(viewmats=None)
        ctx.kernel.backward(scene, ctx.means2d, of_kernel, ctx.state, upstream, found)
        colors, background = narrow(found.colors, ctx.channels), None
        if needed.background:
            background = torch.zeros_like(scene.background)
            if upstream[0] is not None:  # by rows first: the number of threads must not matter
                background = (upstream[0] * (1 - alpha)).sum(2).sum(1)
            background = narrow(background, ctx.channels)
        return None, None, None, found.means2d, *found[:5], colors, background, None


def _needed(ctx: Any) -> Scene:
    """Return which of a scene's tensors need a gradient."""
    return Scene(*ctx.needs_input_grad[-TENSORS:], *ctx.size)


def groups(scene: Scene) -> list[Scene]:
    """Split a scene into scenes of at most three channels. A Gaussian with a channel that isn't
    finite becomes NaN in every group, so that all drop it.
    """
    if scene.channels <= CHANNELS:
        return [scene]
    colors = torch.where(scene.colors.isfinite().all(-1, keepdim=True), scene.colors, torch.nan)
    parts = zip(colors.split(CHANNELS, -1), scene.background.split(CHANNELS, -1), strict=True)
    return [scene._replace(colors=color, background=background) for color, background in parts]


def widen(x: Tensor, channels: int = CHANNELS) -> Tensor:
    """Pad the channels with zeros and return a contiguous tensor."""
    x, missing = x.contiguous(), channels - x.shape[-1]  # pad may keep a non-contiguous layout
    return torch.nn.functional.pad(x, (0, missing)) if missing else x


def narrow(x: Tensor, channels: int) -> Tensor:
    """Remove the channels that `widen` added."""
    return x if channels == CHANNELS else x[..., :channels]
