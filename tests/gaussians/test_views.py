"""Views around Gaussians of any size."""

import math

import pytest

from tests.helpers.pruning import ball
from threestudio_gaussiandreamer.gaussians.views import render_all, views_around
from threestudio_gaussiandreamer.metrics import psnr


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3, 1e14])
def test_clouds_in_other_units_give_equal_views(unit):
    """The near and far planes clip no cloud given in millimetres."""
    cloud = ball()
    other = cloud._replace(means=cloud.means * unit, log_scales=cloud.log_scales + math.log(unit))
    ours, theirs = (render_all(each, views_around(each, 6, 48)) for each in (cloud, other))
    assert psnr(theirs, ours) > 60
