"""The variants of configs/toybox.yaml that benchmarks/quality/toybox.py measures, by chart."""

from collections.abc import Callable, Iterator
from typing import Any

import yaml

from benchmarks.quality.jobs import fixed_timestep, held
from benchmarks.quality.runs import ROOT
from benchmarks.quality.toybox_jobs import (
    CONFIG,
    CONTRAST,
    DEFAULT,
    EXACT,
    GUIDANCE,
    MODELS_BESIDE_GUIDANCE,
    PAPER_RECIPE,
    RANDOM_STARTS,
    SAMPLES,
    STEPS,
    TRUTH,
    WRONG_PRIOR,
    Variant,
)
from threestudio_gaussiandreamer.models.bundled import NAME
from threestudio_gaussiandreamer.view.config_changes import leaves

PAPER_SCALE = 101.0
"""threestudio's 100."""
PAPER_SCALES = {"nfsd": 7.5, "ism": 7.5, "vsd": 7.5, "sdi": 8.5}
"""Of other score distillations, in this package's convention. CSD's paper has none, and CFD's code
has 75.
"""
LARGEST_SCALES = PAPER_SCALES | {"csd": 8, "cfd": 8}
PAPER = "configs/toybox-paper.yaml"
IMAGE_TARGETS = "configs/toybox-image-targets.yaml"
BALL = {
    "system.geometry.prior_type": "random-prior",
    "system.geometry.prior": "{num_points: 3000, size: 0.8, color: grey}",
    "system.geometry.grow.enabled": "false",
}
WITHOUT_VIEWS = {
    "system.guidance.view_dependent_prompting": "false",
    "system.guidance.view_contrast": 0,
}
ONE_SIDE = {"system.prompt_processor.view_dependent_left_and_right": "false"}


