"""Render target images by ray casting a mesh, independently of the splatting.

Colours are unlit, and faces are visible from both sides. Cameras are the host's (OpenGL ``c2w``;
see ``cameras.py``): the ray through pixel (i, j) of an H x W image has the camera direction
``((j + 0.5 - W/2)/f, -(i + 0.5 - H/2)/f, -1)`` with ``f = H / (2 tan(fovy/2))``.

Where embree isn't installed, a z-buffer in NumPy finds the visible triangles, in homogeneous
coordinates (Olano and Greer 1997, "Triangle Scan Conversion using 2D Homogeneous Coordinates").
With corners a, b, c in camera coordinates and the ray d = (x, y, -1), the edge functions
d . (b x c), d . (c x a), d . (a x b) all have the sign of det(a, b, c) exactly if the ray hits the
triangle in front of the camera. They are proportional to the barycentric weights, and their sum
over the determinant is 1 / depth, so that triangles that cross the camera's plane aren't clipped.
"""

import functools
import logging
import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from .mesh import Mesh, surface_colors

RAYS_PER_CAST = 2**15
PIXELS_PER_CAST = 2**20
"""Pixels of pictures that :class:`TargetCache` casts together."""
log = logging.getLogger(__name__)
NEAR = 1e-6
PAIRS_PER_STEP = 2**17
"""(triangle, sample) pairs that are tested at once, to bound the memory and use the CPU's cache."""
SLACK = 1e-6
"""Margin around a triangle's box in pixels, for its rounding errors."""


