"""``point-cloud-prior``: coloured points from a file: a scan, or another text-to-3D model's output.

============  ======================================================================================
option        meaning
============  ======================================================================================
path          PLY; NPZ with ``points`` and ``colors`` (``normals``); NPY, XYZ, TXT, PTS or CSV with
              columns x y z or x y z r g b; or any format of trimesh, whose vertices are taken (GLB,
              OBJ, ...)
normalize     centre the box and make its longest half side ``scale``; else the points stay as they
              are; null: with a ``producer``
scale         half the longest side, world units, with ``normalize``
up, front     the file's axes, ``+x`` to ``-z``; by default z is up and +x the front, but for
              modelling formats (GLB, OBJ, ...), where y is up and +z the front, and for a PLY of
              Gaussians, whose header says so, or -y is up and -z the front
producer      the program that wrote the file (docs/formats.md), instead of ``up`` and ``front``
ground, ...   see ``priors/base.py``
============  ======================================================================================

Colours are integers up to 255, whole numbers above 255 up to 65535 (16 bits, as in LAS exports), or
numbers up to 1; without any, the points are grey. Limits: the prompt is not read."""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

import numpy as np
from jaxtyping import Float

from ..core.errors import unknown
from ..core.files import existing_file
from ..formats.array_files import read_arrays
from ..formats.gaussian_files import ply_up
from ..formats.ply import is_gaussian_ply, read_points, require_ply, unit_colors
from ..formats.producers import GAUSSIANS, MESH
from ..formats.reading import reading, require
from ..gaussians.axes import FRONTS
from ..gaussians.grow import longest_side
from ..gaussians.point_cloud import PointCloud
from ..host import register
from ..meshes.load import mesh_formats, pose_rotation, read_parts
from ..meshes.mesh import GREY, vertex_surface_colors
from .base import FilePrior, file_axes

logger = logging.getLogger(__name__)

KIND = "point cloud"


@register("point-cloud-prior")
class PointCloudPrior(FilePrior):
    """Read points from a file."""

    @dataclass
    class Config(FilePrior.Config):
        front: Optional[str] = None
        normalize: Optional[bool] = None

        @staticmethod
        def check(cfg: Any) -> None:
            FilePrior.Config.check(cfg)
            pose_rotation(axes_kind(Path(cfg.path)), cfg.up, cfg.front)

    cfg: Config

    def preflight(self) -> None:
        point_file(self.cfg.path)

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        path = point_file(self.cfg.path)
        cloud, of_gaussians = load_points(path), is_gaussian_ply(path)
        up, front = file_axes(self.cfg, GAUSSIANS if of_gaussians else MESH)
        if up == "auto" and of_gaussians:
            named = ply_up(path)
            front = front or FRONTS[named]
            up = named if named.startswith("-") else f"+{named}"
        cloud = rotated(cloud, pose_rotation(axes_kind(path), up, front))
        return normalized(cloud, self.cfg.scale) if self.normalizes else cloud


def point_file(path: str) -> Path:
    """Return the path of a file of points, of which no more than a PLY's header is read."""
    file, known = existing_file(path, KIND), [f".{name}" for name in mesh_formats()]
    if file.suffix.lower() == ".ply":
        require_ply(file)
    elif file.suffix.lower() not in (*READERS, *known):
        raise unknown("point cloud format", file.suffix, [*READERS, *known])
    return file


def axes_kind(path: Path) -> str:
    """Return the mesh format whose default axes apply; point clouds have z up, as PLY."""
    return "ply" if path.suffix.lower() in READERS else path.suffix.lower().lstrip(".")


def load_points(path: Path) -> PointCloud:
    """Read the points of a file in its own axes; the extension determines the format."""
    with reading(path, KIND):
        return READERS.get(path.suffix.lower(), read_mesh_points)(path)


def rotated(cloud: PointCloud, rotation: Float[np.ndarray, "3 3"]) -> PointCloud:
    """Return the cloud with points and normals rotated."""
    normals = None if cloud.normals is None else cloud.normals @ rotation.T
    with np.errstate(invalid="ignore"):  # rows that aren't finite are dropped later
        return cloud._replace(points=cloud.points @ rotation.T, normals=normals)


def normalized(cloud: PointCloud, scale: float) -> PointCloud:
    """Centre the box of the finite rows at the origin, with half its longest side ``scale``."""
    points = np.asarray(cloud.points, np.float64)
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        return cloud
    centre = (finite.min(axis=0) + finite.max(axis=0)) / 2
    return cloud._replace(points=(points - centre) * (scale / (longest_side(finite) / 2 or 1.0)))


def read_text(path: Path) -> PointCloud:
    """Read numbers between blanks, commas or semicolons; skip a heading and lines with #."""
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = re.sub("[,;]", " ", text).splitlines()
    try:
        first = [float(word) for word in lines[0].split("#")[0].split()] if lines else [0.0, 0.0]
    except ValueError:
        first = []
    # the first line may be a count, or the names of the columns
    return _from_columns(path, np.loadtxt(lines[len(first) < 2 :], ndmin=2))


def read_mesh_points(path: Path) -> PointCloud:
    """Return the vertices and points of a mesh file, transformed by its scene graph."""
    parts = [part for part in read_parts(path) if len(part.vertices)]
    require(bool(parts), "it is empty: it has no vertices")
    colored = any(part.has_colors for part in parts)
    colors = np.concatenate([vertex_surface_colors(part) for part in parts]) if colored else None
    return _cloud(path, np.concatenate([part.vertices for part in parts]), colors)


def _from_columns(path: Path, rows: np.ndarray) -> PointCloud:
    """Interpret columns as x y z, x y z r g b, or x y z intensity r g b (PTS)."""
    expected = "rows of x y z or x y z r g b were expected"
    fits = rows.ndim == 2 and rows.shape[1] in (3, 6, 7)
    require(fits, f"it has shape {rows.shape}: {expected}")
    return _cloud(path, rows[:, :3], rows[:, -3:] if rows.shape[1] > 3 else None)


def _cloud(path: Path, points: np.ndarray, colors=None, normals=None) -> PointCloud:
    """Check the shapes of arrays; without colours the points are grey."""
    if colors is None:
        logger.warning("%s has no colours: grey is used", path)
        colors = np.full(np.shape(points), GREY, np.float32)
    for name, values in (("points", points), ("colors", colors), ("normals", normals)):
        shape, expected = np.shape(values), f"({len(points)}, 3) was expected"
        fits = values is None or shape == (len(points), 3)
        require(fits, f"{name} has shape {shape}: {expected}")
    # float64, since float32 would round points far from the origin before they are centred
    colors = unit_colors(np.asarray(colors).astype(np.float32), np.asarray(colors).dtype)
    normals = None if normals is None else np.asarray(normals, np.float32)
    return PointCloud(np.asarray(points, np.float64), colors, normals)


READERS: dict[str, Callable[[Path], PointCloud]] = {
    ".ply": read_points,
    ".npz": lambda path: _cloud(path, **read_arrays(path, KIND, ["points"], ["colors", "normals"])),
    ".npy": lambda path: _from_columns(path, read_arrays(path, KIND, ["rows"])["rows"]),
    **dict.fromkeys([".xyz", ".txt", ".pts", ".csv"], read_text),
}
