"""The stages of the CUDA backend: which kernel of ``*.cu`` gets which tensors. Nothing here waits
for the GPU.

project, rank (sort by depth), count tiles, list them, sort by tile, find each tile's list, blend;
and their adjoints. Sorts and running sums are torch's. An entry is a splat in a tile."""

import ctypes
import math
from typing import NamedTuple, Optional, Protocol, Union

import torch
from torch import Tensor

from ..options import RasterizeOptions

TILE, BLEND_THREADS, THREADS, WARP = 16, 256, 128, 32
SPLAT, ROW = 16, 12  # floats
NOWHERE = 2**31 - 1  # the tile of an entry that isn't used
CAMERA_SUMS = 12

Argument = Union[Tensor, ctypes.Structure, ctypes._SimpleCData]


class Later(Protocol):
    """Numbers on their way from the GPU."""

    def ready(self) -> bool: ...

    def values(self) -> list[int]:
        """Waits if it must."""


class Machine(Protocol):
    """What runs kernels: `cuda_driver.Gpu`, or a stand-in."""

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments: Argument) -> None:
        """Queues a kernel; ``arguments`` are tensors, structures and C numbers."""

    def read_later(self, numbers: Tensor) -> Later: ...


class Frame(NamedTuple):
    """What a call is told besides tensors."""

    width: int
    height: int
    options: RasterizeOptions
    tracked: bool
    machine: Machine

    @property
    def tiles(self) -> int:
        return -(-self.width // TILE) * -(-self.height // TILE)


class Inputs(NamedTuple):
    """Float32, contiguous, three channels; in the order of ``splat::Scene``."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    background: Tensor
    Ks: Tensor

    @property
    def shape(self) -> tuple[int, int]:
        """Views and Gaussians."""
        return len(self.viewmats), len(self.means)

    def of_views(self, first: int, last: int) -> "Inputs":
        per_view = {
            name: getattr(self, name)[first:last] for name in ("viewmats", "background", "Ks")
        }
        colors = self.colors[first:last] if self.colors.dim() == 3 else self.colors
        return self._replace(colors=colors, **per_view)


class Splats(NamedTuple):
    """What the first stages leave of B views of N Gaussians."""

    splats: Tensor  # (B, N, SPLAT)
    depth_keys: Tensor  # (B, N) int32, ordered as the depths; 2**31 - 1 for what isn't visible
    order: Tensor  # (B, N) int64, the Gaussians of each view front to back
    counts: Tensor  # (B, N) int32, how many tiles each of them reaches, in that order
    ends: Tensor  # (B, N) int64, their running sum through all views

    def of_views(self, first: int, last: int) -> "Splats":
        """The same of some views as if there were no others."""
        part = Splats(*(x[first:last] for x in self))
        return part._replace(ends=part.ends - self.ends[first - 1, -1]) if first else part


class Lists(NamedTuple):
    """The entries by tile; ``capacity`` is the length of the first two."""

    owners: Tensor  # int32, view * N + Gaussian of each entry
    entries: Tensor  # int64, sorted by tile, front to back in each
    begins: Tensor  # (B * tiles + 1) int64

    @property
    def capacity(self) -> int:
        return len(self.owners)


class Pictures(NamedTuple):
    """In the order of ``splat::Pictures``. The last two are what a backward pass needs of each
    rendered pixel, or None.
    """

    image: Tensor  # (B, H, W, 3)
    alpha: Tensor  # (B, H, W, 1)
    depth: Tensor  # (B, H, W, 1)
    color_depth: Optional[Tensor]  # (B, height, width, 4) in front of the background
    transmittance: Optional[Tensor]  # (B, height, width)


class Upstream(NamedTuple):
    """In the order of ``splat::Upstream``: gradients of the pictures, None for zero, and what the
    forward pass kept.
    """

    image: Optional[Tensor]
    alpha: Optional[Tensor]
    depth: Optional[Tensor]
    color_depth: Tensor
    transmittance: Tensor


class Gradients(NamedTuple):
    """In the order of ``splat::Gradients``."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    means2d: Tensor
    absgrad: Optional[Tensor]
    viewmats: Optional[Tensor]  # (blocks, B, CAMERA_SUMS), each block's part


def project(inputs: Inputs, means2d: Tensor, frame: Frame) -> tuple[Splats, Tensor, Tensor]:
    """Stages 1 to 3; also radii (B, N) and zeros (B, N) for the contributions. Fills
    ``means2d``.
    """
    launch, shape, new = frame.machine.launch, inputs.shape, inputs.means.new_empty
    splats, depth_keys, radii, contribution = (
        new(*shape, SPLAT),
        new(shape, dtype=torch.int32),
        new(shape),
        new(shape),
    )
    outputs = (splats, depth_keys, means2d.detach(), radii, contribution)
    launch(
        "project", _per_gaussian(shape), THREADS, _scene(inputs, frame), _settings(frame), *outputs
    )
    order = depth_keys.sort(dim=1, stable=True).indices
    counts = torch.zeros_like(depth_keys)
    launch(
        "count_tiles", _per_gaussian(shape), THREADS, _scene(inputs, frame), splats, order, counts
    )
    ends = counts.flatten().cumsum(0, dtype=torch.int64).view(shape)
    return Splats(splats, depth_keys, order, counts, ends), radii, contribution


def list_entries(inputs: Inputs, splats: Splats, capacity: int, frame: Frame) -> Lists:
    """Stages 4 and 5. Entries that don't fit are left out; `blend` notices.

    Raises:
        torch.cuda.OutOfMemoryError: there is no memory for so many.
    """
    launch, room, tiles = (
        frame.machine.launch,
        ctypes.c_int64(capacity),
        len(splats.ends) * frame.tiles,
    )
    tile_of = torch.full((capacity,), NOWHERE, dtype=torch.int32, device=splats.ends.device)
    owners = torch.empty_like(tile_of)
    arguments = (_scene(inputs, frame), splats.splats, *splats[2:], room, tile_of, owners)
    launch("list_tiles", _per_gaussian(inputs.shape), THREADS, *arguments)
    sorted_tiles, entries = tile_of.sort(stable=True)
    begins = splats.ends.new_empty(tiles + 1)
    launch(
        "find_tiles",
        (tiles // THREADS + 1, 1),
        THREADS,
        sorted_tiles,
        room,
        ctypes.c_int(tiles),
        begins,
    )
    return Lists(owners, entries, begins)


def no_lists(splats: Splats, frame: Frame) -> Lists:
    """With these `blend` looks at every Gaussian in every tile."""
    empty = splats.ends.new_empty(0)
    return Lists(empty.int(), empty, splats.ends.new_zeros(len(splats.ends) * frame.tiles + 1))


def blend(
    inputs: Inputs,
    splats: Splats,
    lists: Lists,
    pictures: Pictures,
    contribution: Tensor,
    frame: Frame,
) -> None:
    """Stage 6, with whole lists or without: the result is the same to the bit. Fills the pictures,
    raises the contributions.
    """
    arguments = (
        _settings(frame),
        _lists(splats, lists),
        _Pictures(*map(_address, pictures)),
        contribution,
    )
    frame.machine.launch(
        "blend",
        (frame.tiles, len(inputs.viewmats)),
        BLEND_THREADS,
        _scene(inputs, frame),
        *arguments,
    )


def blend_backward(
    inputs: Inputs, splats: Splats, lists: Lists, total: int, upstream: Upstream, frame: Frame
) -> Tensor:
    """The adjoints of stages 6 to 4: a row of sums for each splat (B, N, ROW); those of invisible
    ones aren't set.

    The lists must hold all of the ``total`` entries.

    Raises:
        torch.cuda.OutOfMemoryError: there is no memory for their rows.
    """
    launch, shape = frame.machine.launch, inputs.shape
    rows, sums = inputs.means.new_empty(max(total, 1), ROW), inputs.means.new_empty(*shape, ROW)
    name = "blend_backward_absolute" if frame.options.absgrad else "blend_backward"
    arguments = (_settings(frame), _lists(splats, lists), _Upstream(*map(_address, upstream)), rows)
    launch(name, (frame.tiles, shape[0]), BLEND_THREADS, _scene(inputs, frame), *arguments)
    launch(
        "sum_rows",
        _per_gaussian((shape[0], shape[1] * WARP)),
        THREADS,
        _scene(inputs, frame),
        *splats[1:],
        rows,
        sums,
    )
    return sums


def project_backward(
    inputs: Inputs, splats: Splats, sums: Tensor, gradients: Gradients, frame: Frame
) -> None:
    """The adjoint of stage 1, which fills ``gradients``."""
    arguments = (_settings(frame), splats.depth_keys, sums, _Gradients(*map(_address, gradients)))
    frame.machine.launch(
        "project_backward",
        _per_gaussian((1, inputs.shape[1])),
        THREADS,
        _scene(inputs, frame),
        *arguments,
    )


def empty_gradients(inputs: Inputs, absgrad: bool, viewmats: bool) -> Gradients:
    new, (views, gaussians) = inputs.means.new_empty, inputs.shape
    parts = new(-(-gaussians // THREADS), views, CAMERA_SUMS) if viewmats else None
    screen = new(views, gaussians, 2), new(views, gaussians, 2) if absgrad else None
    return Gradients(*(torch.empty_like(x) for x in inputs[:5]), *screen, parts)


def viewmats_gradient(parts: Tensor) -> Tensor:
    """The blocks' parts added up; the last row of a viewmat isn't read."""
    rows = parts.sum(0, dtype=torch.float64).float().view(-1, 3, 4)
    return torch.nn.functional.pad(rows, (0, 0, 0, 1))


def _per_gaussian(shape: tuple[int, int]) -> tuple[int, int]:
    """The grid for one thread per view and Gaussian."""
    return -(-shape[1] // THREADS), shape[0]


# ---- what kernels are told: *.h ------------------------------------------------------------------


class _Scene(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in Inputs._fields]
    _fields_ += [
        (name, ctypes.c_int)
        for name in ("gaussians", "views", "width", "height", "colors_per_view")
    ]


class _Settings(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_float)
        for name in ("near", "far", "eps2d", "log2_alpha_min", "alpha_max", "stop")
    ]
    _fields_ += [(name, ctypes.c_int) for name in ("antialias", "downsample")]


class _Lists(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_void_p)
        for name in ("splats", "order", "ends", "owners", "entries", "begins")
    ]
    _fields_ += [("capacity", ctypes.c_int64)]


class _Pictures(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in Pictures._fields]


class _Upstream(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in Upstream._fields]


class _Gradients(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in Gradients._fields]


def _scene(inputs: Inputs, frame: Frame) -> _Scene:
    views, gaussians = inputs.shape
    return _Scene(
        *map(_address, inputs),
        gaussians,
        views,
        frame.width,
        frame.height,
        inputs.colors.dim() == 3,
    )


def _settings(frame: Frame) -> _Settings:
    o = frame.options
    log2_alpha_min = math.log2(o.kernel_alpha_min)
    return _Settings(
        o.near, o.far, o.eps2d, log2_alpha_min, o.alpha_max, o.stop, o.antialias, o.downsample
    )


def _lists(splats: Splats, lists: Lists) -> _Lists:
    return _Lists(
        *map(_address, (splats.splats, splats.order, splats.ends, *lists)), lists.capacity
    )


def _address(tensor: Optional[Tensor]) -> Optional[int]:
    return None if tensor is None else tensor.data_ptr()
