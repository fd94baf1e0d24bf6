"""The runs of each chart and table, as :class:`Job`: variants of the base recipe (`recipe.py`),
which `runs.py` runs.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, Optional

from benchmarks.quality.ablations import (
    CLIPPED,
    LATENT,
    NO_ANNEALING,
    PAPER_RATES,
    RANDOM_START,
    STRONG,
    VIEW_BLIND,
)
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
GREY = {"system.geometry.prior.color": "grey"}
BALL = {
    "system.geometry.prior_type": "random-prior",
    "system.geometry.prior": {"num_points": 8000, "shape": "sphere", "color": "grey"},
}
SMALL = {"data.width": 96, "data.height": 96}
BLURRED = {"system.guidance.latent_size": 4}


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


def fixed_timestep(share: float) -> dict[str, Any]:
    """Return the options of the same timestep in all steps, a share of all timesteps."""
    return {f"system.guidance.{end}_step_percent": share for end in ("min", "max")}


def held(count: int) -> dict[str, Any]:
    """Return the options of a run with one prediction of the score model per ``count`` steps."""
    keys = ("system.guidance.reuse_steps", "data.hold_steps", "system.background.hold_steps")
    return dict.fromkeys(keys, count)


def steps(count: int) -> dict[str, Any]:
    """Return the options of a run of ``count`` steps, with its schedules in proportion."""
    second = SECOND_STAGE * count // STEPS
    schedule = [second, 0.98, 0.55, second + 1]
    rounds = {
        f"system.geometry.prune.{name}": step * count // STEPS
        for name, step in (("start", 100), ("every", 50), ("stop", 900))
    }
    return (
        rounds
        | falling(RATES, count)
        | {"trainer.max_steps": count, "system.guidance.max_step_percent": schedule}
    )


def falling(names: Iterable[str], count: int, factor: float = 1.0) -> dict[str, str]:
    """Return some of the recipe's learning rates, ``factor`` times as high, for ``count`` steps."""
    return {
        f"system.geometry.{name}": falling_rate(*(factor * rate for rate in RATES[name]), count)
        for name in names
    }


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


def grown_jobs() -> Iterator[Job]:
    """Half of COUNTS[1] grown to all of it by gradients; thresholds were chosen on the toy."""
    few = scratch(COUNTS[1] // 2) | {
        "system.geometry.max_gaussians": 10000,
        "system.geometry.budget": COUNTS[1],
    }
    rounds = {"enabled": "true", "start": 100, "stop": 800, "every": 50}
    for absgrad, threshold, name in (
        ("false", 3, "plain gradients"),
        ("true", 5, "absolute gradients"),
    ):
        densify = rounds | {"absgrad": absgrad, "grad_threshold": threshold}
        yield Job(
            "grown",
            name,
            COUNTS[1],
            few | {f"system.geometry.densify.{key}": value for key, value in densify.items()},
        )


def size_jobs() -> Iterator[Job]:
    """Sizes of the renders, and rendering twice as large and shrinking."""
    for size in (64, 128, 256):
        own = {"data.width": size, "data.height": size}
        yield Job("size", "rendered and guided at the same size", size, own)
    for size in (64, 128):
        large = {"data.width": 2 * size, "data.height": 2 * size, "system.renderer.downsample": 2}
        yield Job("size", "rendered twice as large, shrunk", size, large)


def large_jobs() -> Iterator[Job]:
    """The same at 512^2 with 20,000 Gaussians; the smaller dilation that shrinking implies, and the
    same seconds spent on more steps, each alone.
    """
    own = {"data.width": 512, "data.height": 512, "system.evaluation.size": 512}
    many = own | scratch(20000)
    yield Job("large", "rendered at 512²", 0, many)
    yield Job(
        "large", "rendered at 512², dilation 0.025", 0, many | {"system.renderer.eps2d": 0.025}
    )
    yield Job("large", "rendered at 512², 2,000 steps", 0, many | steps(2000))
    yield Job(
        "large",
        "rendered at 1024², shrunk",
        0,
        many | {"data.width": 1024, "data.height": 1024, "system.renderer.downsample": 2},
    )


