"""Renders of imperfect Gaussians, which the judge is trained on."""

from pathlib import Path

import numpy as np
import pytest

from threestudio_gaussiandreamer.toybox import splat_shards, views
from threestudio_gaussiandreamer.toybox.splat_shards import SplatShards, smooth_field
from threestudio_gaussiandreamer.toybox.world import Attributes, object_mesh

ERRORS = ("COLOR_SHIFT", "SHAPE_SHIFT", "COLOR_ERROR", "COLOR_NOISE")
MUSHROOM = Attributes("mushroom", "red", "dotted", "white")


def drawn_and_cast(seed=0):
    """Return a mushroom as Gaussians and ray cast, premultiplied RGBA of the same views."""
    rng = np.random.default_rng(seed)
    mesh, orbit = object_mesh(MUSHROOM, rng), views.draw_orbit(4, rng)
    return SplatShards(Path(), 0).pictures(mesh, orbit, rng), views.render(mesh, orbit)


def difference(drawn, cast):
    """Return the mean difference inside the object; outlines of Gaussians are blurred."""
    return np.abs(drawn - cast)[cast[..., 3] == 1].mean()


@pytest.fixture
def without_errors(monkeypatch):
    for name in ERRORS:
        monkeypatch.setattr(splat_shards, name, 0.0)
    monkeypatch.setattr(splat_shards, "BLENDED", 1)
    monkeypatch.setattr(splat_shards, "COUNT", (20_000, 20_001))


def test_gaussians_without_errors_look_like_the_object(without_errors):
    assert difference(*drawn_and_cast()) < 0.07


@pytest.mark.parametrize("name", [*ERRORS, "BLENDED"])
def test_each_error_makes_the_pictures_differ_more(monkeypatch, without_errors, name):
    before = difference(*drawn_and_cast())
    monkeypatch.setattr(splat_shards, name, 100 if name == "BLENDED" else 1.0)
    assert difference(*drawn_and_cast()) > 1.1 * before


def test_a_shard_of_gaussians_is_a_function_of_seed_and_index(tmp_path):
    one, other = (SplatShards(tmp_path / name, 3, objects=2) for name in "ab")
    for name, first, second in zip(views.Shard._fields, one.get(1), other.make(1), strict=True):
        assert np.array_equal(first, second), name
    assert not np.array_equal(one.get(0).rgba, one.get(1).rgba)


def test_labels_and_cameras_are_those_of_the_objects(tmp_path):
    splats, cast = SplatShards(tmp_path, 3, objects=2).make(0), views.Shards(tmp_path, 3, objects=2)
    for name in ("labels", "elevation", "azimuth"):
        assert np.array_equal(getattr(splats, name), getattr(cast.make(0), name)), name


def test_no_two_sorts_of_shards_share_a_file(tmp_path):
    sorts = (views.Shards, SplatShards)
    paths = {sort(tmp_path, 3, held_out=held).path(0) for sort in sorts for held in (False, True)}
    assert len(paths) == 4


def test_a_smooth_field_has_the_given_deviation_and_no_jumps():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (300, 3))
    fields = np.stack([smooth_field(points, 0.05, np.random.default_rng(i)) for i in range(300)])
    assert fields.std() == pytest.approx(0.05, rel=0.05)
    moved = smooth_field(points + 1e-4, 0.05, np.random.default_rng(0))
    assert np.abs(moved - fields[0]).max() < 1e-3
