"""The CUDA backend: every launch processes all views, the forward pass doesn't synchronise with the
GPU, and results are bitwise reproducible.

The number of tile intersections (pairs of a splat and a tile) is only known on the GPU, so their
lists get 1.5 times the capacity that earlier calls of the same size needed; the first call waits
for the number. A scene that needs more is still rendered exactly, but without lists, which is
slower. Its backward pass, which waits for the number, makes complete lists, and later calls get a
larger capacity. If memory is short, fewer views are processed at a time."""

import functools
import logging
from typing import NamedTuple, Optional

import torch
from torch import Tensor

from ...core.errors import UserError
from .. import autograd
from ..autograd import CHANNELS, Drawn, SceneGradients, Upstream
from ..options import RasterizeOptions
from ..output import Rasterized
from ..scene import Scene
from . import driver
from .memory import CapacityEstimate, halve_on_oom, round_up_capacity, too_large
from .stages import (
    AsyncReadback,
    Batch,
    BlendUpstream,
    Images,
    LaunchContext,
    Lists,
    Splats,
    blend,
    blend_backward,
    empty_gradients,
    list_intersections,
    make_batch,
    make_context,
    no_lists,
    project,
    project_backward,
    sum_cameras,
)

MOST_SPLATS = 2**31 - 1  # views times Gaussians; kernels number them with 32 bits
MOST_VIEWS = 2**16 - 1  # the second side of a grid
_estimates: dict[tuple, CapacityEstimate] = {}
log = logging.getLogger(__name__)


def unavailable() -> Optional[str]:
    """Return why the backend can't be used, or None if it can; compiles nothing."""
    return driver.unavailable()


def rasterize(scene: Scene, options: RasterizeOptions) -> Rasterized:
    """Draw all views of a validated scene."""
    _check_count(*scene.shape)
    context = make_context(options, scene.tracked, driver.device(scene.means.device))
    return autograd.rasterize(CudaKernel(context), scene, options)


def _check_count(views: int, gaussians: int) -> None:
    if views * gaussians > MOST_SPLATS or views > MOST_VIEWS:
        raise UserError(
            f"{views} views of {gaussians} Gaussians are too many for one call: draw fewer "
            "views at a time."
        )


class CudaKernel(NamedTuple):
    """One call of the kernels; see :class:`..autograd.Kernel`."""

    context: LaunchContext

    def forward(
        self, scene: Scene, means2d: Tensor
    ) -> tuple[Drawn, tuple[Tensor, ...], Optional[AsyncReadback]]:
        """Render; the state for backward is the number of intersections of each view."""
        if not len(scene.means):
            images = _background_alone(scene, self.context)
            return Drawn(*images[:3], *means2d.new_zeros(2, *scene.shape)), (), None
        batch = make_batch(scene, self.context)
        splats, radii, contribution = project(batch, means2d)
        totals = self.context.device.read_async(splats.ends[:, -1])
        images = _empty_images(scene, self.context)
        lists = _draw(batch, splats, totals, images, contribution)
        kept = (*splats, *lists, *images[3:]) if self.context.tracked else ()
        return Drawn(*images[:3], radii, contribution), kept, totals

    def backward(
        self,
        scene: Scene,
        means2d: Tensor,
        saved: tuple[Tensor, ...],
        state: Optional[AsyncReadback],
        upstream: Upstream,
        wants_viewmats: bool,
    ) -> SceneGradients:
        """Differentiate; waits for the numbers of intersections."""
        absgrad = means2d.absgrad if self.context.options.absgrad else None
        found = empty_gradients(scene, absgrad, wants_viewmats)
        viewmats = torch.zeros_like(scene.viewmats) if wants_viewmats and not saved else None
        if saved:
            splats, lists = Splats(*saved[:5]), Lists(*saved[5:8])
            blended = BlendUpstream(*upstream, *saved[8:])
            batch = make_batch(scene, self.context)
            sums = _sums_of_rows(batch, splats, lists, state.values(), blended)
            project_backward(batch, splats, sums, found)
            if found.camera_parts is not None:
                viewmats = sum_cameras(batch, found.camera_parts)
        return SceneGradients(*found[:4], viewmats, found.colors, found.means2d)