class MeshCaster:
    """Casts rays at one mesh, whose acceleration structure is built once; thread-safe."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._hits = _fastest_hits(mesh)
        self._vertices = mesh.vertices.astype(np.float32)

    def render_views(
        self,
        cameras: Iterable[tuple[np.ndarray, float]],
        height: int,
        width: int,
        *,
        supersample: int = 2,
        progress: str = "",
    ) -> Float[np.ndarray, "N H W 4"]:
        """Render premultiplied colour and coverage in [0, 1], float32, in threads on all cores.

        Args:
            cameras: OpenGL camera to world (4, 4), and vertical field of view, radians.
            supersample: each pixel is the mean of a regular supersample x supersample grid.
            progress: label of a bar that terminals show; empty for none.
        """
        from tqdm import tqdm

        cameras = list(cameras)
        images = np.zeros((len(cameras), height, width, 4), dtype=np.float32)
        # one task per band of rows instead of per picture, so that one picture uses all cores too
        bands = [
            fill
            for image, camera in zip(images, cameras, strict=True)
            for fill in self._bands(image, *camera, supersample)
        ]
        hidden = None if progress else True  # None: shown in terminals
        with ThreadPoolExecutor(min(len(bands) or 1, os.cpu_count() or 1)) as pool:
            drawn = pool.map(lambda fill: fill(), bands)
            list(tqdm(drawn, progress, len(bands), unit="band", disable=hidden, leave=False))
        return images

    def visible(
        self, c2w: Float[np.ndarray, "4 4"], fovy: float, height: int, width: int
    ) -> tuple[tuple[int, int], Int[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
        """Return what is seen at the centres of the pixels that the mesh may cover: the row and the
        column of the first of them, and for each the nearest face, -1 for none, with its weights.
        """
        focal = height / (2 * math.tan(fovy / 2))
        top, bottom, left, right = self._bounds(c2w, focal, height, width)
        rows, columns = _samples(top, bottom, 1) - height / 2, _samples(left, right, 1) - width / 2
        return (top, left), *self._hits(c2w, focal, rows, columns)

    def _bands(
        self, image: Float[np.ndarray, "H W 4"], c2w: np.ndarray, fovy: float, supersample: int
    ) -> list[Callable[[], None]]:
        """Return functions that each render a band of rows into ``image``, in any order."""
        height, width = image.shape[:2]
        c2w = np.asarray(c2w, dtype=np.float64)
        focal = height / (2 * math.tan(fovy / 2))
        top, bottom, left, right = self._bounds(c2w, focal, height, width)
        columns = _samples(left, right, supersample) - width / 2

        def fill(start: int, end: int) -> None:
            rows = _samples(start, end, supersample) - height / 2
            face_index, barycentric = self._hits(c2w, focal, rows, columns)
            seen = face_index >= 0
            colors = np.zeros((*seen.shape, 4), dtype=np.float32)
            colors[seen, :3] = surface_colors(self.mesh, face_index[seen], barycentric[seen])
            colors[seen, 3] = 1
            shape = end - start, supersample, right - left, supersample, 4
            image[start:end, left:right] = colors.reshape(shape).mean(axis=(1, 3))

        if not len(columns):
            return []
        # at most RAYS_PER_CAST rays at once, or one row, to bound the memory
        size = max(1, RAYS_PER_CAST // (supersample * len(columns)))
        starts = range(top, bottom, size)
        return [functools.partial(fill, start, min(start + size, bottom)) for start in starts]

    def _bounds(
        self, c2w: np.ndarray, focal: float, height: int, width: int
    ) -> tuple[int, int, int, int]:
        """Return top, bottom, left, right of the vertices, pixels; the image if any is behind."""
        x, y, z = ((self._vertices - c2w[:3, 3]) @ c2w[:3, :3]).T
        if (-z).min() < NEAR:
            return 0, height, 0, width
        columns, rows = width / 2 + focal * x / -z, height / 2 + focal * y / z
        top, bottom = np.clip([math.floor(rows.min()), math.ceil(rows.max())], 0, height)
        left, right = np.clip([math.floor(columns.min()), math.ceil(columns.max())], 0, width)
        return int(top), int(bottom), int(left), int(right)


def over_background(
    rgba: Float[np.ndarray | Tensor, "... 4"], background: Float[np.ndarray | Tensor, "... 3"]
) -> Float[np.ndarray | Tensor, "... 3"]:
    """Composite premultiplied ``rgba`` over ``background``, NumPy arrays or tensors."""
    return rgba[..., :3] + (1 - rgba[..., 3:]) * background


def _samples(start: int, end: int, supersample: int) -> Float[np.ndarray, " S"]:
    """Return the coordinates of a regular grid of samples in the pixels start ... end - 1."""
    return start + (np.arange((end - start) * supersample) + 0.5) / supersample


def _fastest_hits(mesh: Mesh) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Return :func:`zbuffer_hits` of a mesh, or its equivalent by embree."""
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        _report_slow_caster(str(error))
        return functools.partial(zbuffer_hits, mesh.vertices.astype(np.float64), mesh.faces)
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    return functools.partial(_embree_hits, scene)


@functools.cache
def _report_slow_caster(reason: str) -> None:
    log.warning(
        "embreex is missing (%s): drawing the mesh with plain numpy, which is slower; `pip "
        "install embreex` for speed, except on Linux on ARM, for which it has no wheel.",
        reason,
    )


