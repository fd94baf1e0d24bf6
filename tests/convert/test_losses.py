"""What a format can't hold is said, with how many Gaussians it concerns."""

import re

import numpy as np
import pytest

from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.convert.losses import compare, losses, reference
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud


def said(cloud, suffix, version=3, **more):
    return "; ".join(losses(StoredCloud(cloud, "-y", **more), suffix, version))


def test_exact_formats_lose_nothing_and_rounding_is_reported():
    for suffix in (".ply", ".glb", ".usda"):
        assert said(ball(9, 3), suffix, pruned_to=40.0) == ""
    for suffix in (".spz", ".compressed.ply", ".sog"):
        assert "rounded" in said(ball(9), suffix) and "harmonics" not in said(ball(9), suffix)
        assert "of 9 Gaussians" not in said(ball(9, 1), suffix)


@pytest.mark.parametrize("offset", [0, 1e4, 5e5, 1e6])
def test_positions_of_spz_are_rounded_as_it_says(offset, tmp_path):
    cloud = ball(500)
    cloud.log_scales[:] = -4
    cloud = cloud._replace(means=(cloud.means.astype(np.float64) + offset).astype(np.float32))
    text = said(cloud, ".spz")
    if not offset:
        assert "positions are rounded to 1/32 of the median size" in text
        return
    rounding = re.search(r"rounded to (\S+), (\S+) of the median size", text)
    step, share = map(float, rounding.groups())
    assert f"positions up to {np.abs(cloud.means).max():g} are rounded" in text
    assert share == pytest.approx(step / np.exp(-4), rel=0.05)
    write_cloud(str(tmp_path / "a.spz"), StoredCloud(cloud, "-y"))
    found = np.sort(read_cloud(str(tmp_path / "a.spz")).gaussians.means, axis=None)
    differences = np.unique(np.diff(found.astype(np.float64)))
    assert differences[differences > 0].min() == pytest.approx(step, rel=1e-4)


def test_values_beyond_the_range_of_a_format_are_counted():
    cloud = ball(500, 1)
    cloud.means[0] = 1e9
    cloud.log_scales[1:3] = -15
    cloud.sh[4, 0], cloud.sh[5:9, 1] = 5, -2
    text = said(cloud, ".spz")
    assert "1 of 500 Gaussians are farther away or larger" in text
    assert "2 of 500 Gaussians are smaller than e^-10" in text
    assert "1 of 500 Gaussians have colours beyond" in text
    assert "4 of 500 Gaussians have harmonics beyond 1" in text
    # and of a compressed PLY
    cloud = ball(50, 1)
    cloud.sh[:3, 1], cloud.log_scales[5] = 4.5, -30
    text = said(cloud, ".compressed.ply")
    assert "3 of 50 Gaussians have harmonics beyond 4" in text and "1 of 50 Gaussians are" in text
    # and a palette that is smaller than the cloud
    assert "a palette of 1,024 for 2,000 Gaussians" in said(ball(2000, 1), ".sog")
    assert "palette" not in said(ball(1000, 1), ".sog")


def test_the_note_of_pruning_that_version_4_loses():
    assert "note about pruning" in said(ball(9), ".spz", 4, pruned_to=40.0)
    assert "note" not in said(ball(9), ".spz", 3, pruned_to=40.0) + said(ball(9), ".spz", 4)


# -- dB ------------------------------------------------------------------------------------------


FLOORS = {".ply": 100, ".glb": 82, ".usda": 82, ".compressed.ply": 42, ".sog": 42, ".spz": 32}
"""dB of the mean over the views; docs/formats.md has what was measured on trained objects."""


@pytest.mark.parametrize("suffix", FLOORS)
def test_a_round_trip_keeps_the_picture(tmp_path, suffix):
    before, path = StoredCloud(ball(800, 3), pruned_to=40), str(tmp_path / f"a{suffix}")
    write_cloud(path, before)
    after = read_cloud(path)
    mean, worst = compare(reference(before, 96), after)
    assert after.pruned_to == 40
    assert mean >= FLOORS[suffix] and mean - 6 < worst <= mean + 1e-3


def test_what_is_wrong_is_seen():
    before = StoredCloud(ball(300))
    truth = reference(before, 48)
    assert compare(truth, before.in_axes("y"))[0] > 90
    assert compare(truth, before._replace(up="y"))[0] < 25
    faint = before.gaussians.logit_opacities - 1
    after = before._replace(gaussians=before.gaussians._replace(logit_opacities=faint))
    assert compare(truth, after)[0] < 40
