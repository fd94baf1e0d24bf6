"""Saturation, colours at the limits, and diversity of results of the toybox's models."""

import argparse
import math

import pytest
import torch

from benchmarks.quality import toybox, toybox_diversity, toybox_scores
from benchmarks.quality.toybox_jobs import DEFAULT, Variant, prompts


def test_pixels_with_a_channel_at_a_limit_are_counted():
    views = torch.full((1, 2, 2, 3), 0.5)
    views[0, 0, 0, 1], views[0, 1, 1] = 0.999, torch.tensor([0.0, 0.0, 0.5])
    assert toybox_scores.at_limits(views) == 0.5


def test_saturation_is_relative_to_the_object(monkeypatch):
    prompt = prompts("withheld", 1)[0]
    truth = toybox_scores.truth_views(prompt).movedim(1, -1)
    grey = truth.mean(-1, keepdim=True)
    for share in (0.0, 0.5, 1.0):
        views = grey + share * (truth - grey)
        monkeypatch.setattr(toybox_scores, "views_of", lambda folder, views=views: views)
        found = toybox_scores.looks_of("folder", prompt)
        assert found["saturation"] == pytest.approx(share, abs=1e-5)


def test_diversity_is_of_the_seeds_that_are_kept(monkeypatch, tmp_path):
    keep = tmp_path / "runs"
    arguments = argparse.Namespace(
        variant=[Variant(DEFAULT)], charts=[], seeds=[0, 1, 2, 3], prompts=["seen"], count=2,
        models="toybox", keep=keep, gpu=toybox.CPU,
    )  # fmt: skip
    tasks = toybox.unique(toybox.tasks(arguments))
    levels = {}
    for task in tasks:
        if task.prompt.index == 0 and task.seed < 3 or task.seed == 0:
            toybox.kept(task).mkdir(parents=True)
            (toybox.kept(task) / toybox.RECORD).write_text("1.0")
            levels[toybox.kept(task) / toybox.RUN] = task.seed / 10
    views = {folder: torch.full((1, 2, 2, 3), level) for folder, level in levels.items()}
    monkeypatch.setattr(toybox_diversity, "views_of", views.__getitem__)
    (found,) = toybox_diversity.rows_of(arguments)
    assert found[:4] == (DEFAULT, "0", "0", "0") and found[5] == "3"
    assert math.isclose(float(found[6]), (0.1 + 0.2 + 0.1) / 3, abs_tol=1e-4)
