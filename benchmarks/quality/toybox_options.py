"""The variants of configs/toybox.yaml that benchmarks/quality/toybox.py measures, by chart."""

from collections.abc import Callable, Iterator
from typing import Any

import yaml

from benchmarks.quality.runs import ROOT
from benchmarks.quality.toybox_jobs import (
    CONFIG,
    DEFAULT,
    EXACT,
    GUIDANCE,
    MODELS_BESIDE_GUIDANCE,
    PAPER_RECIPE,
    RANDOM_STARTS,
    SAMPLES,
    TRUTH,
    Variant,
)
from threestudio_gaussiandreamer.models.bundled import NAME
from threestudio_gaussiandreamer.view.run_index import leaves

PAPER = "configs/toybox-paper.yaml"
BALL = {
    "system.geometry.prior_type": "random-prior",
    "system.geometry.prior": "{num_points: 3000, size: 0.8, color: grey}",
    "system.geometry.grow.enabled": "false",
}
WITHOUT_VIEWS = {
    "system.guidance.view_dependent_prompting": "false",
    "system.guidance.view_contrast": 0,
}


def references() -> Iterator[Variant]:
    """The judge's ceiling, and the 2D model's own samples over its guidance scale."""
    yield Variant(TRUTH)
    for scale in (1, 2, GUIDANCE, 8):
        yield Variant(SAMPLES, scale)


def exact_score() -> Iterator[Variant]:
    """The same run with a 2D model that makes no errors."""
    names = ("min_step_percent", "max_step_percent", "weighting_strategy")
    guidance = {name: CONFIG["system"]["guidance"][name] for name in names}
    options = dict.fromkeys(MODELS_BESIDE_GUIDANCE, NAME)
    options |= {"system.guidance_type": "exact-score-guidance"}
    guidance |= {"mesh": "toy.glb", "guidance_scale": 1.0}
    yield Variant(EXACT, 0, options | {"system.guidance": guidance})


def starts() -> Iterator[Variant]:
    """A grey ball in place of the prior, with and without the views' directions in the prompts."""
    for name, options in zip(RANDOM_STARTS, ({}, WITHOUT_VIEWS), strict=True):
        yield Variant(name, 0, BALL | options)


def overlay(name: str) -> dict[str, Any]:
    """Return the options of a configuration that is laid over toybox.yaml."""
    return dict(leaves(yaml.safe_load((ROOT / name).read_text())))


CHARTS: dict[str, Callable[[], Iterator[Variant]]] = {
    "references": references,
    "exact_score": exact_score,
    "default": lambda: iter([Variant(DEFAULT)]),
    "starts": starts,
    "paper": lambda: iter([Variant(PAPER_RECIPE, 0, overlay(PAPER))]),
}
