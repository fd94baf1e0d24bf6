"""``mesh-prior``: any triangle mesh as the coarse shape, in place of the output of a text-to-3D
model; and ``body-prior``, a posed human body (SMPL-like), as the paper starts from a text-to-motion
model.

================  ==================================================================================
option            meaning
================  ==================================================================================
path              GLB, glTF, OBJ, PLY, STL, OFF, ... with texture, vertex colours, face colours or
                  none (grey); no body comes with the package, since SMPL may not be passed on
scale             half the longest side of the result, world units; of the released code's body
                  about 1.7
up, front         the file's axes, ``+x`` to ``-z``; ``auto`` and null: by the kind of file (see
                  ``meshes/load.py``)
producer          the program that wrote the file (docs/formats.md), instead of ``up`` and
                  ``front``
num_points        0: the mesh's vertices, as the paper uses those of Shap-E's mesh; else this many
                  points, uniform over the surface; 50,000 of a body
color_smoothing   of ``mesh-prior``: average each colour over this many nearest points, which
                  imitates the coarse colours of a text-to-3D model
color             null: the mesh's colours; ``grey``, ``random`` (of a body, as in the paper) or
                  [r, g, b] in [0, 1] replace them
ground, ...       see ``priors/base.py``
================  ==================================================================================

The points of a body are recentred by their mean. Random colours are uniform in [0, 1]; those of the
released code are divided by 255, a flat grey. Limits: the prompt is not read. A low-polygon mesh
makes a sparse start: give ``num_points``."""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Optional

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float

from ..core.files import existing_file
from ..core.options import at_least
from ..formats.producers import MESH
from ..gaussians.point_cloud import PointCloud
from ..host import register
from ..meshes.load import load_mesh, mesh_file, pose_rotation
from ..meshes.mesh import Mesh, sample_surface, surface_colors, vertex_surface_colors
from .base import COLOR, FilePrior, Prior, chosen_colors, file_axes, points

logger = logging.getLogger(__name__)

SMOOTHED = 2**22
"""Neighbours that are averaged at a time, which bounds the memory."""


class MeshFilePrior(FilePrior):
    """Base class of priors that read a triangle mesh from a file."""

    @dataclass
    class Config(FilePrior.Config):
        front: Optional[str] = None
        num_points: int = field(default=0, metadata=points(0))
        color: Any = field(default=None, metadata=COLOR)

        @staticmethod
        def check(cfg: Any) -> None:
            FilePrior.Config.check(cfg)
            pose_rotation(Path(cfg.path).suffix.lower().lstrip("."), *file_axes(cfg, MESH))

    cfg: Config

    def preflight(self) -> None:
        mesh_file(self.cfg.path)

    def load(self) -> Mesh:
        """Return the mesh, scaled and turned into the world's axes."""
        up, front = file_axes(self.cfg, MESH)
        return load_mesh(self.cfg.path, scale=self.cfg.scale, up=up, front=front)


@register("mesh-prior")
class MeshPrior(MeshFilePrior):
    """Start from the vertices of a mesh, or from points on its surface."""

    @dataclass
    class Config(MeshFilePrior.Config):
        color_smoothing: int = field(default=0, metadata=at_least(0))
        REMOVED: ClassVar[dict[str, Any]] = {
            **Prior.Config.REMOVED,
            "jitter": (0, "positions have no noise"),
        }

    cfg: Config

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        cfg, mesh = self.cfg, self.load()
        if cfg.color is None and not mesh.has_colors:
            logger.warning("%s has no colours: grey is used", cfg.path)
        cloud = colored_cloud(mesh, cfg, generator)
        if cfg.color_smoothing > 1:
            cloud = cloud._replace(colors=smoothed_colors(cloud, cfg.color_smoothing))
        return cloud


@register("body-prior")
class BodyPrior(MeshFilePrior):
    """Points on a posed body, randomly coloured."""

    @dataclass
    class Config(MeshFilePrior.Config):
        num_points: int = field(default=50_000, metadata=points(0))
        color: Any = field(default="random", metadata=COLOR)

    cfg: Config

    def preflight(self) -> None:
        existing_file(self.cfg.path, "body mesh")  # no bundled mesh is a body
        super().preflight()

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        return centred(colored_cloud(self.load(), self.cfg, generator))


def centred(cloud: PointCloud) -> PointCloud:
    """Return the cloud with the mean of its points at the origin."""
    return cloud._replace(points=cloud.points - cloud.points.mean(axis=0))


def colored_cloud(mesh: Mesh, cfg: Any, generator: np.random.Generator) -> PointCloud:
    """Return the vertices of ``mesh`` with its faces, or ``cfg.num_points`` points on its surface,
    in the colours of ``cfg.color``.
    """
    if cfg.num_points == 0:
        cloud = PointCloud(mesh.vertices, vertex_surface_colors(mesh), faces=mesh.faces)
    else:
        points, faces, barycentric = sample_surface(mesh, cfg.num_points, generator)
        colors = surface_colors(mesh, faces, barycentric)
        cloud = PointCloud(points, colors, normals=face_normals(mesh)[faces])
    if cfg.color is None:
        return cloud
    return cloud._replace(colors=chosen_colors(cfg.color, len(cloud.points), generator))


def face_normals(mesh: Mesh) -> Float[np.ndarray, "F 3"]:
    """Return unit normals by the right-hand rule; zero for a face without area."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1.0)


def smoothed_colors(cloud: PointCloud, neighbours: int) -> Float[np.ndarray, "P 3"]:
    """Return each colour averaged over the ``neighbours`` nearest points, itself among them."""
    from scipy.spatial import cKDTree

    tree, count = cKDTree(cloud.points), min(neighbours, len(cloud.points))
    colors = torch.from_numpy(np.array(cloud.colors))  # a copy: torch warns of read-only arrays
    averages = []
    for part in np.array_split(cloud.points, -(-count * len(cloud.points) // SMOOTHED)):
        # a range, since the result for k=1 would lack the second dimension
        _, nearest = tree.query(part, k=range(1, count + 1), workers=-1)
        averages.append(F.embedding_bag(torch.from_numpy(nearest), colors, mode="mean").numpy())
    return np.concatenate(averages)
