"""Metrics of finished assets: the table of docs/evaluation.md. One that isn't defined for a prompt,
such as the judge's for words that the toybox doesn't know, is NaN."""

import math
from argparse import Namespace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..cameras import Orbit
from ..formats.array_files import read_arrays
from ..gaussians.gaussians import Gaussians
from ..gaussians.point_cloud import PointCloud
from ..host import get_device
from ..toybox import recognition
from ..toybox.views import BACKGROUND, LABELS, SIZE
from ..toybox.words import attributes_in
from ..training.geometry import gaussians_on_points
from . import t3bench
from .clip_similarity import Protocol, open_clip, protocol_for, score
from .image_reward import SOURCES, ImageReward
from .results import Result, find_result, read_result, render_views


class Asset(NamedTuple):
    """A finished cloud."""

    result: Result
    prompt: str
    gaussians: Gaussians
    item: int
    """Index of the asset; it seeds the asset's random views."""


class Metric:
    """A metric, made from the command's arguments; ``score`` returns the columns of an asset, and
    possibly some that others don't have.
    """

    columns: ClassVar[tuple[str, ...]]
    undefined: ClassVar[str] = ""
    """Why all of them are NaN for some assets."""
    needs: ClassVar[tuple[str, ...]] = ()
    """The option for the folder of its models, and the commands that download these."""
    sized: ClassVar[bool] = False
    """Whether its pictures have the size of ``--size``."""


# one of each for all metrics
shared_clip = lru_cache(maxsize=1)(open_clip)
shared_judge = lru_cache(maxsize=1)(recognition.load_judge)
shared_image_reward = lru_cache(maxsize=1)(lambda folder: ImageReward(folder, get_device()))


class Clip(Metric):
    """The paper's CLIP similarity."""

    columns, sized = ("clip",), True
    needs = ("clip", "`hf download openai/clip-vit-large-patch14 --local-dir clip`")

    def __init__(self, args: Namespace) -> None:
        self.clip = shared_clip(args.clip)
        self.protocol = protocol_for(args.clip, seeds=(0, 1, 2), size=args.size)

    def score(self, asset: Asset) -> dict[str, float]:
        found, _ = score(asset.result, asset.prompt, asset.item, self.clip, self.protocol)
        return {"clip": float(found.mean())}


class Directions(Metric):
    """The share of views that CLIP assigns to the prompt of another direction."""

    columns, sized, needs = ("wrong_direction",), True, Clip.needs
    AZIMUTHS = {"front": (-15, 15), "side": (75, 105, -75, -105), "back": (165, -165)}

    def __init__(self, args: Namespace) -> None:
        self.clip, self.protocol = shared_clip(args.clip), protocol_for(args.clip, size=args.size)

    def score(self, asset: Asset) -> dict[str, float]:
        azimuth = torch.tensor([float(a) for group in self.AZIMUTHS.values() for a in group])
        pictures = rendered(asset, self.protocol.at(azimuth), self.protocol.size)
        texts = [f"{asset.prompt}, {name} view" for name in self.AZIMUTHS]  # as in training
        found = np.stack([self.clip.similarities(pictures, text) for text in texts], axis=1)
        wanted = [i for i, group in enumerate(self.AZIMUTHS.values()) for _ in group]
        return {"wrong_direction": float(np.mean(found.argmax(axis=1) != wanted))}


class Reward(Metric):
    """ImageReward of the views of the paper's CLIP similarity, of its first seed."""

    columns, sized = ("imagereward",), True
    needs = ("imagereward", *(f"`{command} --local-dir ir`" for command in SOURCES.values()))

    def __init__(self, args: Namespace) -> None:
        self.model, self.size = shared_image_reward(args.imagereward), args.size

    def score(self, asset: Asset) -> dict[str, float]:
        protocol = Protocol()
        orbit = protocol.orbit.rows(torch.from_numpy(protocol.draw(0, asset.item)))
        found = self.model.rewards(rendered(asset, orbit, self.size), asset.prompt)
        return {"imagereward": float(found.mean())}