def batch_jobs() -> Iterator[Job]:
    """Views per step, with as many steps as fit into the recipe's seconds."""
    for batch, count in ((1, 2200), (2, 1650), (4, STEPS), (8, 750)):
        yield Job(
            "batch",
            "equal seconds",
            batch,
            {"data.batch_size": batch, "system.evaluation.every": count // 12} | steps(count),
        )


def iteration_jobs() -> Iterator[Job]:
    """Separate runs: a longer run doesn't continue a shorter one, because schedules differ."""
    for rates, name in (({}, "the base recipe"), (PAPER, "the paper's recipe")):
        for count in (150, 300, 600, 1200):
            yield Job("iterations", name, count, steps(count) | rates)


def rate_jobs() -> Iterator[Job]:
    """Each learning rate of the recipe a third and three times as high, all of them, and all
    held instead of falling.
    """
    yield Job("rates", "the base recipe", 1, {})
    for names in (*([name] for name in RATES), list(RATES)):
        line = names[0].removeprefix("lr_") if len(names) == 1 else "all"
        for factor in (0.3, 3):
            yield Job("rates", line, factor, falling(names, STEPS, factor))
    for factor in (0.1, 0.3, 1):
        held = {f"system.geometry.{name}": factor * start for name, (start, _) in RATES.items()}
        yield Job("rates", "all, held at their start", factor, held)
    yield Job("rates", "the paper's rates", 1, PAPER_RATES)


def preset_jobs() -> Iterator[Job]:
    for preset in ("fast", "balanced", "accurate"):
        yield Job("preset", preset, 0, {"system.renderer.preset": preset})


def dilation_jobs() -> Iterator[Job]:
    """Dilations between the usual 0.3 square pixels and less than a pixel's own box (1/12)."""
    for dilation in (0.03, 0.1, 0.3):
        for antialias, name in ((False, "plain"), (True, "antialiased")):
            yield Job(
                "dilation",
                name,
                dilation,
                {
                    "system.renderer.eps2d": dilation,
                    "system.renderer.antialias": str(antialias).lower(),
                },
            )
        yield Job(
            "dilation",
            "the paper's recipe",
            dilation,
            SHARP_PAPER | {"system.renderer.eps2d": dilation},
        )


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


def failure_jobs() -> Iterator[Job]:
    """Each failure of the method, and each remedy: 96^2 and 600 steps, so that 15 runs of each are
    affordable.
    """
    # bounded colours can't be out of gamut, which is what over-saturation is measured by
    unbounded = {"system.geometry.bound_colors": "false"}
    strong = STRONG | unbounded
    plain_timesteps = LATENT | strong | NO_ANNEALING
    variants = {
        "multi-face: random start": VIEW_BLIND | RANDOM_START,
        "multi-face: random start + view-dependent score": BINS | RANDOM_START,
        "multi-face: prior": VIEW_BLIND,
        "grey prior": VIEW_BLIND | GREY,
        "grey prior + view-dependent score": BINS | GREY,
        "blur: timesteps up to 0.98 throughout": VIEW_BLIND | NO_ANNEALING,
        "blur: coarse latent": VIEW_BLIND | BLURRED,
        "over-saturation: guidance 100": plain_timesteps,
        "over-saturation: annealed": LATENT | strong,
        "over-saturation: annealed, clipped": LATENT | strong | CLIPPED,
        "over-saturation: guidance 7.5, annealed, clipped": LATENT
        | CLIPPED
        | unbounded
        | {"system.guidance.guidance_scale": 8.5},
        "wrong shape: a grey sphere": BALL,
        "right shape": {},
    }
    for name, options in variants.items():
        yield Job("failures", name, 0, SMALL | steps(600) | options)


def front_back_jobs() -> Iterator[Job]:
    """The paper's limit: an object whose front and back differ little in shape."""
    variants = {
        "same shape: grey prior": VIEW_BLIND | GREY,
        "same shape: grey prior + view-dependent score": BINS | GREY,
        "same shape: coloured prior": VIEW_BLIND,
        "same shape: coloured prior + view-dependent score": BINS,
    }
    for name, options in variants.items():
        yield Job("front_back", name, 0, SMALL | steps(600) | options)


JOBS: dict[str, Callable[[], Iterator[Job]]] = {
    "time": time_jobs,
    "count": count_jobs,
    "grown": grown_jobs,
    "size": size_jobs,
    "large": large_jobs,
    "batch": batch_jobs,
    "iterations": iteration_jobs,
    "rates": rate_jobs,
    "preset": preset_jobs,
    "dilation": dilation_jobs,
    "quality": quality_jobs,
    "failures": failure_jobs,
    "front_back": front_back_jobs,
    "unseen": unseen_jobs,
}
WITHOUT_OBJECTS = ("unseen",)
"""Charts whose objects are always given by path."""
OWN_OBJECTS = {"front_back": ["benchmarks/scenes/ball.ply"]}
"""What a chart is made on, where it isn't the objects that are asked for."""
