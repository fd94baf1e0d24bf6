"""Metrics of finished assets, from renders of a cloud and from its prompt: the table of
docs/evaluation.md. One that isn't defined for a prompt, such as the judge's for words that the
toybox doesn't know, is NaN.
"""

import math
from argparse import Namespace
from functools import lru_cache
from typing import ClassVar, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..cameras import Orbit
from ..gaussians.gaussians import Gaussians
from ..host import get_device
from ..models.clip import PictureText
from ..prompts.view_prompts import view_directions
from ..toybox import recognition
from ..toybox.kinds import KINDS
from ..toybox.models import Judge
from ..toybox.views import BACKGROUND, SIZE
from ..toybox.words import attributes_in
from . import t3bench
from .clip_similarity import Protocol, open_clip, protocol_for, score
from .image_reward import ImageReward
from .results import Pictures, Result

Color = tuple[float, float, float]


class Asset(NamedTuple):
    """A finished cloud."""

    result: Result
    prompt: str
    gaussians: Gaussians
    item: int
    """Index of the asset; it seeds the asset's random views."""


class Metric:
    """A metric of finished assets; constructed once, before the first render, with what it needs.
    ``score`` returns the columns of one asset.
    """

    columns: ClassVar[tuple[str, ...]]
    undefined: ClassVar[str] = ""
    """Why all of them are NaN for some assets."""

    def __init__(self, args: Namespace) -> None:
        raise NotImplementedError

    def score(self, asset: Asset) -> dict[str, float]:
        raise NotImplementedError


@lru_cache(maxsize=1)
def shared_clip(folder: str) -> PictureText:
    """Load a CLIP once for all metrics that use it."""
    return open_clip(folder)


class Clip(Metric):
    """The paper's CLIP similarity."""

    columns = ("clip",)

    def __init__(self, args: Namespace) -> None:
        self.clip = shared_clip(args.clip)
        self.protocol = protocol_for(args.clip, seeds=(0, 1, 2), size=args.size)

    def score(self, asset: Asset) -> dict[str, float]:
        scored = score(asset.result, asset.prompt, asset.item, self.clip, self.protocol)
        return {"clip": float(scored.per_seed.mean())}


class Directions(Metric):
    """The share of views that CLIP assigns to the prompt of another direction."""

    columns = ("wrong_direction",)
    AZIMUTHS = {"front": (-15, 15), "side": (75, 105, -75, -105), "back": (165, -165)}

    def __init__(self, args: Namespace) -> None:
        self.clip, self.protocol = shared_clip(args.clip), protocol_for(args.clip, size=args.size)

    def score(self, asset: Asset) -> dict[str, float]:
        azimuth = torch.tensor([float(a) for group in self.AZIMUTHS.values() for a in group])
        pictures = rendered(asset, self.protocol.at(azimuth), self.protocol.size)
        texts = {d.name: d.prompt(asset.prompt) for d in view_directions(45, 45, 60)}
        found = np.stack(
            [self.clip.similarities(pictures, texts[name]) for name in self.AZIMUTHS], axis=1
        ).argmax(axis=1)
        wanted = [i for i, group in enumerate(self.AZIMUTHS.values()) for _ in group]
        return {"wrong_direction": float(np.mean(found != wanted))}


class Reward(Metric):
    """ImageReward of the views of the paper's CLIP similarity, of its first seed."""

    columns = ("imagereward",)

    def __init__(self, args: Namespace) -> None:
        self.model, self.size = shared_image_reward(args.imagereward), args.size

    def score(self, asset: Asset) -> dict[str, float]:
        protocol = Protocol()
        orbit = protocol.orbit.rows(torch.from_numpy(protocol.draw(0, asset.item)))
        found = self.model.rewards(rendered(asset, orbit, self.size), asset.prompt)
        return {"imagereward": float(found.mean())}


class Quality(Metric):
    """T3Bench's quality, of the Gaussians in place of a mesh."""

    columns = ("quality",)

    def __init__(self, args: Namespace) -> None:
        self.model = shared_image_reward(args.imagereward)

    def score(self, asset: Asset) -> dict[str, float]:
        cloud = t3bench.normalized(asset.gaussians)
        chunks = t3bench.quality_pictures(cloud, asset.result.antialiased)
        found = [self.model.rewards(pictures, asset.prompt) for pictures in chunks]
        rewards = np.concatenate(found).reshape(-1, len(t3bench.QUALITY_FOVY))
        return {"quality": t3bench.quality(rewards)}


class Recognized(Metric):
    """Which attributes of the prompt the toybox's judge recognises."""

    columns = ("kind", "colors", "pattern", "accessory")
    undefined = (
        f"the prompt doesn't name a color and one of the judge's objects: {', '.join(KINDS)}"
    )

    def __init__(self, args: Namespace) -> None:
        self.judge = shared_judge(args.judge)

    def score(self, asset: Asset) -> dict[str, float]:
        wanted = attributes_in(asset.prompt)
        if wanted is None:
            return dict.fromkeys(self.columns, math.nan)
        found = recognition.recognized(judged(self.judge, asset), wanted)
        return {name: float(found[name]) for name in self.columns}


class Janus(Metric):
    """The share of views that the judge takes for views from another quadrant."""

    columns = ("multi_face",)
    undefined = f"{Recognized.undefined}; or the object has no front"

    def __init__(self, args: Namespace) -> None:
        self.judge = shared_judge(args.judge)

    def score(self, asset: Asset) -> dict[str, float]:
        wanted = attributes_in(asset.prompt)
        if wanted is None:
            return {"multi_face": math.nan}
        return {"multi_face": recognition.multi_face(judged(self.judge, asset), wanted)}


METRICS: dict[str, type[Metric]] = {
    "clip": Clip,
    "directions": Directions,
    "imagereward": Reward,
    "quality": Quality,
    "judge": Recognized,
    "janus": Janus,
}


@lru_cache(maxsize=1)
def shared_image_reward(folder: str) -> ImageReward:
    """Load an ImageReward once for all metrics that use it."""
    return ImageReward(folder, get_device())


@lru_cache(maxsize=1)
def shared_judge(path: str) -> Judge:
    """Load a judge once for all metrics that use it."""
    return recognition.load_judge(path)


def judged(judge: Judge, asset: Asset) -> dict[str, Tensor]:
    """Return the judge's probabilities in its views of an asset."""
    pictures = rendered(asset, recognition.views(), SIZE, background=BACKGROUND)
    return recognition.probabilities(judge, torch.from_numpy(pictures).movedim(-1, 1))


def rendered(
    asset: Asset, orbit: Orbit, size: int, *, background: Optional[Color] = None
) -> Float[np.ndarray, "V s s 3"]:
    """Render an asset in [0, 1], on the run's background unless another is given."""
    result = asset.result
    pictures = Pictures(asset.gaussians, background or result.background, result.antialiased)
    return np.concatenate(list(pictures.render(orbit.c2w, orbit.fovy, size)))
