"""Views around Gaussians of any size."""

import math

import pytest
import torch

from tests.helpers.pruning import ball
from threestudio_gaussiandreamer.gaussians.views import (
    rasterize_views,
    render_all,
    row_batches,
    views_around,
)
from threestudio_gaussiandreamer.metrics import psnr


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3, 1e14])
def test_clouds_in_other_units_give_equal_views(unit):
    """The near and far planes clip no cloud given in millimetres."""
    cloud = ball()
    other = cloud._replace(means=cloud.means * unit, log_scales=cloud.log_scales + math.log(unit))
    ours, theirs = (render_all(each, views_around(each, 6, 48)) for each in (cloud, other))
    assert psnr(theirs, ours) > 60


def test_a_constant_harmonic_gives_the_images_of_zero_higher_ones():
    """Also with more channels, which are per view."""
    plain, with_bands = ball(), ball(bands=4)
    views, rows, black = views_around(plain, 3, 32), torch.arange(3), torch.zeros(3)
    assert torch.equal(render_all(plain, views), render_all(with_bands, views))
    channels = torch.rand(3, 600, 2, generator=torch.Generator().manual_seed(0))
    ours, theirs = (
        rasterize_views(cloud, views, rows, torch.zeros(5), channels=channels).image
        for cloud in (plain, with_bands)
    )
    assert ours.shape[-1] == 5 and torch.equal(ours, theirs)
    assert torch.equal(ours[..., :3], rasterize_views(plain, views, rows, black).image)


@pytest.mark.parametrize(
    ("gaussians", "sizes"),
    [(0, [4, 2]), (500_000, [4, 2]), (1_000_000, [2] * 3), (10**7, [1] * 6)],
)
def test_fewer_views_of_a_large_cloud_are_rendered_at_once(gaussians, sizes):
    batches = row_batches(views_around(ball(), 6, 16), gaussians)
    assert [len(rows) for rows in batches] == sizes
    assert torch.cat(batches).tolist() == list(range(6))
