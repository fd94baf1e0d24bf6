"""The stages of the CUDA backend: each allocates tensors and launches kernels of ``*.cu``, without
waiting for the GPU.

The stages are: 1 project; 2 sort by depth; 3 count tiles; 4 list intersections and sort them by
tile; 5 find each tile's list; 6 blend; and their adjoints. Sorts and cumulative sums are torch's.
An intersection is a pair of a splat and a tile that it reaches."""

import ctypes
from typing import Any, NamedTuple, Optional

import torch
from torch import Tensor

from ..autograd import Drawn, SceneGradients
from ..scene import Scene, SceneStruct, Settings, pointers

TILE, BLEND_THREADS, THREADS = 16, 256, 128
SUM_LANES = 4  # threads that add the rows of one splat
SPLAT, ROW = 16, 12  # floats
NOWHERE = 2**31 - 1  # the tile of an intersection that isn't used
CAMERA_SUMS, CAMERA_THREADS = 12, 384


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

    If the lists are incomplete, every splat is tested in every tile; the result is bitwise the
    same.
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
