"""Score the stages of a text-to-3D run by the toybox's judge: the prior's points, the result, and
what the 2D model itself draws.
"""

import argparse
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..formats.array_files import read_arrays
from ..gaussians.gaussians import Gaussians
from ..gaussians.point_cloud import PointCloud
from ..toybox import recognition
from ..toybox.views import SIZE
from ..toybox.words import attributes_in
from ..training.initialization import gaussians_on_points
from .asset_metrics import Asset, Clip, Janus, Metric, Recognized, shared_judge
from .results import find_result, read_result

ATTRIBUTES = Recognized.columns
OPAQUE = 0.95


class Scores:
    """Scores by the judge and the CLIP in one folder.

    Args:
        models: ``toybox``, or the folder of an export.
    """

    def __init__(self, models: str) -> None:
        args = argparse.Namespace(judge=models, clip=models, size=SIZE)
        self.judge = shared_judge(models)
        self.metrics: list[Metric] = [Recognized(args), Janus(args), Clip(args)]

    def of_asset(self, asset: Asset) -> dict[str, float]:
        """Return the attributes of :data:`ATTRIBUTES`, ``multi_face`` and ``clip``."""
        found: dict[str, float] = {}
        for metric in self.metrics:
            found |= metric.score(asset)
        return found

    def of_pictures(self, pictures: Float[Tensor, "V 3 s s"], prompt: str) -> dict[str, Any]:
        """Score pictures from the judge's views; empty if the prompt names no object."""
        wanted = attributes_in(prompt)
        if wanted is None:
            return {}
        found = recognition.probabilities(self.judge, pictures)
        right = recognition.recognized(found, wanted)
        numbers = {name: float(right[name]) for name in ATTRIBUTES}
        return numbers | {"multi_face": recognition.multi_face(found, wanted)}


def result_of(run: Path, prompt: str) -> Asset:
    """Return the cloud that a finished run has exported."""
    result = find_result(str(run))
    return Asset(result, prompt, read_result(result), 0)


def prior_of(run: Path, asset: Asset) -> Asset:
    """Return the points that a run started from, drawn nearly opaque and as large as their
    distances.
    """
    arrays = read_arrays(run / "save/prior/points.npz", "prior", ["points", "colors"])
    return asset._replace(gaussians=drawn(PointCloud(arrays["points"], arrays["colors"])))


def drawn(cloud: PointCloud) -> Gaussians:
    """Make a Gaussian of each point."""
    options = argparse.Namespace(
        max_gaussians=len(cloud.points),
        scale_rule="nearest",
        scale_factor=1.0,
        init_opacity=OPAQUE,
    )
    return gaussians_on_points(cloud, options)
