"""The runs of each chart and table, as :class:`Job`: variants of the base recipe (`recipe.py`),
which `runs.py` runs.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Optional

from benchmarks.quality.ablations import PAPER_RATES, RANDOM_START, VIEW_BLIND

STEPS = 1200
NO_BUDGET = {"system.geometry.budget": "null"}
PAPER_START = {
    "system.geometry.init_opacity": 0.1,
    "system.geometry.grow.radius": 0.01,
    "system.geometry.bound_colors": "false",
}
PAPER = PAPER_RATES | NO_BUDGET | PAPER_START | {"system.renderer.eps2d": 0.3}
"""The recipe of the paper: its learning rates, start and screen-space dilation, and no pruning."""
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


def time_jobs() -> Iterator[Job]:
    """Each kind of score, with a prior and from a random start, over time."""
    yield Job("time", "view-exact, the base recipe", 0, {})
    yield Job("time", "view-exact, the paper's recipe", 0, PAPER)
    yield Job("time", "direction bins", 0, BINS)
    yield Job("time", "view-blind, prior", 0, VIEW_BLIND)
    yield Job("time", "view-blind, random start", 0, VIEW_BLIND | RANDOM_START)


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
    "quality": quality_jobs,
    "unseen": unseen_jobs,
    "needed": needed_jobs,
}
WITHOUT_OBJECTS = ("unseen", "needed")
"""Charts whose objects are always given by path."""
