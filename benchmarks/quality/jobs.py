"""The runs of each chart and table, as :class:`Job`: variants of the base recipe (`recipe.py`),
which `runs.py` runs.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Optional

from benchmarks.quality.ablations import PAPER_RATES, RANDOM_START, VIEW_BLIND
from threestudio_gaussiandreamer.gaussians.simplify import rounds_to
from threestudio_gaussiandreamer.prune import PruneOptions

STEPS = 1200
SECOND_STAGE = 500
"""The step from which the recipe draws smaller timesteps."""
COUNTS = (5000, 2500, 1500, 1000)
STEPS_A_ROUND = PruneOptions.steps
"""Recovery steps of the prune command per round."""
NO_BUDGET = {"system.geometry.budget": "null"}
PAPER_START = {
    "system.geometry.init_opacity": 0.1,
    "system.geometry.grow.radius": 0.01,
    "system.geometry.bound_colors": "false",
}
SHARP_PAPER = PAPER_RATES | NO_BUDGET | PAPER_START
PAPER = SHARP_PAPER | {"system.renderer.eps2d": 0.3}
"""The recipe of the paper: its learning rates, start and screen-space dilation, and no pruning.
Sharp: with the recipe's dilation, 0.1.
"""
RATES = {
    "lr_means": (2e-4, 2e-5),
    "lr_scales": (6e-2, 1e-3),
    "lr_quats": (6e-2, 2e-3),
    "lr_opacities": (1e-1, 5e-3),
    "lr_sh": (1e-1, 2e-3),
}
"""Learning rates of the recipe, at the start and the end of a run."""
SLOWER_MEANS = {"slower means": 0.5, "means at 0.8": 0.8}
"""Factors of the initial learning rate of positions: the smaller, the more Gaussians stay on the
surface.
"""
BINS = VIEW_BLIND | {"system.guidance.mode": "direction-bins"}


class Job(NamedTuple):
    """One kind of training run and its place in a chart."""

    chart: str
    variant: str
    x: float
    """The place on the chart's horizontal axis, where that isn't measured; else 0."""
    options: dict[str, Any]
    overlay: Optional[str] = None
    """The name of a file of configs/ that is laid over demo.yaml; "" for none, None for the base
    recipe.
    """


def steps(count: int) -> dict[str, Any]:
    """Return the options of a run of ``count`` steps, with its schedules in proportion."""
    second = SECOND_STAGE * count // STEPS
    schedule = [second, 0.98, 0.55, second + 1]
    rounds = {
        f"system.geometry.prune.{name}": step * count // STEPS
        for name, step in (("start", 100), ("every", 50), ("stop", 900))
    }
    rates = {f"system.geometry.{name}": falling_rate(*both, count) for name, both in RATES.items()}
    own = {"trainer.max_steps": count, "system.guidance.max_step_percent": schedule}
    return rounds | rates | own


def falling_rate(start: float, end: float, count: int) -> str:
    """Return the schedule of a learning rate that decays over ``count`` steps."""
    return f"[0,{start:g},{end:g},{count}]"


def scratch(count: int) -> dict[str, Any]:
    """Return the options that start a run with ``count`` Gaussians: four fifths from the prior,
    one fifth grown.
    """
    return NO_BUDGET | {
        "system.geometry.prior.num_points": count * 4 // 5,
        "system.geometry.grow.max_points": count // 5,
        "system.geometry.max_gaussians": count,
    }


def time_jobs() -> Iterator[Job]:
    """Each kind of score, with a prior and from a random start, over time."""
    yield Job("time", "view-exact, the base recipe", 0, {})
    yield Job("time", "view-exact, the paper's recipe", 0, PAPER)
    yield Job("time", "direction bins", 0, BINS)
    yield Job("time", "view-blind, prior", 0, VIEW_BLIND)
    yield Job("time", "view-blind, random start", 0, VIEW_BLIND | RANDOM_START)


def count_jobs() -> Iterator[Job]:
    """Quality against the number of Gaussians, for each way to reach it, at equal steps."""
    yield Job("count", "no pruning", 10000, NO_BUDGET)
    yield Job("count", "the paper's recipe", 10000, PAPER)
    yield Job("count", "the paper's recipe, dilation 0.1", 10000, SHARP_PAPER)
    yield Job("count", "by removal error, auto", 0, {"system.geometry.budget": "auto"})
    for count in COUNTS:
        yield Job("count", "by removal error", count, {"system.geometry.budget": count})
        yield Job("count", "from scratch", count, scratch(count))
    ungrown = {"system.geometry.prior.num_points": 10000, "system.geometry.grow.enabled": "false"}
    middle = COUNTS[-2]
    budget = {"system.geometry.budget": middle}
    yield Job("count", "by removal error, without growing", middle, ungrown | budget)
    for count in COUNTS[-2:]:
        yield from other_ways(count)
    yield Job("count", "at random", middle, budget | {"system.geometry.prune.score": "random"})
    yield Job("count", "the paper's recipe, by removal error", middle, PAPER | budget)


def other_ways(count: int) -> Iterator[Job]:
    """Other scores, slower means, and pruning after the run, all down to ``count``."""
    budget = {"system.geometry.budget": count}
    for score in ("contribution", "opacity"):
        yield Job("count", f"by {score}", count, budget | {"system.geometry.prune.score": score})
    for name, share in SLOWER_MEANS.items():
        start, end = RATES["lr_means"]
        slower = {"system.geometry.lr_means": falling_rate(share * start, end, STEPS)}
        yield Job("count", f"by removal error, {name}", count, budget | slower)
    trained = steps(STEPS - rounds_to(count, 10000) * STEPS_A_ROUND) | NO_BUDGET
    pruned = {"system.prune.count": count, "system.prune.size": 128}
    yield Job("count", "after the run, with recovery", count, trained | pruned)


NOT_ANTIALIASED = "best, not antialiased, dilation 0.1"
DEMOS = {"draft": ("demo-draft", 255), "default": ("", 500), "best": ("demo-best", 3000)}
"""The demo's variants: the overlay and the steps of each."""