class Quality(Metric):
    """T3Bench's quality, of the Gaussians in place of a mesh."""

    columns, needs = ("quality",), Reward.needs

    def __init__(self, args: Namespace) -> None:
        self.model = shared_image_reward(args.imagereward)

    def score(self, asset: Asset) -> dict[str, float]:
        cloud = t3bench.normalized(asset.gaussians)
        chunks = t3bench.pictures(cloud, asset.result.antialiased)
        found = [self.model.rewards(pictures, asset.prompt) for pictures in chunks]
        rewards = np.concatenate(found).reshape(-1, len(t3bench.FOVY))
        return {"quality": t3bench.quality(rewards)}


class Recognized(Metric):
    """Which attributes of the prompt the toybox's judge recognises; of persons their action too."""

    columns = ("kind", "colors", "pattern", "accessory")
    objects = ", ".join(LABELS["kind"])
    undefined = f"the prompt doesn't name a color and one of the judge's objects: {objects}"

    def __init__(self, args: Namespace) -> None:
        self.judge = shared_judge(args.judge)

    def score(self, asset: Asset) -> dict[str, float]:
        pictures = rendered(asset, recognition.views(), SIZE, BACKGROUND)
        views = torch.from_numpy(pictures).movedim(-1, 1)
        return self.of_pictures(views, asset.prompt) or dict.fromkeys(self.columns, math.nan)

    def of_pictures(self, views: Float[Tensor, "V 3 s s"], prompt: str) -> dict[str, float]:
        """Score pictures from the judge's views; empty if the prompt names no object."""
        if (wanted := attributes_in(prompt)) is None:
            return {}
        return self.compared(recognition.probabilities(self.judge, views, wanted), wanted)

    def compared(self, found: dict[str, Tensor], wanted: Any) -> dict[str, float]:
        return recognition.recognized(found, wanted)


class Janus(Recognized):
    """The share of views that the judge takes for views from another quadrant."""

    columns = ("multi_face",)
    undefined = f"{Recognized.undefined}; or the object has no front"

    def compared(self, found: dict[str, Tensor], wanted: Any) -> dict[str, float]:
        return {"multi_face": recognition.multi_face(found, wanted)}


METRICS: dict[str, type[Metric]] = {
    **{"clip": Clip, "directions": Directions, "imagereward": Reward, "quality": Quality},
    **{"judge": Recognized, "janus": Janus},
}


def rendered(
    asset: Asset, orbit: Orbit, size: int, background: Optional[tuple[float, float, float]] = None
) -> Float[np.ndarray, "V s s 3"]:
    """Render an asset in [0, 1], on the run's background unless another is given."""
    result = asset.result
    how = {"background": background or result.background, "antialias": result.antialiased}
    views = render_views(asset.gaussians, orbit.c2w, orbit.fovy, size, **how)
    return np.concatenate(list(views))


# ---- the stages of a run by the toybox's judge -------------------------------------------------

ATTRIBUTES = Recognized.columns
OPAQUE = 0.95


class Scores:
    """Scores by the judge and the CLIP in one folder: ``toybox``, or that of an export."""

    def __init__(self, models: str) -> None:
        args = Namespace(judge=models, clip=models, size=SIZE)
        self.judged = (Recognized(args), Janus(args))
        self.metrics: tuple[Metric, ...] = (*self.judged, Clip(args))

    def of_asset(self, asset: Asset) -> dict[str, float]:
        """Return the attributes of :data:`ATTRIBUTES`, ``multi_face`` and ``clip``."""
        return {k: v for metric in self.metrics for k, v in metric.score(asset).items()}

    def of_pictures(self, pictures: Float[Tensor, "V 3 s s"], prompt: str) -> dict[str, float]:
        """Score pictures from the judge's views; empty if the prompt names no object."""
        found = (metric.of_pictures(pictures, prompt) for metric in self.judged)
        return {k: v for scores in found for k, v in scores.items()}


def result_of(run: Path, prompt: str) -> Asset:
    """Return the cloud that a finished run has exported."""
    result = find_result(str(run))
    return Asset(result, prompt, read_result(result), 0)


def prior_of(run: Path, asset: Asset) -> Asset:
    """Return the points that a run started from, nearly opaque and as large as their distances."""
    arrays = read_arrays(run / "save/prior/points.npz", "prior", ["points", "colors"])
    cloud = PointCloud(arrays["points"], arrays["colors"])
    size = {"scale_rule": "nearest", "scale_factor": 1.0, "init_opacity": OPAQUE}
    options = Namespace(max_gaussians=len(cloud.points), **size)
    return asset._replace(gaussians=gaussians_on_points(cloud, options))