def _embree_hits(
    scene: Any, c2w: np.ndarray, focal: float, rows: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    x, y = (columns / focal)[:, None] * c2w[:3, 0], (-rows / focal)[:, None, None] * c2w[:3, 1]
    directions = (x + y - c2w[:3, 2]).astype(np.float32).reshape(-1, 3)
    origins = np.ascontiguousarray(np.broadcast_to(c2w[:3, 3].astype(np.float32), directions.shape))
    hits = scene.run(origins, directions, output=True)
    u, v = hits["u"], hits["v"]
    # embree's u and v are the weights of the second and the third corner
    barycentric = np.stack([1 - u - v, u, v], axis=1)
    shape = len(rows), len(columns)
    return hits["primID"].reshape(shape), barycentric.reshape(*shape, 3)


class TargetCache:
    """Cache of up to ``capacity`` images of a mesh, as bytes; evicts the least recently used."""

    def __init__(self, caster: MeshCaster, supersample: int, capacity: int) -> None:
        self.caster, self.supersample, self.capacity = caster, supersample, capacity
        self._pictures: dict[tuple, Tensor] = {}  # the least recently used first
        self._planned: dict[tuple, tuple[np.ndarray, float]] = {}

    def plan(
        self, c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"], height: int, width: int
    ) -> None:
        """Announce images that will be requested; they are cast many at once with missing ones."""
        keyed = {_key(camera, height, width): camera for camera in _cameras(c2w, fovy)}
        self._planned |= {key: keyed[key] for key in keyed if key not in self._pictures}

    def __call__(
        self, c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"], height: int, width: int
    ) -> UInt8[Tensor, "B H W 4"]:
        """Return premultiplied colour and coverage for each camera, on the cameras' device."""
        return torch.stack(self.planes(c2w, fovy, height, width)).movedim(1, -1)

    def planes(
        self, c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"], height: int, width: int
    ) -> list[UInt8[Tensor, "4 H W"]]:
        """Return the cached pictures themselves, not to be changed, with their channels first."""
        cameras = _cameras(c2w, fovy)
        keys = [_key(camera, height, width) for camera in cameras]
        asked = dict(zip(keys, cameras, strict=True))
        missing = {key: camera for key, camera in asked.items() if key not in self._pictures}
        found = {key: self._pictures[key] for key in asked if key not in missing}
        if missing:
            for key in missing:
                self._planned.pop(key, None)
            room = max(0, PIXELS_PER_CAST // (height * width) - len(missing))
            beside = [key for key in self._planned if key[2:] == (height, width)][:room]
            missing |= {key: self._planned.pop(key) for key in beside}
            images = self.caster.render_views(
                missing.values(), height, width, supersample=self.supersample
            )
            for key, image in zip(missing, images, strict=True):
                planes = np.moveaxis(np.round(image * 255).astype(np.uint8), -1, 0)
                found[key] = torch.from_numpy(np.ascontiguousarray(planes)).to(c2w.device)
        for key, picture in found.items():
            self._pictures.pop(key, None)
            self._pictures[key] = picture
        for key in list(self._pictures)[: max(len(self._pictures) - self.capacity, 0)]:
            del self._pictures[key]
        return [found[key] for key in keys]


def _cameras(
    c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"]
) -> list[tuple[Float[np.ndarray, "4 4"], float]]:
    matrices = c2w.detach().float().cpu().numpy()
    return list(zip(matrices, fovy.detach().tolist(), strict=True))


def _key(camera: tuple[np.ndarray, float], height: int, width: int) -> tuple:
    return camera[0].tobytes(), camera[1], height, width


# ---- the z-buffer --------------------------------------------------------------------------------


def zbuffer_hits(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    c2w: Float[np.ndarray, "4 4"],
    focal: float,
    rows: Float[np.ndarray, " H"],
    columns: Float[np.ndarray, " W"],
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
    """Return the nearest face at each sample, -1 for none, and the weights of its three corners (0
    for none); of faces at equal depth the first. Faces are visible from both sides.

    Args:
        rows, columns: ascending coordinates of the samples in pixels relative to the image's
            centre, rows downwards.
    """
    corners = ((vertices - c2w[:3, 3]) @ c2w[:3, :3])[faces]
    box = _boxes(corners, focal, rows, columns)
    index = np.flatnonzero((box[:, 0] < box[:, 1]) & (box[:, 2] < box[:, 3]))
    a, b, c = np.moveaxis(corners[index], 1, 0)
    edges = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = np.einsum("tc,tc->t", a, edges[:, 0])
    edges *= np.sign(volume)[:, None, None]
    seen = volume != 0  # not exactly edge-on
    index, edges, volume = index[seen], edges[seen], np.abs(volume[seen])
    x, y = columns / focal, -rows / focal

    def edge_functions(triangle: np.ndarray, corner: int, sample: np.ndarray) -> np.ndarray:
        """Return the edge function opposite a corner for each pair, >= 0 inside."""
        edge, (row, column) = edges[triangle, corner], np.divmod(sample, len(columns))
        return x[column] * edge[:, 0] + y[row] * edge[:, 1] - edge[:, 2]

    nearest = np.full(len(rows) * len(columns), -1)
    inverse_depth, weights = np.zeros(len(nearest)), np.zeros((len(nearest), 3))
    for triangle, sample in _pairs(box[index], len(columns)):
        total = 0.0
        for corner in range(3):
            value = edge_functions(triangle, corner, sample)
            inside = value >= 0
            triangle, sample, total = triangle[inside], sample[inside], (total + value)[inside]
        value = total / volume[triangle]
        nearer = (value > inverse_depth[sample]) & (value < 1 / NEAR)
        triangle, sample, value = triangle[nearer], sample[nearer], value[nearer]
        np.maximum.at(inverse_depth, sample, value)
        best = np.flatnonzero(value == inverse_depth[sample])
        places, first = np.unique(sample[best], return_index=True)
        nearest[places] = triangle[best[first]]
    sample = np.flatnonzero(nearest >= 0)
    found = [edge_functions(nearest[sample], corner, sample) for corner in range(3)]
    weights[sample] = np.stack(found, axis=1) / sum(found)[:, None]
    nearest[sample] = index[nearest[sample]]
    shape = len(rows), len(columns)
    return nearest.reshape(shape), weights.reshape(*shape, 3)


def _pairs(
    box: Int[np.ndarray, "T 4"], width: int
) -> Iterator[tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]]:
    """Yield pairs (triangle, sample in its box) by triangle, up to ``PAIRS_PER_STEP`` at a time."""
    across = box[:, 3] - box[:, 2]
    ends = np.cumsum((box[:, 1] - box[:, 0]) * across)
    starts = np.concatenate([[0], ends[:-1]])
    for first in range(0, ends[-1] if len(ends) else 0, PAIRS_PER_STEP):
        last = min(first + PAIRS_PER_STEP, ends[-1])
        some = np.arange(np.searchsorted(ends, first, "right"), np.searchsorted(starts, last))
        triangle = np.repeat(some, np.minimum(ends[some], last) - np.maximum(starts[some], first))
        row, column = np.divmod(np.arange(first, last) - starts[triangle], across[triangle])
        yield triangle, (box[triangle, 0] + row) * width + box[triangle, 2] + column


def _boxes(
    corners: Float[np.ndarray, "F 3 3"], focal: float, rows: np.ndarray, columns: np.ndarray
) -> Int[np.ndarray, "F 4"]:
    """Return the box of samples around the part of each triangle in front of the near plane (first
    row, end, first column, end), empty where there is none.
    """
    depth, points = -corners[..., 2] - NEAR, [corners]
    with np.errstate(invalid="ignore", divide="ignore"):
        if (depth < 0).any():  # move corners behind the plane to it, along both edges; else NaN
            points = []
            for turn in (1, 2):
                other = np.roll(depth, turn, axis=1)
                along = np.where(other < 0, np.nan, depth / (depth - other))
                along = np.where(depth < 0, along, 0)[..., None]
                points.append(corners + along * (np.roll(corners, turn, axis=1) - corners))
        x, y, z = np.moveaxis(np.concatenate(points, axis=1), 2, 0)
        places = (rows, focal * y / z), (columns, focal * x / -z)
    ends = []
    for samples, values in places:
        ends.append(np.searchsorted(samples, np.fmin.reduce(values, axis=1) - SLACK))
        ends.append(np.searchsorted(samples, np.fmax.reduce(values, axis=1) + SLACK, "right"))
    return np.stack(ends, axis=1)
