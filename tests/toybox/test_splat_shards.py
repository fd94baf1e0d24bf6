"""Renders of imperfect Gaussians, which the judge is trained on."""

from pathlib import Path

import numpy as np
import pytest

from threestudio_gaussiandreamer.toybox import judge_stage, views
from threestudio_gaussiandreamer.toybox.judge_stage import SplatShards, smooth_field
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
        monkeypatch.setattr(judge_stage, name, 0.0)
    monkeypatch.setattr(judge_stage, "BLENDED", 1)
    monkeypatch.setattr(judge_stage, "COUNT", (20_000, 20_001))


def test_each_error_makes_the_pictures_differ_more(monkeypatch, without_errors):
    before = difference(*drawn_and_cast())
    assert before < 0.07  # without errors they look like the object
    for name in (*ERRORS, "BLENDED"):
        with monkeypatch.context() as patch:
            patch.setattr(judge_stage, name, 100 if name == "BLENDED" else 1.0)
            assert difference(*drawn_and_cast()) > 1.1 * before, name


def test_a_shard_of_gaussians_is_a_function_of_seed_and_index(tmp_path):
    one, other = (SplatShards(tmp_path / name, 3, objects=2) for name in "ab")
    for name, first, second in zip(views.Shard._fields, one.get(1), other.make(1), strict=True):
        assert np.array_equal(first, second), name
    assert not np.array_equal(one.get(0).rgba, one.get(1).rgba)
    cast = views.Shards(tmp_path, 3, objects=2).make(0)
    for name in ("labels", "elevation", "azimuth"):
        assert np.array_equal(getattr(one.get(0), name), getattr(cast, name)), name
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
