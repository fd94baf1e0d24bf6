"""The stages of the CUDA backend: each allocates tensors and launches kernels of ``*.cu``, without
waiting for the GPU.

The stages are: 1 project; 2 sort by depth; 3 count tiles; 4 list intersections and sort them by
tile; 5 find each tile's list; 6 blend; and their adjoints. Sorts and cumulative sums are torch's.
An intersection is a pair of a splat and a tile that it reaches."""

import ctypes
import math
from typing import NamedTuple, Optional, Protocol, Union

import torch
from torch import Tensor

from ..options import RasterizeOptions
from ..scene import Scene, SceneStruct, address

TILE, BLEND_THREADS, THREADS = 16, 256, 128
SUM_LANES = 4  # threads that add the rows of one splat
SPLAT, ROW = 16, 12  # floats
NOWHERE = 2**31 - 1  # the tile of an intersection that isn't used
CAMERA_SUMS, CAMERA_THREADS = 12, 384

Argument = Union[Tensor, ctypes.Structure, ctypes.c_int, ctypes.c_int64]


class AsyncReadback(Protocol):
    """Numbers that are being copied from the GPU; ``values`` waits until they have arrived."""

    def ready(self) -> bool: ...

    def values(self) -> list[int]: ...


class Device(Protocol):
    """Interface of `driver.Gpu`, which launches kernels."""

    def launch(
        self, name: str, grid: tuple[int, int], threads: int, *arguments: Argument
    ) -> None: ...

    def read_async(self, numbers: Tensor) -> AsyncReadback: ...


class LaunchContext(NamedTuple):
    """Options and device of a call; ``tracked`` tells whether a backward pass may follow."""

    options: RasterizeOptions
    settings: "Settings"
    tracked: bool
    device: Device


class Batch(NamedTuple):
    """A scene, or some of its views, that kernels process together. Its struct is made once, since
    that takes longer than a launch.
    """

    scene: Scene
    struct: SceneStruct
    context: LaunchContext

    @property
    def views(self) -> int:
        return self.struct.views

    def of_views(self, first: int, last: int) -> "Batch":
        """Select the views ``first`` to ``last - 1``."""
        if last - first == self.views:
            return self
        return make_batch(self.scene.of_views(first, last), self.context)

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments: Argument) -> None:
        """Queue a kernel whose first parameter is the scene."""
        self.context.device.launch(name, grid, threads, self.struct, *arguments)


def make_context(options: RasterizeOptions, tracked: bool, device: Device) -> LaunchContext:
    """Return the context of a call, whose settings all of its launches share."""
    return LaunchContext(options, Settings.of(options), tracked, device)


def make_batch(scene: Scene, context: LaunchContext) -> Batch:
    """Return a scene, whose tensors must outlive the batch, with its struct."""
    return Batch(scene, scene.struct(), context)


class Splats(NamedTuple):
    """Output of stages 1 to 3 for B views of N Gaussians."""

    splats: Tensor  # (B, N, SPLAT)
    depth_keys: Tensor  # (B, N) int32, in the order of depths; 2**31 - 1 for invisible splats
    order: Tensor  # (B, N) int64, the Gaussians of each view front to back
    counts: Tensor  # (B, N) int32, the number of tiles that each reaches, in the order of `order`
    ends: Tensor  # (B, N) int64, cumulative sum of the counts over all views

    def of_views(self, first: int, last: int) -> "Splats":
        """Select the views ``first`` to ``last - 1``; ``ends`` restarts at the first of them."""
        if last - first == self.ends.shape[0]:
            return self
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


class Images(NamedTuple):
    """Output of stage 6, in the order of the struct ``splat::Images``. The last two are kept for
    backward, else None.
    """

    image: Tensor  # (B, H, W, 3)
    alpha: Tensor  # (B, H, W, 1)
    depth: Tensor  # (B, H, W, 1)
    color_depth: Optional[Tensor]  # (B, height, width, 4) without the background
    transmittance: Optional[Tensor]  # (B, height, width)


