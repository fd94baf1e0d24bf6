"""Clouds that test the page's renderer: thin Gaussians, view-dependent colours, many layers."""

import json
import re

import numpy as np

from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.view.page import PageOptions
from threestudio_gaussiandreamer.view.render import RenderSettings

PROMPT = "a <b>box</b></script><script>document.title = 'injected'</script> {{data}} & \u2028 '\""


def cloud(
    count: int = 400,
    *,
    degree: int = 0,
    size: float = 0.08,
    stretch: float = 0.8,
    logit: float = 2.0,
    up: str = "-y",
) -> StoredCloud:
    """Draw Gaussians in a ball, off the origin, in any rotation; colours partly beyond [0, 1]."""
    rng = np.random.default_rng(count)
    harmonics = rng.normal(size=(count, (degree + 1) ** 2, 3))
    harmonics[:, 1:] *= 0.3
    arrays = Gaussians(
        means=rng.normal(size=(count, 3)) * 0.4 + [0.5, -0.2, 0.1],
        quats=rng.normal(size=(count, 4)),
        log_scales=np.log(size) + stretch * rng.normal(size=(count, 3)),
        logit_opacities=logit + rng.normal(size=count),
        sh=harmonics,
    )
    return StoredCloud(arrays.map(lambda values: values.astype(np.float32)), up)


def meta(page: str) -> dict:
    return json.loads(re.search(r'id="meta">(.*?)</script>', page)[1])


def options(**settings) -> PageOptions:
    return PageOptions(PROMPT, "box", RenderSettings(**settings))
