"""The first view: it shows the whole cloud, as large as that allows."""

import numpy as np
import pytest

from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.view.render import RenderSettings, first_pose, render


def stored(means, scale=0.03, logit=3.0) -> StoredCloud:
    """A cloud of round Gaussians with z up; ``scale`` and ``logit`` are numbers or one for each."""
    count = len(means)
    arrays = Gaussians(
        means=np.asarray(means),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.log(np.broadcast_to(scale, count))[:, None].repeat(3, 1),
        logit_opacities=np.broadcast_to(logit, count),
        sh=np.zeros((count, 1, 3)),
    )
    return StoredCloud(arrays.map(lambda values: values.astype(np.float32)), "z")


def ball(count=4000) -> np.ndarray:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


HAT = np.linspace([0, 0, 1.0], [0.3, 0, 4.0], 35)
"""A pole of less than a hundredth of the Gaussians, on top of the ball."""


def alpha(cloud: StoredCloud) -> np.ndarray:
    """The opacity of the first view's pixels."""
    return render(cloud, RenderSettings(), [first_pose(cloud)], 96)[0, ..., 3].numpy()


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_a_thin_hat_is_in_the_first_view(order):
    """Upright, and to the side."""
    seen = alpha(stored(np.concatenate([ball(), HAT])[:, order]))
    assert max(seen[0].max(), seen[-1].max(), seen[:, 0].max(), seen[:, -1].max()) < 0.02
    rows, columns = np.nonzero(seen > 0.1)
    assert max(np.ptp(rows), np.ptp(columns)) > 0.45 * 96  # a ball fits from every side


@pytest.mark.parametrize(
    "place, scale, logit",
    [((0, 0, 30.0), 0.03, 3.0), ((0, 0, 0), 50.0, 3.0), ((0, 0, 1.2), 0.4, -4)],
)
def test_what_does_not_belong_to_the_cloud_leaves_the_first_view(place, scale, logit):
    """A floater, one that covers everything, and one that is hardly visible."""
    more = stored([*ball(), place], [0.03] * 4000 + [scale], [3.0] * 4000 + [logit])
    ours, without = first_pose(more), first_pose(stored(ball()))
    assert ours.distance == pytest.approx(without.distance, rel=0.02)
    assert np.allclose(ours.target, without.target, atol=0.02)


@pytest.mark.parametrize("scale", [1e-12, 0.03, 1e12])
def test_a_single_gaussian_fills_the_first_view(scale):
    cloud = stored([[0, 0, 0]], scale)
    seen = render(cloud, RenderSettings(near=0.1 * scale, far=1e15), [first_pose(cloud)], 96)
    assert 0.5 < float((seen[0, 48, :, 3] > 0.1).float().mean()) <= 1