class BlendUpstream(NamedTuple):
    """Input of stage 6's adjoint, in the order of the struct ``splat::Upstream``: gradients of the
    images, None for zero, and what the forward pass kept.
    """

    image: Optional[Tensor]
    alpha: Optional[Tensor]
    depth: Optional[Tensor]
    color_depth: Tensor
    transmittance: Tensor


class Gradients(NamedTuple):
    """Output of stage 1's adjoint, in the order of the struct ``splat::Gradients``. ``absgrad`` is
    added to, the others are set.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    means2d: Tensor
    absgrad: Optional[Tensor]
    camera_parts: Optional[Tensor]  # (blocks, B, CAMERA_SUMS), each block's part for the viewmats


def tiles_per_view(scene: Scene) -> int:
    return -(-scene.width // TILE) * -(-scene.height // TILE)


def project(batch: Batch, means2d: Tensor) -> tuple[Splats, Tensor, Tensor]:
    """Run stages 1 to 3 and fill ``means2d``; also return radii (B, N) and contributions (B, N),
    which are still zero.
    """
    shape, new = batch.scene.shape, batch.scene.means.new_empty
    splats, depth_keys = new(*shape, SPLAT), new(shape, dtype=torch.int32)
    radii, contribution = new(shape), new(shape)
    outputs = (splats, depth_keys, means2d.detach(), radii, contribution)
    grid = _per_gaussian(shape)
    batch.launch("project", grid, THREADS, batch.context.settings, *outputs)
    order = depth_keys.sort(dim=1, stable=True).indices
    counts = torch.zeros_like(depth_keys)
    batch.launch("count_tiles", grid, THREADS, splats, order, counts)
    ends = counts.flatten().cumsum(0, dtype=torch.int64).view(shape)
    return Splats(splats, depth_keys, order, counts, ends), radii, contribution


def list_intersections(batch: Batch, splats: Splats, capacity: int) -> Lists:
    """Run stages 4 and 5. Intersections beyond the capacity are left out; `blend` detects that.

    Raises:
        torch.cuda.OutOfMemoryError: there is no memory for so many.
    """
    room, tiles = ctypes.c_int64(capacity), batch.views * tiles_per_view(batch.scene)
    tile_of = torch.full((capacity,), NOWHERE, dtype=torch.int32, device=splats.ends.device)
    owners = torch.empty_like(tile_of)
    arguments = (splats.splats, *splats[2:], room, tile_of, owners)
    batch.launch("list_tiles", _per_gaussian(batch.scene.shape), THREADS, *arguments)
    sorted_tiles, by_tile = tile_of.sort(stable=True)
    begins = splats.ends.new_empty(tiles + 1)
    grid, arguments = (tiles // THREADS + 1, 1), (sorted_tiles, room, ctypes.c_int(tiles), begins)
    batch.context.device.launch("find_tiles", grid, THREADS, *arguments)
    return Lists(owners, by_tile, begins)


def no_lists(batch: Batch, splats: Splats) -> Lists:
    """Return empty lists, with which `blend` tests every Gaussian in every tile."""
    empty = splats.ends.new_empty(0)
    begins = splats.ends.new_zeros(batch.views * tiles_per_view(batch.scene) + 1)
    return Lists(empty.int(), empty, begins)


def blend(
    batch: Batch, splats: Splats, lists: Lists, pictures: Images, contribution: Tensor
) -> None:
    """Run stage 6: fill the images, and raise the contributions.

    If the lists are incomplete, every splat is tested in every tile; the result is bitwise the
    same.
    """
    arguments = (_lists(splats, lists), _Images(*map(address, pictures)), contribution)
    batch.launch("blend", _per_tile(batch), BLEND_THREADS, batch.context.settings, *arguments)


def blend_backward(
    batch: Batch, splats: Splats, lists: Lists, total: int, upstream: BlendUpstream
) -> Tensor:
    """Run the adjoints of stages 6 to 4: return a row of sums for each splat (B, N, ROW); rows of
    invisible splats aren't set.

    The lists must be complete: they hold all of the ``total`` intersections.

    Raises:
        torch.cuda.OutOfMemoryError: there is no memory for their rows.
    """
    shape, new, context = batch.scene.shape, batch.scene.means.new_empty, batch.context
    rows, sums = new(max(total, 1), ROW), new(*shape, ROW)
    name = "blend_backward_absolute" if context.options.absgrad else "blend_backward"
    arguments = (_lists(splats, lists), _Upstream(*map(address, upstream)), rows)
    batch.launch(name, _per_tile(batch), BLEND_THREADS, context.settings, *arguments)
    grid = _per_gaussian((shape[0], shape[1] * SUM_LANES))
    batch.launch("sum_rows", grid, THREADS, *splats[1:], rows, sums)
    return sums


def project_backward(batch: Batch, splats: Splats, sums: Tensor, gradients: Gradients) -> None:
    """Run the adjoint of stage 1, which fills ``gradients``."""
    arguments = (splats.depth_keys, sums, _Gradients(*map(address, gradients)))
    grid = _per_gaussian((1, batch.scene.shape[1]))
    batch.launch("project_backward", grid, THREADS, batch.context.settings, *arguments)


def empty_gradients(scene: Scene, absgrad: Optional[Tensor], viewmats: bool) -> Gradients:
    """Allocate the gradients but ``absgrad``; those that aren't needed are None."""
    new, (views, gaussians) = scene.means.new_empty, scene.shape
    parts = new(-(-gaussians // THREADS), views, CAMERA_SUMS) if viewmats else None
    own = (*scene[:4], scene.colors)
    return Gradients(*(torch.empty_like(x) for x in own), new(views, gaussians, 2), absgrad, parts)


def sum_cameras(batch: Batch, parts: Tensor) -> Tensor:
    """Sum the blocks' parts (blocks, B, CAMERA_SUMS), in double precision, to the gradient of the
    viewmats (B, 4, 4); that of the last row is 0. Torch would launch four kernels.
    """
    viewmats = torch.empty_like(batch.scene.viewmats)
    arguments = (parts, ctypes.c_int(len(parts)), viewmats)
    batch.launch("sum_cameras", (1, batch.views), CAMERA_THREADS, *arguments)
    return viewmats


def _per_gaussian(shape: tuple[int, int]) -> tuple[int, int]:
    """Return the grid for one thread per view and Gaussian."""
    return -(-shape[1] // THREADS), shape[0]


def _per_tile(batch: Batch) -> tuple[int, int]:
    """Return the grid for one block per view and tile."""
    return tiles_per_view(batch.scene), batch.views


# ---- structs of the kernels: *.h -----------------------------------------------------------------


class Settings(ctypes.Structure):
    _fields_ = [
        *((n, ctypes.c_float) for n in "near far eps2d log2_alpha_min alpha_max stop".split()),
        *((n, ctypes.c_int) for n in "antialias downsample".split()),
    ]

    @classmethod
    def of(cls, o: RasterizeOptions) -> "Settings":
        limits = (o.near, o.far, o.eps2d, math.log2(o.kernel_alpha_min), o.alpha_max, o.stop)
        return cls(*limits, o.antialias, o.downsample)


class _Lists(ctypes.Structure):
    _fields_ = [
        *((n, ctypes.c_void_p) for n in "splats order ends owners sorted begins".split()),
        ("capacity", ctypes.c_int64),
    ]


class _Images(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in Images._fields]


class _Upstream(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in BlendUpstream._fields]


class _Gradients(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in Gradients._fields]


def _lists(splats: Splats, lists: Lists) -> _Lists:
    return _Lists(*map(address, (splats.splats, splats.order, splats.ends, *lists)), lists.capacity)