def _draw(
    batch: Batch, splats: Splats, totals: AsyncReadback, images: Images, contribution: Tensor
) -> Lists:
    """Fill the images; return the lists, which are incomplete if the capacity was too small.

    The capacity is estimated from earlier calls. If there is no memory for it, the views are halved
    until each part fits; a part's lists have the exact size, and are freed after it is rendered. A
    single view that doesn't fit is rendered without lists."""
    views, gaussians = batch.scene.shape
    key = (batch.scene.means.device, views, *batch.scene.size)
    estimate = _estimates.setdefault(key, CapacityEstimate(views))

    def draw(first: int, last: int) -> Lists:
        part = (batch.of_views(first, last), splats.of_views(first, last))
        try:
            if last - first == views:
                capacity = estimate.capacity(totals, gaussians)
            else:
                capacity = round_up_capacity(sum(totals.values()[first:last]))
            lists = list_intersections(*part, capacity)
        except torch.cuda.OutOfMemoryError:
            if last - first > 1:
                estimate.record_failure(gaussians)
                raise
            _report_short_memory()
            lists = no_lists(*part)
        pictures = _of_views(images, first, last, views)
        blend(*part, lists, pictures, contribution[first:last])
        return lists

    parts = halve_on_oom(draw, 0, views)
    return parts[0] if len(parts) == 1 else no_lists(batch, splats)


@functools.cache
def _report_short_memory() -> None:
    log.warning(
        "the GPU's memory is too short for the lists of a view's tiles: it is drawn without "
        "them, which takes much longer."
    )


def _sums_of_rows(
    batch: Batch, splats: Splats, lists: Lists, totals: list[int], upstream: BlendUpstream
) -> Tensor:
    """Run `blend_backward` on all views, or on fewer at a time if memory is short; lists that are
    incomplete are made again.

    Raises:
        UserError: there is no memory for a single view.
    """
    views = len(totals)

    def sums(first: int, last: int) -> Tensor:
        total = sum(totals[first:last])
        part = (batch.of_views(first, last), splats.of_views(first, last))
        whole = last - first == views and total <= lists.capacity
        own = lists if whole else list_intersections(*part, round_up_capacity(total))
        return blend_backward(*part, own, total, _of_views(upstream, first, last, views))

    try:
        parts = halve_on_oom(sums, 0, views)
    except torch.cuda.OutOfMemoryError as error:
        raise too_large(max(totals)) from error
    return parts[0] if len(parts) == 1 else torch.cat(parts)


# ---- tensors -------------------------------------------------------------------------------------


def _of_views(tensors, first: int, last: int, views: int):
    """Select some of all views of every tensor of a named tuple."""
    if last - first == views:
        return tensors
    return type(tensors)(*(None if x is None else x[first:last] for x in tensors))


def _empty_images(scene: Scene, context: LaunchContext) -> Images:
    size, new = (len(scene.viewmats), scene.height, scene.width), scene.means.new_empty
    kept = (new(*size, 4), new(size)) if context.tracked else (None, None)
    shown = _shown_size(scene, context)
    return Images(*(new(*shown, channels) for channels in (CHANNELS, 1, 1)), *kept)


def _shown_size(scene: Scene, context: LaunchContext) -> tuple[int, int, int]:
    """Return the number of views, rows and columns after downsampling."""
    scale = context.options.downsample
    return len(scene.viewmats), scene.height // scale, scene.width // scale


def _background_alone(scene: Scene, context: LaunchContext) -> Images:
    """Return the images of an empty scene; no kernel is launched."""
    size, new = _shown_size(scene, context), scene.means.new_zeros
    image = new(*size, CHANNELS) + scene.background[:, None, None]
    return Images(image, new(*size, 1), new(*size, 1), None, None)
