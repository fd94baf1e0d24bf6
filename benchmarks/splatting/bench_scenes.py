"""Scenes and cameras of the rasteriser's benchmark."""

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor


class Scene(NamedTuple):
    """Arguments of `rasterize`, one view."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


def make_scene(n: int, seed: int = 0) -> Scene:
    """Return 85 % torus (radii 0.7 and 0.3) and 15 % sphere (0.28), both 2 % thick; scales from
    3-NN distances with lognormal(0.35) stretch.
    """
    rng = np.random.default_rng(seed)
    torus = _torus(rng, int(n * 0.85))
    sphere = rng.standard_normal((n - len(torus), 3))
    sphere *= (
        0.28
        * (1 + 0.02 * rng.standard_normal((len(sphere), 1)))
        / np.linalg.norm(sphere, axis=1, keepdims=True)
    )
    points = np.concatenate([torus, sphere])[rng.permutation(n)]
    distances, _ = cKDTree(points).query(points, k=4, workers=-1)
    scales = np.sqrt((distances[:, 1:] ** 2).mean(1))[:, None] * np.exp(
        0.35 * rng.standard_normal((n, 3))
    )
    quats = rng.standard_normal((n, 4))
    arrays = (
        points,
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales,
        0.1 + 0.8 * rng.random(n),
        rng.random((n, 3)),
    )
    return Scene(*(torch.from_numpy(np.ascontiguousarray(a)).float() for a in arrays))


def _torus(rng: np.random.Generator, n: int, large: float = 0.7, small: float = 0.3) -> np.ndarray:
    """Sample uniformly by area: draws are kept in proportion to their distance from the axis."""
    kept = []
    while sum(map(len, kept)) < n:
        angles = rng.random((n, 2)) * 2 * math.pi
        kept.append(
            angles[rng.random(n) < (large + small * np.cos(angles[:, 1])) / (large + small)]
        )
    u, v = np.concatenate(kept)[:n].T
    thick = small * (1 + 0.02 * rng.standard_normal(n))
    radius = large + thick * np.cos(v)
    return np.stack([radius * np.cos(u), radius * np.sin(u), thick * np.sin(v)], 1)


def make_camera(
    size: int,
    azimuth: float = 30.0,
    elevation: float = 35.0,
    distance: float = 3.0,
    fov: float = 50.0,
) -> tuple[Tensor, Tensor]:
    """Return viewmat (4, 4) and K (3, 3) of a square image, looking at the origin; degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    position = distance * np.array(
        [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
    )
    forward = -position / distance
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    focal = 0.5 * size / math.tan(math.radians(fov) / 2)
    K = [[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]
    return torch.from_numpy(viewmat).float(), torch.tensor(K)


def make_cotangents(size: int) -> list[Tensor]:
    """Return fixed gradients of image (1, H, W, 3), depth and alpha (1, H, W, 1)."""
    noise = torch.randn(size, size, 5, generator=torch.Generator().manual_seed(1)) / size
    return [x.contiguous()[None] for x in noise.split([3, 1, 1], -1)]
