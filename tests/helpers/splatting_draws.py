"""Render with a backend in float32, and compare with the specification in float64."""

import torch
from hypothesis import HealthCheck, settings

from tests.helpers.splatting_scenes import (
    SINGLE,
    Cloud,
    Run,
    assert_close,
    run,
)

repeatable = settings(
    derandomize=True, deadline=None, max_examples=25, suppress_health_check=list(HealthCheck)
)
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def draw(
    backend: str, cloud: Cloud, camera, width: int, height: int, background=None, **options
) -> Run:
    """Run forward and backward in float32."""
    camera = [x.to(torch.float32) for x in camera]
    return run(
        cloud.to(torch.float32), *camera, width, height, background, backend=backend, **options
    )


def compare(
    backend: str,
    cloud: Cloud,
    camera,
    width: int,
    height: int,
    background=None,
    tolerance=SINGLE,
    **options,
) -> Run:
    """Assert that images and gradients, those of the cameras included, are within float32 rounding
    of the specification in float64.
    """
    truth = run(
        cloud,
        *camera,
        width,
        height,
        background,
        camera_gradient=True,
        backend="reference",
        **options,
    )
    ours = draw(backend, cloud, camera, width, height, background, camera_gradient=True, **options)
    assert_close(ours, truth, tolerance, radii=options.get("alpha_min") != 0)
    return ours