def steps(count: int) -> dict[str, Any]:
    """Return the options of a run of ``count`` steps, with its schedules in proportion."""
    geometry, guidance = CONFIG["system"]["geometry"], CONFIG["system"]["guidance"]
    rates = {
        f"system.geometry.{name}": [*value[:3], count]
        for name, value in geometry.items()
        if name.startswith("lr_") and isinstance(value, list)
    }
    start, high, low, _ = guidance["max_step_percent"]
    falls = start * count // STEPS
    return rates | {
        "trainer.max_steps": count,
        "system.guidance.max_step_percent": [falls, high, low, falls + 1],
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


def over_steps() -> Iterator[Variant]:
    """Numbers of steps beside the configuration's."""
    for count in (75, 300, 600):
        yield Variant("steps", count, steps(count))


def over_guidance() -> Iterator[Variant]:
    """Scales of guidance beside the configuration's, 1 without guidance except for the contrast of
    views, and the last that of the paper.
    """
    for scale in (1, 2, 8, 15, 30, PAPER_SCALE):
        yield Variant("guidance scale", scale, {"system.guidance.guidance_scale": scale})


def schedules() -> Iterator[Variant]:
    """Ranges of timesteps, and clipping."""
    yield Variant("timesteps up to 0.98 throughout", 0, {"system.guidance.max_step_percent": 0.98})
    low = {"system.guidance.max_step_percent": CONFIG["system"]["guidance"]["max_step_percent"]}
    yield Variant("timesteps from 0.2", 0, low | {"system.guidance.min_step_percent": 0.2})
    yield Variant("timesteps that fall by the root of the step", 0, falling("sqrt"))
    yield Variant("DreamTime's timesteps", 0, falling("dreamtime"))
    for clip in (0.1, 0.5):
        yield Variant("grad_clip", clip, {"system.guidance.grad_clip": clip})
    rescaled = {"system.guidance.recon_std_rescale": 0.5}
    yield Variant("recon_std_rescale 0.5", 0, rescaled)


def image_targets() -> Iterator[Variant]:
    """Towards pictures of few views: as in the overlay; their number and strength; when; and with
    shapes.
    """
    own = overlay(IMAGE_TARGETS)
    yield Variant("image targets", 0, own)
    yield Variant("image targets train shapes too", 0, own | targets(colors_only="false"))
    for views in (3, 6):
        yield Variant("views of image targets", views, own | targets(views=views))
    for strength in (0.5, 0.9):
        yield Variant("strength of image targets", strength, own | targets(strength=strength))
    yield Variant("image targets from step 30", 0, own | targets(start=30, stop=60))
    low = "system.guidance.max_step_percent"
    yield Variant("largest timestep 0.3 at the end", 0, {low: own[low]})


def targets(**options: Any) -> dict[str, Any]:
    """Return options of the stage."""
    return {f"system.image_targets.{name}": value for name, value in options.items()}


def falling(schedule: str) -> dict[str, Any]:
    """Return the options of timesteps that fall in the course of the run."""
    return {
        "system.guidance.max_step_percent": 0.98,
        "system.guidance.timestep_schedule": schedule,
        "system.guidance.timestep_steps": STEPS,
    }


def distillations() -> Iterator[Variant]:
    """Other score distillations at several guidance scales; CFD and SDI use their papers'
    decreasing timesteps.
    """
    own_options = {
        "csd": {},
        "nfsd": {},
        "ism": {},
        "vsd": {},
        "cfd": falling("linear"),
        "sdi": falling("linear") | {"system.guidance.weighting_strategy": "x0"},
    }
    for name, options in own_options.items():
        options = options | {"system.guidance.variant_type": f"{name}-variant"}
        for scale in (2, GUIDANCE, LARGEST_SCALES[name]):
            yield Variant(name.upper(), scale, options | {"system.guidance.guidance_scale": scale})


def looks() -> Iterator[Variant]:
    """Each distillation at the scale of toybox.yaml, SDI at its largest, with toybox.yaml, the
    paper's recipe, ways against its over-saturation, and small timesteps: what saturation and
    diversity are measured on.
    """
    yield Variant(DEFAULT)
    own = {"SDI": f"{LARGEST_SCALES['sdi']:g}"}
    yield from (one for one in distillations() if one.key[1] == own.get(one.name, f"{GUIDANCE:g}"))
    chosen = ("guidance scale", f"{PAPER_SCALE:g}"), ("recon_std_rescale 0.5", "0")
    falls = ("timesteps that fall by the root of the step", "0")
    yield from (one for one in (*over_guidance(), *schedules()) if one.key in (*chosen, falls))
    yield from (one for one in fixed_timesteps() if one.name == "fixed timestep" and one.x < 0.5)
    yield Variant(PAPER_RECIPE, 0, overlay(PAPER))


def cheaper() -> Iterator[Variant]:
    """One prediction for several steps of the same views; no guidance at some timesteps; half of
    the views a step, in as many steps and in twice as many.
    """
    for count in (2, 4):
        yield Variant("steps with one prediction", count, held(count))
    interval = {"system.guidance.guidance_interval": [0.2, 0.8]}
    yield Variant("guidance interval", 0, interval)
    yield Variant("views a step", 2, {"data.batch_size": 2})
    more_steps = steps(2 * STEPS) | {"data.batch_size": 2}
    yield Variant("views a step, twice the steps", 2, more_steps)


def fixed_timesteps() -> Iterator[Variant]:
    """The same timestep in all steps, and in those after the fall of the largest timestep."""
    for share in (0.1, 0.2, 0.5):
        yield Variant("fixed timestep", share, fixed_timestep(share))
    guidance, share = CONFIG["system"]["guidance"], 0.2
    start, high, _, end = guidance["max_step_percent"]
    late = {
        "system.guidance.min_step_percent": [start, guidance["min_step_percent"], share, end],
        "system.guidance.max_step_percent": [start, high, share, end],
    }
    yield Variant(f"fixed timestep from step {start}", share, late)


def feature_reuse() -> Iterator[Variant]:
    """Features of the U-Net's inner blocks reused for near views and timesteps: widths of the cells
    of timesteps; and as many evaluations in fewer steps.
    """
    options = {"system.guidance_type": "feature-reuse-guidance"}
    for width in (100, 200):
        cell = {"system.guidance.timestep_cell": width}
        yield Variant("timesteps that share features", width, options | cell)
    yield Variant("steps", 100, steps(100))


def starts() -> Iterator[Variant]:
    """What the second stage starts from, with and without the views' directions in the prompts; a
    contrast of views needs these.
    """
    yield Variant("prior, no view prompts", 0, WITHOUT_VIEWS)
    yield Variant('"side view" for left and right', 0, ONE_SIDE)
    yield Variant(WRONG_PRIOR, wrong_prior=True)
    for name, options in zip(RANDOM_STARTS, ({}, WITHOUT_VIEWS), strict=True):
        yield Variant(name, 0, BALL | options)


def view_contrast() -> Iterator[Variant]:
    """Factors of the contrast with the opposite view's prompt beside the configuration's, also at
    large timesteps only, and Perp-Neg in its place.
    """
    name = "system.guidance.view_contrast"
    yield Variant("no view contrast", 0, {name: 0})
    for factor in (0.75, 3):
        yield Variant("view contrast", factor, {name: factor})
    yield Variant("view contrast from 0.55", CONTRAST, {f"{name}_from": 0.55})
    perp_neg = {name: 0, "system.prompt_processor.use_perp_neg": "true"}
    yield Variant("Perp-Neg", 0, perp_neg)


def growing() -> Iterator[Variant]:
    """Algorithm 1 of the paper in parts."""
    yield Variant("no growing", 0, {"system.geometry.grow.enabled": "false"})
    yield Variant("no perturbation", 0, {"system.geometry.grow.color_range": "[0.0,0.0]"})
    for radius in (0.005, 0.04):
        yield Variant("growing radius", radius, {"system.geometry.grow.radius": radius})


def wrong_priors() -> Iterator[Variant]:
    """The same, numbers of Gaussians, and small timesteps, with a prior of another kind; and the
    grey ball of ``starts`` with growing.
    """
    few_and_many = (one for one in counts() if one.x in (1000, 8000))
    small_timesteps = (one for one in fixed_timesteps() if one.x == 0.2)
    for one in (*growing(), *few_and_many, *small_timesteps):
        yield one._replace(name=f"{WRONG_PRIOR}, {one.name}", wrong_prior=True)
    grown = {name: value for name, value in BALL.items() if not name.endswith("grow.enabled")}
    yield Variant("grey ball, growing", 0, grown)


def prior_quality() -> Iterator[Variant]:
    """Numbers of steps in which the prior is sampled."""
    for count in (4, 8, 64):
        yield Variant("steps of the prior", count, {"system.geometry.prior.num_steps": count})


def counts() -> Iterator[Variant]:
    """Numbers of Gaussians, of which a third comes from the prior and the others from growing."""
    for count in (1000, 2000, 4000, 8000):
        numbers = {
            "system.geometry.prior.num_points": count // 3,
            "system.geometry.grow.max_points": count - count // 3,
            "system.geometry.grow.num_candidates": 400_000,
            "system.geometry.max_gaussians": count,
        }
        yield Variant("Gaussians", count, numbers)


def haze() -> Iterator[Variant]:
    """Ways against faint Gaussians around the object."""
    yield Variant("random backgrounds", 0, {"system.background.mode": "random"})
    for weight in (1, 5, 20):
        yield Variant("sparsity", weight, {"system.loss.lambda_sparsity": weight})
    yield Variant("opaque", 1, {"system.loss.lambda_opaque": 1.0})


def smoothness() -> Iterator[Variant]:
    """Weights of the renders' total variation, which keeps flat parts flat."""
    yield Variant("no total variation", 0, {"system.loss.lambda_tv": 0})
    for weight in (50, 600):
        yield Variant("total variation", weight, {"system.loss.lambda_tv": weight})


def rates() -> Iterator[Variant]:
    """All learning rates times a factor."""
    geometry = CONFIG["system"]["geometry"]
    for factor in (0.3, 3):
        changed = {
            f"system.geometry.{name}": [value[0], factor * value[1], factor * value[2], value[3]]
            for name, value in geometry.items()
            if name.startswith("lr_") and isinstance(value, list)
        }
        yield Variant("learning rates", factor, changed)


def overlay(name: str) -> dict[str, Any]:
    """Return the options of a configuration that is laid over toybox.yaml."""
    return dict(leaves(yaml.safe_load((ROOT / name).read_text())))


CHARTS: dict[str, Callable[[], Iterator[Variant]]] = {
    "references": references,
    "exact_score": exact_score,
    "default": lambda: iter([Variant(DEFAULT)]),
    "guidance": over_guidance,
    "haze": haze,
    "image_targets": image_targets,
    "rates": rates,
    "schedules": schedules,
    "starts": starts,
    "steps": over_steps,
    "view_contrast": view_contrast,
    "growing": growing,
    "wrong_priors": wrong_priors,
    "prior_quality": prior_quality,
    "counts": counts,
    "paper": lambda: iter([Variant(PAPER_RECIPE, 0, overlay(PAPER))]),
    "distillations": distillations,
    "cheaper": cheaper,
    "fixed_timesteps": fixed_timesteps,
    "feature_reuse": feature_reuse,
    "smoothness": smoothness,
    "looks": looks,
}
