"""The dB of round trips: a floor for every format, and a number that sees what is wrong."""

import pytest

from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.convert.check import round_trip
from threestudio_gaussiandreamer.formats.gaussian_files import (
    StoredCloud,
    read_cloud,
    write_cloud,
)

FLOORS = {
    ".ply": 100,
    ".glb": 90,
    ".compressed.ply": 50,
    ".sog": 50,
    ".spz": 40,
}
"""dB of the mean over the views; docs/formats.md has what was measured on trained objects."""


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("suffix", FLOORS)
def test_a_round_trip_keeps_the_picture(tmp_path, suffix, degree):
    before, path = StoredCloud(ball(800, degree)), str(tmp_path / f"a{suffix}")
    write_cloud(path, before)
    found = round_trip(before, read_cloud(path), 96)
    assert found.mean >= FLOORS[suffix] - (8 if degree and suffix != ".ply" else 0)
    assert found.mean - 6 < found.worst <= found.mean + 1e-3


@pytest.mark.parametrize("up", ["z", "y", "-y"])
def test_axes_dont_matter(up):
    before = StoredCloud(ball(50))
    assert round_trip(before, before.in_axes(up), 48).mean > 90


def test_what_is_wrong_is_seen():
    before = StoredCloud(ball(300))
    turned = before._replace(up="y")
    assert round_trip(before, turned, 48).mean < 25
    faint = before.gaussians.logit_opacities - 1
    after = before._replace(gaussians=before.gaussians._replace(logit_opacities=faint))
    assert round_trip(before, after, 48).mean < 40