def demo_jobs(chart: str, *variants: str) -> Iterator[Job]:
    """Variants of the demo and the base recipe, at the demo's own size."""
    own = {"data.width": 256, "data.height": 256, "system.evaluation.size": 256}
    for name in variants:
        overlay, count = DEMOS[name]
        yield Job(chart, name, 0, own | {"trainer.max_steps": count}, overlay)
    yield Job(chart, "the base recipe", 0, own)


def quality_jobs() -> Iterator[Job]:
    """The demo, its draft and its best variant, and what they are compared with."""
    *_, best, base = jobs = tuple(demo_jobs("quality", *DEMOS))
    yield from jobs
    classic = {"system.renderer.antialias": "false", "system.renderer.eps2d": 0.1}
    yield best._replace(variant=NOT_ANTIALIASED, options=best.options | classic)
    yield base._replace(variant="the paper's recipe", options=base.options | PAPER)


def unseen_jobs() -> Iterator[Job]:
    """The demo, its draft and its best variant on objects that nothing was tuned on."""
    return demo_jobs("unseen", *DEMOS)


def needed_jobs() -> Iterator[Job]:
    """Fixed numbers of Gaussians in the demo, and what ``budget: auto`` chooses by its dial."""
    own = {"data.width": 256, "data.height": 256, "system.evaluation.size": 256}
    own["trainer.max_steps"] = DEMOS["default"][1]
    for count in (500, 1000, 2000, 2828, 4000, 5657, 8000, 11314, 16000):
        fixed = {"system.geometry.budget": count, "system.geometry.prune.keep": 0.8}
        yield Job("needed", "a fixed number", count, own | fixed, "")
    for gain in (0.5, 0.25, 1):
        chosen = {"system.geometry.prune.gain": gain}
        yield Job("needed", f"auto, {gain:g} dB", gain, own | chosen, "")


JOBS: dict[str, Callable[[], Iterator[Job]]] = {
    "time": time_jobs,
    "count": count_jobs,
    "quality": quality_jobs,
    "unseen": unseen_jobs,
    "needed": needed_jobs,
}
WITHOUT_OBJECTS = ("unseen", "needed")
"""Charts whose objects are always given by path."""
