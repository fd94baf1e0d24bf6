"""Scores of text to 3D with the toybox's models: of a run, of its prior, of the 2D model's own
samples, and of ray-cast views of the object itself.
"""

import argparse
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.quality.toybox_jobs import PROMPT_SEED, Prompt
from threestudio_gaussiandreamer.core.streams import numpy_generator
from threestudio_gaussiandreamer.evaluation.asset_metrics import (
    Asset,
    Clip,
    Janus,
    Recognized,
    shared_judge,
)
from threestudio_gaussiandreamer.evaluation.results import Pictures, find_result, read_result
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.toybox import recognition
from threestudio_gaussiandreamer.toybox.prompt_attributes import attributes_in
from threestudio_gaussiandreamer.toybox.samples import samples
from threestudio_gaussiandreamer.toybox.views import BACKGROUND, SIZE, render
from threestudio_gaussiandreamer.toybox.world import RADIUS, draw_attributes, object_mesh
from threestudio_gaussiandreamer.training.initialization import gaussians_on_points

RECOGNIZED = ("kind", "colors", "pattern", "accessory", "multi_face")
MEASURED = (*RECOGNIZED, "clip", "haze", "faint", "gaussians")
FAINT = (0.03, 0.5)
"""Alpha of pixels that show neither object nor background."""


class Models(NamedTuple):
    """Where the models are; ``folder`` is ``toybox`` or that of an export."""

    folder: str

    def metrics(self) -> list[Any]:
        args = argparse.Namespace(judge=self.folder, clip=self.folder, size=SIZE)
        return [Recognized(args), Janus(args), Clip(args)]


def scores_of_run(folder: Path, prompt: str, models: Models) -> dict[str, float]:
    """Score the result of a finished run, and the points that it started from as ``prior_...``."""
    result = find_result(str(folder))
    asset = Asset(result, prompt, read_result(result), 0)
    found = of_asset(asset, models) | {"gaussians": len(asset.gaussians.means)}
    start = folder / "save/prior/points.npz"
    with np.load(start, allow_pickle=False) as file:
        cloud = PointCloud(file["points"], file["colors"])
    prior = of_asset(asset._replace(gaussians=drawn(cloud)), models)
    return found | {f"prior_{name}": prior[name] for name in RECOGNIZED}


def of_asset(asset: Asset, models: Models) -> dict[str, float]:
    found: dict[str, float] = {}
    for metric in models.metrics():
        found |= metric.score(asset)
    return found | haze(asset.gaussians)


def drawn(cloud: PointCloud) -> Gaussians:
    """Draw points as nearly opaque Gaussians, as large as their distances."""
    options = argparse.Namespace(
        max_gaussians=10**6, scale_rule="nearest", scale_factor=1.0, init_opacity=0.95
    )
    return gaussians_on_points(cloud, options)


def haze(cloud: Gaussians) -> dict[str, float]:
    """Return ``haze``, the mean alpha outside of the sphere that contains all objects, and
    ``faint``, the share of pixels whose alpha is between the values of FAINT.
    """
    orbit = recognition.views()
    black, white = (
        np.concatenate(list(Pictures(cloud, color).render(orbit.c2w, orbit.fovy, SIZE)))
        for color in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    )
    alpha = 1 - (white - black).mean(axis=-1)
    y, x = (2 * (np.indices((SIZE, SIZE)) + 0.5) / SIZE - 1) * math.tan(float(orbit.fovy[0]) / 2)
    distance = float(orbit.distance[0])
    outside = np.hypot(x, y) > RADIUS / math.sqrt(distance**2 - RADIUS**2)
    between = (alpha > FAINT[0]) & (alpha < FAINT[1])
    return {"haze": float(alpha[:, outside].mean()), "faint": float(between.mean())}


def of_pictures(pictures: Float[Tensor, "V 3 s s"], prompt: str, models: Models) -> dict[str, Any]:
    """Score pictures from the judge's views."""
    wanted = attributes_in(prompt)
    found = recognition.probabilities(shared_judge(models.folder), pictures)
    right = {name: float(value) for name, value in recognition.recognized(found, wanted).items()}
    return right | {"multi_face": recognition.multi_face(found, wanted)}


def truth(prompt: Prompt, models: Models) -> dict[str, Any]:
    """Score ray-cast views of an object with the prompt's attributes: the judge's ceiling."""
    attributes = draw_attributes(PROMPT_SEED, prompt.index, held_out=prompt.withheld)
    mesh = object_mesh(attributes, numpy_generator(PROMPT_SEED, "benchmark-mesh", prompt.index))
    rgba = torch.from_numpy(render(mesh, recognition.views())).movedim(-1, 1).float()
    grey = torch.tensor(BACKGROUND).reshape(1, 3, 1, 1)
    return of_pictures(rgba[:, :3] + (1 - rgba[:, 3:]) * grey, prompt.text, models)


def of_samples(prompt: str, scale: float, seed: int, models: Models) -> dict[str, Any]:
    """Score what the 2D model draws for the directions of the judge's views.

    "Side view" doesn't say which side, so the multi-face rate takes either for right.
    """
    pictures = samples(models.folder, prompt, recognition.views(), guidance_scale=scale, seed=seed)
    found = of_pictures(pictures, prompt, models)
    wanted = attributes_in(prompt)
    probabilities = recognition.probabilities(shared_judge(models.folder), pictures)
    return found | {"multi_face": recognition.multi_face(either_side(probabilities), wanted)}


def either_side(found: dict[str, Tensor]) -> dict[str, Tensor]:
    """Count a view from the left as one from the right, in the rows where the right is wanted, and
    the other way round.
    """
    quadrant = found["quadrant"].clone()
    for rows, other in ((slice(2, 4), 3), (slice(6, 8), 1)):
        own = 4 - other
        quadrant[rows, own] = quadrant[rows][:, [1, 3]].sum(dim=1)
        quadrant[rows, other] = 0
    return found | {"quadrant": quadrant}
