"""Scores of a task of benchmarks/quality/toybox.py: of a run and its prior, of the 2D model's own
samples, and of ray-cast views of the object itself.
"""

import functools
import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.quality.toybox_jobs import PROMPT_SEED, Prompt
from threestudio_gaussiandreamer import metrics
from threestudio_gaussiandreamer.core.streams import numpy_generator
from threestudio_gaussiandreamer.evaluation.asset_metrics import (
    ATTRIBUTES,
    Scores,
    prior_of,
    result_of,
)
from threestudio_gaussiandreamer.evaluation.results import render_views
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.meshes.mesh import Mesh
from threestudio_gaussiandreamer.toybox import recognition
from threestudio_gaussiandreamer.toybox.demo import samples
from threestudio_gaussiandreamer.toybox.views import BACKGROUND, SIZE, render
from threestudio_gaussiandreamer.toybox.world import RADIUS, object_mesh

FAINT = (0.03, 0.5)
"""Alpha of pixels that show neither object nor background."""

scores = functools.cache(Scores)


def of_run(folder: Path, prompt: str, models: str) -> dict[str, float]:
    """Score the result of a finished run, and the points that it started from as ``prior_...``."""
    asset = result_of(folder, prompt)
    found = scores(models).of_asset(asset) | haze(asset.gaussians)
    prior = scores(models).of_asset(prior_of(folder, asset))
    found |= {f"prior_{name}": prior[name] for name in (*ATTRIBUTES, "multi_face")}
    return found | {"gaussians": len(asset.gaussians.means)}


def looks_of(folder: Path, prompt: Prompt) -> dict[str, float]:
    """Return the ``saturation`` of a finished run's views, relative to that of the prompt's object,
    and ``at_limits``, the share of pixels of which a channel is 0 or 1.
    """
    views, truth = views_of(folder), truth_views(prompt).movedim(1, -1)
    relative = metrics.saturation(views) / metrics.saturation(truth)
    return {"saturation": relative, "at_limits": at_limits(views)}


def views_of(folder: Path) -> Float[Tensor, "V H W 3"]:
    """Render a finished run's result from the judge's directions."""
    cloud, orbit = result_of(folder, "").gaussians, recognition.views()
    pictures = render_views(cloud, orbit.c2w, orbit.fovy, SIZE, background=BACKGROUND)
    return torch.from_numpy(np.concatenate(list(pictures)))


def at_limits(views: Float[Tensor, "V H W 3"]) -> float:
    """Return the share of pixels of which a channel is 0 or 1 in 8 bits."""
    levels = (255 * views).round()
    return ((levels <= 0) | (levels >= 255)).any(-1).double().mean().item()


def object_of(prompt: Prompt) -> Mesh:
    """Return an object with the prompt's attributes."""
    rng = numpy_generator(PROMPT_SEED, "benchmark-mesh", prompt.index)
    return object_mesh(prompt.attributes, rng)


def of_truth(prompt: Prompt, models: str) -> dict[str, float]:
    """Score ray-cast views of the prompt's object: the judge's ceiling."""
    views = truth_views(prompt)
    own = {"saturation": 1.0, "at_limits": at_limits(views.movedim(1, -1))}
    return scores(models).of_pictures(views, prompt.text) | own


def truth_views(prompt: Prompt) -> Float[Tensor, "V 3 H W"]:
    """Ray-cast the prompt's object from the judge's directions."""
    rgba = torch.from_numpy(render(object_of(prompt), recognition.views())).movedim(-1, 1).float()
    grey = torch.tensor(BACKGROUND).reshape(1, 3, 1, 1)
    return rgba[:, :3] + (1 - rgba[:, 3:]) * grey


def of_samples(prompt: str, scale: float, seed: int, models: str) -> dict[str, float]:
    """Score what the 2D model draws for the directions of the judge's views."""
    pictures = samples(models, prompt, recognition.views(), guidance_scale=scale, seed=seed)
    return scores(models).of_pictures(pictures, prompt)


def haze(cloud: Gaussians) -> dict[str, float]:
    """Return ``haze``, the mean alpha outside of the sphere that contains all objects, and
    ``faint``, the share of pixels whose alpha is between the values of FAINT.
    """
    orbit = recognition.views()
    black, white = (
        np.concatenate([*render_views(cloud, orbit.c2w, orbit.fovy, SIZE, background=(x,) * 3)])
        for x in (0.0, 1.0)
    )
    alpha = 1 - (white - black).mean(axis=-1)
    y, x = (2 * (np.indices((SIZE, SIZE)) + 0.5) / SIZE - 1) * math.tan(float(orbit.fovy[0]) / 2)
    outside = np.hypot(x, y) > RADIUS / math.sqrt(float(orbit.distance[0]) ** 2 - RADIUS**2)
    between = (alpha > FAINT[0]) & (alpha < FAINT[1])
    return {"haze": float(alpha[:, outside].mean()), "faint": float(between.mean())}
