"""Helpers of the torch backend tests."""

import torch

from tests.helpers.splatting_scenes import (
    error,
    run,
)

# float64 against float64: the same formula in another order, so rounding only; 1e-9 leaves room for
# sums of 1e5 terms.
ROUNDING = 1e-9


def compare(cloud, camera, width, height, **options):
    """Compare every output and every gradient in float64."""
    ours, truth = (
        run(cloud, *camera, width, height, camera_gradient=True, backend=b, **options)
        for b in ("torch", "reference")
    )
    for name in ("image", "alpha", "depth", "means2d", "contribution"):
        assert error(getattr(ours.out, name), getattr(truth.out, name)) < ROUNDING, name
    assert torch.equal(ours.out.radii, truth.out.radii)
    for name, grad in truth.grads.items():
        # Absolute where nothing is left but rounding, relative elsewhere.
        assert (
            error(ours.grads[name], grad) < ROUNDING
            or (ours.grads[name] - grad).abs().max() < 1e-12
        ), name
    if options.get("absgrad"):
        assert error(ours.out.means2d.absgrad, truth.out.means2d.absgrad) < ROUNDING
    return ours, truth
