"""Helpers of the initialisation tests."""

from pathlib import Path

import numpy as np
import torch

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.gaussians.views import render_all, views_around
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.initialization import grow_points


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def sphere(count: int = 1000) -> np.ndarray:
    points = rng().normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def colored(points: np.ndarray, color: float = 0.5) -> PointCloud:
    return PointCloud(np.asarray(points, np.float32), np.full((len(points), 3), color, np.float32))


def started(cloud: PointCloud, **options) -> GaussianCloud:
    geometry = GaussianCloud({"grow": {"enabled": False}, **options})
    geometry.start_from(grow_points(cloud, geometry.cfg.grow))
    return geometry


def picture(geometry: GaussianCloud, frame: GaussianCloud | None = None) -> torch.Tensor:
    """Render three views of a cloud from cameras that frame ``frame``."""
    cloud, seen = (Gaussians.of(g).map(torch.Tensor.detach) for g in (geometry, frame or geometry))
    return render_all(cloud, views_around(seen, 3, 64))


# ---- damaged sources -----------------------------------------------------------------------------


def write_ply(
    path: Path, points: np.ndarray, colors: np.ndarray | None = None, faces: np.ndarray | tuple = ()
) -> Path:
    names = ["x", "y", "z", *(["red", "green", "blue"] if colors is not None else [])]
    rows = points if colors is None else np.concatenate([points, colors], axis=1)
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in names),
    ]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines = (
        header
        + [" ".join(f"{x!r}" for x in values) for values in rows.tolist()]
        + [f"3 {a} {b} {c}" for a, b, c in faces]
    )
    path.write_text("\n".join(lines) + "\n")
    return path


def write_obj(path: Path, points: np.ndarray, faces: np.ndarray) -> Path:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def ball_mesh(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions)
    return np.array(ball.vertices), np.array(ball.faces)
