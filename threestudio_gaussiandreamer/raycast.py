"""Target images by ray casting a mesh: what training is scored against, made without our own splatting.

Colours are the mesh's own, without lights, from both sides of a face. Cameras are the host's (OpenGL ``c2w``; see
``cameras.py``): the ray through pixel (i, j) of an H x W image has the camera direction
``((j + 0.5 - W/2)/f, -(i + 0.5 - H/2)/f, -1)`` with ``f = H / (2 tan(fovy/2))``.
"""

import math
import os
from collections import OrderedDict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from .errors import UserError
from .meshes import Mesh, surface_colors

NEAR = 1e-6
RAYS_PER_CAST = 2**16


class MeshCaster:
    """Casts rays at one mesh with Embree; the scene is built once, ``render`` may be called from several threads."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._scene = _embree_scene(mesh)
        self._vertices = mesh.vertices.astype(np.float32)

    def render(
        self, c2w: Float[np.ndarray, "4 4"], fovy: float, height: int, width: int, supersample: int = 2
    ) -> Float[np.ndarray, "H W 4"]:
        """Premultiplied colour and coverage in [0, 1], float32, each pixel the mean of a regular supersample^2 grid.

        Args:
            c2w: OpenGL camera to world.
            fovy: vertical field of view in radians, in (0, pi).
        """
        if height < 1 or width < 1 or supersample < 1:
            raise UserError(f"a picture needs a size and supersample of at least 1, not {height}x{width} and {supersample}")
        c2w = np.asarray(c2w, dtype=np.float64)
        focal = height / (2 * math.tan(fovy / 2))
        top, bottom, left, right = self._bounds(c2w, focal, height, width)
        rows, columns = np.arange(top, bottom) - height / 2, np.arange(left, right) - width / 2
        image = np.zeros((height, width, 4), dtype=np.float32)
        for offsets in _offset_groups(supersample, len(rows) * len(columns)):
            image[top:bottom, left:right] += self._cast(c2w[:3, 3], _directions(c2w, focal, rows, columns, offsets)).sum(axis=0)
        return image / supersample**2

    def render_views(
        self, cameras: Iterable[tuple[np.ndarray, float]], height: int, width: int, *, supersample: int = 2, progress: str = ""
    ) -> Float[np.ndarray, "N H W 4"]:
        """``render`` of several (c2w, fovy) on all cores (embree and numpy's gathers release the GIL).

        ``progress`` names a progress bar; without it there is none.
        """
        from tqdm import tqdm

        cameras = list(cameras)
        images = np.empty((len(cameras), height, width, 4), dtype=np.float32)

        def fill(index: int) -> None:
            images[index] = self.render(*cameras[index], height, width, supersample=supersample)

        with ThreadPoolExecutor(max(1, min(len(cameras), os.cpu_count() or 1))) as pool:
            list(tqdm(pool.map(fill, range(len(cameras))), progress, len(cameras), disable=not progress, leave=False))
        return images

    def _bounds(self, c2w: np.ndarray, focal: float, height: int, width: int) -> tuple[int, int, int, int]:
        """The pixel rectangle (top, bottom, left, right) outside which no ray can hit: the vertices' on the screen."""
        x, y, z = ((self._vertices - c2w[:3, 3]) @ c2w[:3, :3]).T
        if (-z).min() < NEAR:
            return 0, height, 0, width
        columns, rows = width / 2 + focal * x / -z, height / 2 + focal * y / z
        top, bottom = np.clip([math.floor(rows.min()), math.ceil(rows.max())], 0, height)
        left, right = np.clip([math.floor(columns.min()), math.ceil(columns.max())], 0, width)
        return int(top), int(bottom), int(left), int(right)

    def _cast(self, origin: np.ndarray, directions: Float[np.ndarray, "S H W 3"]) -> Float[np.ndarray, "S H W 4"]:
        """Colour and coverage 1 where a ray hits, zeros elsewhere."""
        colors = np.zeros((*directions.shape[:-1], 4), dtype=np.float32)
        if not directions.size:
            return colors
        directions = directions.reshape(-1, 3)
        origins = np.ascontiguousarray(np.broadcast_to(origin.astype(np.float32), directions.shape))
        hits = self._scene.run(origins, directions, output=True)
        rows = np.flatnonzero(hits["primID"] >= 0)
        u, v = hits["u"][rows], hits["v"][rows]
        barycentric = np.stack([1 - u - v, u, v], axis=1)  # embree's u and v weigh the second and the third corner
        flat = colors.reshape(-1, 4)
        flat[rows, :3] = surface_colors(self.mesh, hits["primID"][rows], barycentric)
        flat[rows, 3] = 1
        return colors


def over_background(
    rgba: Float[np.ndarray | Tensor, "... 4"], background: Float[np.ndarray | Tensor, "... 3"]
) -> Float[np.ndarray | Tensor, "... 3"]:
    """Premultiplied ``rgba`` over ``background``: C + (1 - coverage) background. Takes numpy arrays and tensors alike."""
    return rgba[..., :3] + (1 - rgba[..., 3:]) * background


def _offset_groups(supersample: int, pixels: int) -> list[Float[np.ndarray, "S 2"]]:
    """The (row, column) places inside a pixel, in groups of at most RAYS_PER_CAST rays: memory doesn't grow with supersample."""
    places = (np.arange(supersample) + 0.5) / supersample
    offsets = np.stack(np.meshgrid(places, places, indexing="ij"), axis=-1).reshape(-1, 2)
    size = max(1, RAYS_PER_CAST // max(pixels, 1))
    return [offsets[start : start + size] for start in range(0, len(offsets), size)]


def _directions(c2w: np.ndarray, focal: float, rows: np.ndarray, columns: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """World directions (S, rows, columns, 3) float32, not normalised, at ``offsets`` in the pixels counted from the centre."""
    x = ((columns + offsets[:, 1:]) / focal)[:, None, :, None] * c2w[:3, 0]
    y = (-(rows + offsets[:, :1]) / focal)[:, :, None, None] * c2w[:3, 1]
    return (x + y - c2w[:3, 2]).astype(np.float32)


def _embree_scene(mesh: Mesh):
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise UserError(f"casting rays at a mesh needs embreex ({error}): run `pip install embreex`") from error
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    return scene


class TargetCache:
    """Pictures of a mesh from cameras seen before, as bytes; the one not asked for the longest makes room."""

    def __init__(self, caster: MeshCaster, supersample: int, capacity: int) -> None:
        self.caster, self.supersample, self.capacity = caster, supersample, capacity
        self._pictures: OrderedDict[tuple, Tensor] = OrderedDict()

    def __call__(self, c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"], height: int, width: int) -> UInt8[Tensor, "B H W 4"]:
        """Premultiplied colour and coverage of each camera, on the cameras' device."""
        cameras = list(zip(c2w.detach().float().cpu().numpy(), fovy.detach().tolist(), strict=True))
        keys = [(matrix.tobytes(), angle, height, width) for matrix, angle in cameras]
        missing = {key: camera for key, camera in zip(keys, cameras, strict=True) if key not in self._pictures}
        images = self.caster.render_views(missing.values(), height, width, supersample=self.supersample)
        found = {key: self._pictures[key] for key in keys if key not in missing}
        found |= {
            key: torch.from_numpy(np.round(image * 255).astype(np.uint8)).to(c2w.device) for key, image in zip(missing, images, strict=True)
        }
        self._remember(found)
        return torch.stack([found[key] for key in keys])

    def __len__(self) -> int:
        return len(self._pictures)

    def _remember(self, pictures: dict[tuple, Tensor]) -> None:
        for key, picture in pictures.items():
            self._pictures[key] = picture
            self._pictures.move_to_end(key)
        while len(self._pictures) > self.capacity:
            self._pictures.popitem(last=False)
