"""The CUDA backend: every launch processes all views, the forward pass doesn't synchronise with the
GPU, and results are bitwise reproducible.

The number of tile intersections (pairs of a splat and a tile) is only known on the GPU, so their
lists get 1.5 times the capacity that earlier calls of the same size needed; the first call waits
for the number. A scene that needs more is still rendered exactly, but without lists, which is
slower. Its backward pass, which waits for the number, makes complete lists, and later calls get a
larger capacity. If memory is short, fewer views are processed at a time.

The stages are: 1 project; 2 sort by depth; 3 count tiles; 4 list intersections and sort them by
tile; 5 find each tile's list; 6 blend; and their adjoints. Sorts and cumulative sums are torch's.
"""

import ctypes
import functools
import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Optional, TypeVar

import torch
from torch import Tensor

from ...core.devices import HostCopy
from ...core.errors import UserError
from .. import autograd, torch_backend
from ..autograd import Drawn, SceneGradients, Upstream
from ..scene import Rasterized, RasterizeOptions, Scene, SceneStruct, Settings, pointers
from . import driver

TILE, BLEND_THREADS, THREADS = 16, 256, 128
SUM_LANES = 4  # threads that add the rows of one splat
SPLAT, ROW = 16, 12  # floats
NOWHERE = 2**31 - 1  # the tile of an intersection that isn't used
CAMERA_SUMS, CAMERA_THREADS = 12, 384
MOST_SPLATS = 2**31 - 1  # views times Gaussians; kernels number them with 32 bits
MOST_VIEWS = 2**16 - 1  # the second side of a grid
HEADROOM = 1.5
STEP = 8192
"""Intersections. Rounding up makes torch's caching allocator reuse blocks; up to 4096 numbers are
sorted by another kernel of torch, which would have to be loaded too."""
MAX_INTERSECTIONS = 2**31 - 1 - STEP  # torch's sort and the kernels use 32-bit indices
DECAY = 0.99  # of the estimate, per call
# per intersection: tile, owner, sorted tile, position, temporaries of the sort, and a row of sums
BACKWARD_BYTES = (4 + 4 + 4 + 8 + 20) + 4 * 12
Result = TypeVar("Result")
log = logging.getLogger(__name__)


class Batch(NamedTuple):
    """A scene, or some of its views, that kernels process together; its tensors must outlive it.
    Its struct is made once, since that takes longer than a launch.
    """

    scene: Scene
    struct: SceneStruct
    settings: Settings
    device: Any
    """A `driver.Gpu`, which launches kernels."""

    @property
    def views(self) -> int:
        return self.struct.views

    @property
    def tiles(self) -> int:
        """Tiles of one view."""
        return -(-self.scene.width // TILE) * -(-self.scene.height // TILE)

    def of_views(self, first: int, last: int) -> "Batch":
        """Select the views ``first`` to ``last - 1``."""
        scene = self.scene.of_views(first, last)
        return self._replace(scene=scene, struct=scene.struct())

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments: Any) -> None:
        """Queue a kernel whose first parameter is the scene."""
        self.device.launch(name, grid, threads, self.struct, *arguments)


class Splats(NamedTuple):
    """Output of stages 1 to 3 for B views of N Gaussians."""

    splats: Tensor  # (B, N, SPLAT)
    depth_keys: Tensor  # (B, N) int32, in the order of depths; 2**31 - 1 for invisible splats
    order: Tensor  # (B, N) int64, the Gaussians of each view front to back
    counts: Tensor  # (B, N) int32, the number of tiles that each reaches, in the order of `order`
    ends: Tensor  # (B, N) int64, cumulative sum of the counts over all views

    def of_views(self, first: int, last: int) -> "Splats":
        """Select the views ``first`` to ``last - 1``; ``ends`` restarts at the first of them."""
        part = Splats(*(x[first:last] for x in self))
        return part._replace(ends=part.ends - self.ends[first - 1, -1]) if first else part


class Lists(NamedTuple):
    """The intersections sorted by tile; ``capacity`` is the length of the first two tensors."""

    owners: Tensor  # int32, view * N + Gaussian of each intersection
    sorted: Tensor  # int64, indices into owners sorted by tile, front to back in each tile
    begins: Tensor  # (B * tiles + 1) int64, start of each tile in sorted

    @property
    def capacity(self) -> int:
        return self.owners.shape[0]


Images = tuple[Optional[Tensor], ...]
"""The pointers of the struct ``splat::Images``, filled by stage 6: image (B, H, W, 3), alpha and
depth (B, H, W, 1), and, kept for backward or None, colour and depth without the background (B,
height, width, 4) and transmittance (B, height, width). ``splat::Upstream`` has the gradients of the
first three, None for zero, in their places."""


