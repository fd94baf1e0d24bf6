"""The prior runs once per (prior, options, prompt, seed) and folder."""

from dataclasses import dataclass

import numpy as np
import pytest

from threestudio_gaussiandreamer.formats.ply import read_points
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.host import BaseObject
from threestudio_gaussiandreamer.priors.cache import cached_cloud


class CountingPrior(BaseObject):
    calls = 0

    @dataclass
    class Config(BaseObject.Config):
        size: float = 1.0

    def __call__(self, prompt):
        type(self).calls += 1
        points = np.random.default_rng(0).random((10, 3)).astype(np.float32) * self.cfg.size
        return PointCloud(points, points / self.cfg.size)


def test_a_second_run_in_the_same_folder_reads_the_first_ones_points(tmp_path):
    CountingPrior.calls = 0
    first = cached_cloud(CountingPrior({}), "a fox", tmp_path)
    again = cached_cloud(CountingPrior({}), "a fox", tmp_path)
    assert CountingPrior.calls == 1
    assert (
        np.array_equal(first.points, again.points)
        and np.array_equal(first.colors, again.colors)
        and again.normals is None
    )
    assert len(read_points(tmp_path / "prior" / "points.ply").points) == 10


@pytest.mark.slow
def test_another_prompt_option_or_seed_runs_the_prior_again(tmp_path, monkeypatch):
    CountingPrior.calls = 0
    cached_cloud(CountingPrior({}), "a fox", tmp_path)
    cached_cloud(CountingPrior({}), "a dog", tmp_path)
    cached_cloud(CountingPrior({"size": 2.0}), "a dog", tmp_path)
    monkeypatch.setenv("PL_GLOBAL_SEED", "3")
    cached_cloud(CountingPrior({"size": 2.0}), "a dog", tmp_path)
    assert CountingPrior.calls == 4


@pytest.mark.slow
def test_a_damaged_cache_is_ignored_and_no_folder_means_no_cache(tmp_path):
    CountingPrior.calls = 0
    cached_cloud(CountingPrior({}), "a fox", tmp_path)
    path = tmp_path / "prior" / "points.npz"
    path.write_bytes(path.read_bytes()[:50])
    cached_cloud(CountingPrior({}), "a fox", tmp_path)
    cached_cloud(CountingPrior({}), "a fox", None)
    assert CountingPrior.calls == 3
