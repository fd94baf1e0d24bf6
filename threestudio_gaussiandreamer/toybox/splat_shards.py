"""Pictures of the toybox's objects as Gaussians that show them imperfectly, for the judge.

A result of score distillation consists of a few thousand Gaussians, whose patterns are irregular
and have blurred edges. A classifier that has seen only ray-cast pictures takes such edges for other
colours. No network of the toybox takes part in these renders, so the judge stays independent of
those that it evaluates.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from ..cameras import Orbit, to_opencv
from ..meshes.mesh import Mesh, face_areas, sample_surface, surface_colors
from ..splatting import rasterize
from .views import SIZE, Shards

VERSION = 1
"""Changes with :func:`imperfect_gaussians`, so that no training reads earlier pictures."""
COUNT = (800, 4000)
"""Range of the number of Gaussians."""
WAVES = 6
"""Number of plane waves of a smooth error."""
WAVELENGTH = (0.15, 0.8)
"""Range of the wavelengths of smooth errors, world units."""
COLOR_SHIFT, SHAPE_SHIFT = 0.06, 0.025
"""Largest standard deviations of smooth displacements of the pattern and of the shape, world units.
"""
BLENDED = 12
"""Largest number of neighbouring points whose colours are averaged."""
COLOR_ERROR, COLOR_NOISE = 0.08, 0.12
"""Largest standard deviations of smooth errors of the colour, and of errors of each Gaussian's."""


class SplatShards(Shards):
    """Shards whose pictures are renders of :func:`imperfect_gaussians`."""

    file_names = f"splats{VERSION}", f"held-out-splats{VERSION}"

    def pictures(
        self, mesh: Mesh, orbit: Orbit, rng: np.random.Generator
    ) -> Float[np.ndarray, "N s s 4"]:
        return render_gaussians(imperfect_gaussians(mesh, rng), orbit, eps2d=0.1)  # as toybox.yaml


def render_gaussians(
    gaussians: Sequence[np.ndarray], orbit: Orbit, *, eps2d: float
) -> Float[np.ndarray, "N s s 4"]:
    """Render Gaussians from these cameras; return premultiplied RGBA in [0, 1].

    Args:
        gaussians: means, quaternions, scales, opacities and colours, as ``rasterize`` takes them.
        eps2d: dilation, square pixels.
    """
    viewmats, Ks = to_opencv(orbit.c2w, orbit.fovy, SIZE, SIZE)
    gaussians = [torch.from_numpy(np.float32(values)) for values in gaussians]
    drawn = rasterize(*gaussians, viewmats, Ks, SIZE, SIZE, preset="fast", eps2d=eps2d)
    alpha = drawn.alpha.reshape(*drawn.image.shape[:-1], 1)
    return torch.cat([drawn.image, alpha], dim=-1).clamp(0, 1).numpy()


def imperfect_gaussians(mesh: Mesh, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Cover a surface with Gaussians whose pattern, shape and colours have errors.

    The sizes of the errors are random, between none and the constants above, and the same for all
    Gaussians of an object.

    Returns:
        Means (N, 3), quaternions (N, 4), scales (N, 3), opacities (N,), and colours (N, 3) in
        [0, 1].
    """
    count = int(rng.integers(*COUNT))
    points, faces, barycentric = sample_surface(mesh, count, rng)
    colors = surface_colors(mesh, faces, barycentric)
    looked_up = points + smooth_field(points, COLOR_SHIFT * rng.uniform(), rng)
    _, near = cKDTree(points).query(looked_up, k=np.arange(1, rng.integers(2, BLENDED + 2)))
    colors = colors[near].mean(axis=1) + smooth_field(points, COLOR_ERROR * rng.uniform(), rng)
    colors = colors + rng.normal(0, COLOR_NOISE * rng.uniform(), (count, 3))
    means = points + smooth_field(points, SHAPE_SHIFT * rng.uniform(), rng)
    spacing = np.sqrt(face_areas(mesh).sum() / count)
    scales = spacing * rng.uniform(0.4, 0.9) * rng.uniform(0.6, 1.6, (count, 3))
    opacities = rng.uniform(0.5, 1.0) * rng.uniform(0.6, 1.0, count)
    return means, rng.normal(size=(count, 4)), scales, opacities, colors.clip(0, 1)


def smooth_field(
    points: Float[np.ndarray, "P 3"], deviation: float, rng: np.random.Generator
) -> Float[np.ndarray, "P 3"]:
    """Evaluate a random smooth vector field, a sum of plane waves, at these points.

    Args:
        points: world units.
        deviation: standard deviation of each component, in the unit of the result.
    """
    directions = rng.normal(size=(3, WAVES))
    lengths = rng.uniform(*WAVELENGTH, WAVES)
    waves = 2 * np.pi * directions / (np.linalg.norm(directions, axis=0) * lengths)
    phases = points @ waves + rng.uniform(0, 2 * np.pi, WAVES)
    return np.sin(phases) @ rng.normal(0, deviation * np.sqrt(2 / WAVES), (WAVES, 3))