def project(batch: Batch, means2d: Tensor, out: Drawn) -> Splats:
    """Run stages 1 to 3; fill ``means2d`` and the radii, and set the contributions to zero."""
    shape, new = batch.scene.shape, batch.scene.means.new_empty
    splats, depth_keys = new(*shape, SPLAT), new(shape, dtype=torch.int32)
    outputs = (splats, depth_keys, means2d.detach(), out.radii, out.contribution)
    grid = _per_gaussian(*shape)
    batch.launch("project", grid, THREADS, batch.settings, *outputs)
    order = depth_keys.sort(dim=1, stable=True).indices
    counts = torch.zeros_like(depth_keys)
    batch.launch("count_tiles", grid, THREADS, splats, order, counts)
    ends = counts.flatten().cumsum(0, dtype=torch.int64).view(shape)
    return Splats(splats, depth_keys, order, counts, ends)


def list_intersections(batch: Batch, splats: Splats, capacity: int) -> Lists:
    """Run stages 4 and 5. Intersections beyond the capacity are left out; `blend` detects that.

    Raises:
        torch.cuda.OutOfMemoryError: there is no memory for so many.
    """
    room, tiles = ctypes.c_int64(capacity), batch.views * batch.tiles
    tile_of = torch.full((capacity,), NOWHERE, dtype=torch.int32, device=splats.ends.device)
    owners = torch.empty_like(tile_of)
    arguments = (splats.splats, *splats[2:], room, tile_of, owners)
    batch.launch("list_tiles", _per_gaussian(*batch.scene.shape), THREADS, *arguments)
    sorted_tiles, by_tile = tile_of.sort(stable=True)
    begins = splats.ends.new_empty(tiles + 1)
    grid, arguments = (tiles // THREADS + 1, 1), (sorted_tiles, room, ctypes.c_int(tiles), begins)
    batch.device.launch("find_tiles", grid, THREADS, *arguments)
    return Lists(owners, by_tile, begins)


def no_lists(batch: Batch, splats: Splats) -> Lists:
    """Return empty lists, with which `blend` tests every Gaussian in every tile."""
    empty = splats.ends.new_empty(0)
    return Lists(empty.int(), empty, splats.ends.new_zeros(batch.views * batch.tiles + 1))


def blend(batch: Batch, splats: Splats, lists: Lists, images: Images, contribution: Tensor) -> None:
    """Run stage 6: fill the images, and raise the contributions.

    If the lists are incomplete, every splat is tested in every tile, with bitwise the same result.
    """
    arguments = (batch.settings, _lists(splats, lists), pointers(*images), contribution)
    batch.launch("blend", (batch.tiles, batch.views), BLEND_THREADS, *arguments)


def blend_backward(
    batch: Batch, splats: Splats, lists: Lists, total: int, upstream: Images, absolute: bool
) -> Tensor:
    """Run the adjoints of stages 6 to 4: return a row of sums for each splat (B, N, ROW); rows of
    invisible splats aren't set.

    The lists must be complete: they hold all of the ``total`` intersections. ``absolute`` adds the
    sums of absolute gradients to the rows.

    Raises:
        torch.cuda.OutOfMemoryError: there is no memory for their rows.
    """
    (views, gaussians), new = batch.scene.shape, batch.scene.means.new_empty
    rows, sums = new(max(total, 1), ROW), new(views, gaussians, ROW)
    name = "blend_backward_absolute" if absolute else "blend_backward"
    arguments = (batch.settings, _lists(splats, lists), pointers(*upstream), rows)
    batch.launch(name, (batch.tiles, batch.views), BLEND_THREADS, *arguments)
    grid = _per_gaussian(views, gaussians * SUM_LANES)
    batch.launch("sum_rows", grid, THREADS, *splats[1:], rows, sums)
    return sums


def project_backward(
    batch: Batch, depth_keys: Tensor, sums: Tensor, out: SceneGradients, absgrad: Optional[Tensor]
) -> None:
    """Run the adjoint of stage 1: fill ``out``, and add to ``absgrad`` unless it is None."""
    views, gaussians = batch.scene.shape
    grid = _per_gaussian(1, gaussians)
    parts = None if out.viewmats is None else sums.new_empty(grid[0], views, CAMERA_SUMS)
    found = pointers(*out[:4], out.colors, out.means2d, absgrad, parts)
    arguments = (batch.settings, depth_keys, sums, found)
    batch.launch("project_backward", grid, THREADS, *arguments)
    if parts is not None:  # each block's, summed in double precision
        arguments = (parts, ctypes.c_int(len(parts)), out.viewmats)
        batch.launch("sum_cameras", (1, views), CAMERA_THREADS, *arguments)


def _per_gaussian(views: int, gaussians: int) -> tuple[int, int]:
    """Return the grid for one thread per view and Gaussian."""
    return -(-gaussians // THREADS), views


class _Lists(ctypes.Structure):
    """``splat::Lists`` of tile.h."""

    _fields_ = [
        *((n, ctypes.c_void_p) for n in "splats order ends owners sorted begins".split()),
        ("capacity", ctypes.c_int64),
    ]


def _lists(splats: Splats, lists: Lists) -> _Lists:
    tensors = splats.splats, splats.order, splats.ends, *lists
    return _Lists(*pointers(*tensors), lists.capacity)


# ---- the backend ---------------------------------------------------------------------------------


def unavailable() -> Optional[str]:
    """Return why the backend can't be used, or None if it can; compiles nothing."""
    return driver.unavailable()


def rasterize(scene: Scene, options: RasterizeOptions) -> Rasterized:
    """Draw all views of a validated scene."""
    views, gaussians = scene.shape
    if views * gaussians > MOST_SPLATS or views > MOST_VIEWS:
        raise UserError(
            f"{views} views of {gaussians} Gaussians are too many for one call: draw fewer "
            "views at a time."
        )
    if not gaussians:  # nothing to launch
        return torch_backend.rasterize(scene, options)
    settings = options.struct(math.log2(options.kernel_alpha_min))
    kernel = CudaKernel(driver.device(scene.means.device), settings, scene.tracked)
    return autograd.rasterize(kernel, scene, options)


class CudaKernel(NamedTuple):
    """One call of the kernels; see ``autograd.py``."""

    device: Any
    settings: Settings
    tracked: bool

    def forward(
        self, scene: Scene, means2d: Tensor, out: Drawn
    ) -> tuple[tuple[Tensor, ...], HostCopy]:
        """Render; the state for backward is the number of intersections up to each view's last."""
        batch = Batch(scene, scene.struct(), self.settings, self.device)
        splats = project(batch, means2d, out)
        totals = self.device.read_async(splats.ends[:, -1])
        size, new = (batch.views, scene.height, scene.width), scene.means.new_empty
        kept = (new(*size, 4), new(size)) if self.tracked else (None, None)
        lists = _draw(batch, splats, totals, (*out[:3], *kept, out.contribution))
        return (*splats, *lists, *kept) if self.tracked else (), totals

    def backward(
        self,
        scene: Scene,
        means2d: Tensor,
        saved: Sequence[Tensor],
        totals: HostCopy,
        upstream: Upstream,
        out: SceneGradients,
    ) -> None:
        """Differentiate; waits for the numbers of intersections."""
        batch = Batch(scene, scene.struct(), self.settings, self.device)
        splats, lists = Splats(*saved[:5]), Lists(*saved[5:8])
        absgrad = getattr(means2d, "absgrad", None)
        upstream = (*upstream, *saved[8:])
        sums = _sums_of_rows(batch, splats, lists, totals.values(), upstream, absgrad is not None)
        project_backward(batch, splats.depth_keys, sums, out, absgrad)


def _draw(batch: Batch, splats: Splats, totals: HostCopy, images: Images) -> Lists:
    """Fill the images, the last of which are the contributions; return the lists, which are
    incomplete if the capacity was too small.

    The capacity is estimated from earlier calls. If there is no memory for it, the views are halved
    until each part fits; a part's lists have the exact size, and are freed after it is rendered. A
    single view that doesn't fit is rendered without lists."""
    views, gaussians = batch.scene.shape
    key = (batch.scene.means.device, views, *batch.scene.size)
    estimate = _estimates.setdefault(key, CapacityEstimate(views))

    def draw(part: Batch, splats: Splats, images: Images) -> Lists:
        try:
            if part is batch:
                capacity = estimate.capacity(totals, gaussians)
            else:
                capacity = round_up_capacity(int(splats.ends[-1, -1]))
            lists = list_intersections(part, splats, capacity)
        except torch.cuda.OutOfMemoryError:
            if part.views > 1:
                estimate.record_failure(gaussians)
                raise
            _report_short_memory()
            lists = no_lists(part, splats)
        blend(part, splats, lists, images[:-1], images[-1])
        return lists

    parts = _halve_on_oom(draw, batch, splats, images)
    return parts[0] if len(parts) == 1 else no_lists(batch, splats)


@functools.cache
def _report_short_memory() -> None:
    log.warning(
        "the GPU's memory is too short for the lists of a view's tiles: it is drawn without "
        "them, which takes much longer."
    )


def _sums_of_rows(
    batch: Batch, splats: Splats, lists: Lists, ends: Tensor, upstream: Images, absolute: bool
) -> Tensor:
    """Run `blend_backward` on the views, fewer at a time if memory is short; complete the lists."""

    def sums(part: Batch, splats: Splats, upstream: Images) -> Tensor:
        whole = part is batch
        total = int(ends[-1] if whole else splats.ends[-1, -1])
        own = lists
        if not whole or total > lists.capacity:
            own = list_intersections(part, splats, round_up_capacity(total))
        return blend_backward(part, splats, own, total, upstream, absolute)

    try:
        parts = _halve_on_oom(sums, batch, splats, upstream)
    except torch.cuda.OutOfMemoryError as error:
        largest = int(ends.diff(prepend=ends.new_zeros(1)).max())
        raise UserError(
            f"one view's Gaussians overlap {largest} tiles of the image; their gradients need "
            f"about {largest * BACKWARD_BYTES / 2**30:.1f} GiB on the GPU. Views are already "
            "rendered one at a time: use fewer or smaller Gaussians, a smaller image or "
            "preset='fast', or free memory of other programs."
        ) from error
    return parts[0] if len(parts) == 1 else torch.cat(parts)


# ---- room for the lists --------------------------------------------------------------------------


def _halve_on_oom(
    work: Callable[[Batch, Splats, Images], Result], batch: Batch, splats: Splats, images: Images
) -> list[Result]:
    """Call ``work`` with these, or for each half if memory is short; return results in order."""
    try:
        return [work(batch, splats, images)]
    except torch.cuda.OutOfMemoryError:
        if batch.views == 1:
            raise
    # Outside the except block, where the traceback would keep the attempt's tensors alive.
    results, middle = [], batch.views // 2
    for first, last in ((0, middle), (middle, batch.views)):
        some = tuple(None if x is None else x[first:last] for x in images)
        part = batch.of_views(first, last), splats.of_views(first, last), some
        results += _halve_on_oom(work, *part)
    return results


def round_up_capacity(intersections: int) -> int:
    """Round a number of intersections up to the next capacity.

    Raises:
        torch.cuda.OutOfMemoryError: the number exceeds 32-bit indices.
    """
    if intersections > MAX_INTERSECTIONS:
        raise torch.cuda.OutOfMemoryError(f"{intersections} intersections")
    return (intersections // STEP + 1) * STEP


class CapacityEstimate:
    """Estimates the intersections per Gaussian from earlier calls with the same size.

    Numbers arrive from the GPU asynchronously. Methods are thread-safe.
    """

    def __init__(self, views: int):
        self.views = views
        self.per_gaussian: Optional[float] = None
        self.failed_capacity = math.inf  # smallest capacity that didn't fit into memory
        self.pending: deque[tuple[HostCopy, int]] = deque()
        self.lock = threading.Lock()

    def capacity(self, totals: HostCopy, gaussians: int) -> int:
        """Return the capacity for a call, given its own number of intersections, still being copied
        from the GPU, as the last value of ``totals``.

        Raises:
            torch.cuda.OutOfMemoryError: this capacity has failed before, and there are several
                views, so that parts of them can be tried instead.
        """
        with self.lock:
            self.pending.append((totals, gaussians))
            while self.pending and (self.per_gaussian is None or self.pending[0][0].ready()):
                earlier, count = self.pending.popleft()
                found = int(earlier.values()[-1]) / count
                # at once to a larger number, slowly to a smaller one
                self.per_gaussian = max(DECAY * (self.per_gaussian or 0.0), found)
            capacity = self._capacity(gaussians)
        if self.views > 1 and capacity >= self.failed_capacity:
            raise torch.cuda.OutOfMemoryError(f"{capacity} intersections")
        return capacity

    def record_failure(self, gaussians: int) -> None:
        """Record that the capacity for this many Gaussians didn't fit into memory."""
        with self.lock:
            self.failed_capacity = min(self.failed_capacity, self._capacity(gaussians))

    def _capacity(self, gaussians: int) -> int:
        expected = math.ceil(self.per_gaussian * gaussians)
        most = min(math.ceil(HEADROOM * expected), MAX_INTERSECTIONS)
        return round_up_capacity(max(expected, most))


_estimates: dict[tuple, CapacityEstimate] = {}
