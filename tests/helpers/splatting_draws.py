"""Render with a backend in float32, and compare with the specification in float64."""

import torch
from hypothesis import HealthCheck, settings

from tests.helpers.splatting_scenes import SINGLE, Cloud, Run, assert_close, run

repeatable = settings(
    derandomize=True, deadline=None, max_examples=25, suppress_health_check=list(HealthCheck)
)
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def draw(
    backend: str, cloud: Cloud, camera, width: int, height: int, background=None, **options
) -> Run:
    """Run forward and backward in float32."""
    view = *(x.to(torch.float32) for x in camera), width, height, background
    return run(cloud.to(torch.float32), *view, backend=backend, **options)


_specified: dict[tuple, Run] = {}


def specified(cloud: Cloud, *view, **options) -> Run:
    """Return what the specification, or the ``backend`` of the options, draws in float64; computed
    once for all kernels.
    """
    options = {"backend": "reference"} | options
    values = [*cloud, *view, *options.values()]
    key = *options, *(x.numpy().tobytes() if isinstance(x, torch.Tensor) else x for x in values)
    if key not in _specified:
        _specified[key] = run(cloud, *view, **options)
    return _specified[key]


def compare(backend: str, cloud: Cloud, camera, *view, tolerance: float = SINGLE, **options) -> Run:
    """Assert that images and gradients, those of the cameras included, are within float32 rounding
    of the specification in float64; ``view`` is width, height and perhaps a background.
    """
    truth = specified(cloud, *camera, *view, camera_gradient=True, **options)
    ours = draw(backend, cloud, camera, *view, camera_gradient=True, **options)
    assert_close(ours, truth, tolerance, radii=options.get("alpha_min") != 0)
    return ours
