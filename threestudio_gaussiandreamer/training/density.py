"""Density control ``gaussiandreamer-density``: clone, split and prune Gaussians during training.

As gsplat's ``Strategy``, one object is called around every optimiser step; another one is chosen by
``system.geometry.density_type``:

    control = density_rule(cloud)
    pictures = renderer(**batch)
    control.before_backward(pictures, step, error)      samples the removal error
    loss.backward()
    control.after_backward(rasterized, width, height)   adds to the statistics
    optimizer.step()
    needed = control.after_step(optimizer, step + 1)    densifies and prunes when it is due

``step`` counts finished optimiser steps. The statistics are buffers of the cloud, and so in its
checkpoint. What is cloned and split: ``gaussians/densify.py``; what is dropped to meet a budget:
``gaussians/importance.py``; the options: the head of ``geometry.py``.
"""

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.devices import to_device
from ..core.distributed import all_max, all_sum, draw_shared
from ..core.errors import UserError
from ..core.options import at_least, between, in_range, positive
from ..core.streams import generator
from ..gaussians import densify, importance
from ..gaussians.densify import Change
from ..gaussians.importance import Need
from ..host import find, parse_structured, register, run_seed
from ..host.methods import require_method
from ..splatting import Rasterized

AUTO = "auto"
LOSSY = -2.0
"""The buffer ``gain`` where a round would have lost too much, before any dropped some."""
DECAY = 0.1
"""Fall of logits of opacities in a step of ``budget: auto``, in units of their learning rate, so
that what no loss holds up fades (after natural selection, Deng et al. 2025, arXiv 2511.16980)."""
LEAST_ERROR = 2.5e-4
"""Smallest mean squared error to the ground truth that ``auto`` reckons with, 36 dB: clouds that
exceed it at the rates of the rounds end above 41 dB, where more Gaussians don't pay."""
MeanError = Callable[[], Float[Tensor, ""]]


@dataclass
class DensifyConfig:
    enabled: bool = False
    start: int = field(default=400, metadata=at_least(0))
    stop: int = field(default=900, metadata=at_least(0))
    every: int = field(default=100, metadata=at_least(1))
    grad_threshold: float = field(default=2e-4, metadata=at_least(0))
    split_scale: float = field(default=0.04, metadata=positive())
    min_opacity: float = field(default=0.05, metadata=in_range(0, 1 - 1e-6))
    max_scale: float = field(default=0.4, metadata=positive("world units"))
    absgrad: bool = False

    @staticmethod
    def check(cfg: Any) -> None:
        if cfg.enabled:
            PruneConfig.check(cfg)


@dataclass
class PruneConfig:
    start: int = field(default=100, metadata=at_least(0))
    stop: int = field(default=900, metadata=at_least(0))
    every: int = field(default=50, metadata=at_least(1))
    keep: float = field(default=0.8, metadata=between(0, 1))
    gain: float = field(default=0.5, metadata=between(0, 6, "dB"))
    likeness: float = field(default=40.0, metadata=at_least(0, "dB"))
    REMOVED: ClassVar[dict[str, Any]] = {
        "quality": (0.1, "budget=auto goes by prune.gain"),
        "score": ("removal", "the removal error ranks Gaussians"),
    }

    @staticmethod
    def check(cfg: Any) -> None:
        if cfg.start >= cfg.stop:
            raise UserError(f"stop: expected more than start ({cfg.start}), got {cfg.stop}")


def min_count(cfg: Any) -> int:
    """Return how many Gaussians pruning leaves at least under the budget of a geometry."""
    return max(cfg.min_gaussians, 0 if cfg.budget == AUTO else cfg.budget)


def rounds_of(schedule: Any) -> range:
    """Return the steps at which a schedule has a round: the multiples of ``every``."""
    first = math.ceil(schedule.start / schedule.every) * schedule.every
    return range(first, schedule.stop, schedule.every)


class DensityRule:
    """Base class of density rules, whose hooks are called around every optimiser step; ``cfg`` are
    its options, ``system.geometry.density``. :meth:`after_step` may change ``cloud``, a
    :class:`.geometry.GaussianCloud`, by its ``apply_change`` where the number of Gaussians changes.
    """

    @dataclass
    class Config:
        pass

    cfg: Any

    def __init__(self, cloud: Any) -> None:
        self.cloud = cloud
        self.cfg = parse_structured(self.Config, cloud.cfg.density, "system.geometry.density.")

    def schedule_problem(self, step: int, max_steps: int) -> Optional[str]:
        """Describe what keeps the rule from its aim between ``step`` and ``max_steps`` (-1:
        unlimited), for a warning; None if nothing does.
        """
        if not self.cloud.cfg.densify.enabled and self.cloud.cfg.budget is None:
            return None
        return (
            f"{type(self).__name__} reads neither system.geometry.densify nor budget: they are of "
            "gaussiandreamer-density"
        )

    def before_backward(
        self, pictures: Mapping[str, Any], step: int, error: Optional[MeanError] = None
    ) -> None:
        """Look at the output of the renderer after ``step`` finished optimiser steps; ``error``
        computes its mean squared error to the ground truth, where there is one.
        """

    def after_backward(
        self, out: Rasterized, width: int, height: int, loss_scale: float = 1.0
    ) -> None:
        """Look at the output of the rasteriser, with gradients at ``means2d``, for renders of
        ``width`` by ``height`` pixels; mixed precision multiplies gradients by ``loss_scale``.
        """

    def after_step(self, optimizer: torch.optim.Optimizer, step: int) -> Optional[Need]:
        """Change the cloud after ``step`` finished optimiser steps."""

    def summary(self) -> str:
        """Say how many Gaussians there are, and why; printed at the end of a run."""
        count, start = len(self.cloud), int(self.cloud.started_with)
        return f"{count:,} of {start:,} Gaussians" if start else f"{count:,} Gaussians"


def density_rule(cloud: Any) -> DensityRule:
    """Build the rule that ``density_type`` of a cloud names; raise UserError if it can't be one."""
    rule = find(cloud.cfg.density_type)
    if not (isinstance(rule, type) and issubclass(rule, DensityRule)):
        raise UserError(
            f"system.geometry.density_type is {cloud.cfg.density_type!r}: expected a class that is "
            f"derived from {DensityRule.__module__}.DensityRule"
        )
    hooks = "schedule_problem", "before_backward", "after_backward", "after_step", "summary"
    for name in hooks:
        _, *arguments = inspect.signature(getattr(DensityRule, name)).parameters
        require_method(rule, name, *arguments)
    return rule(cloud)


@register("gaussiandreamer-density")
class DensityControl(DensityRule):
    """Densification and pruning by the options of the cloud, whose buffers are the statistics."""

    # -- schedules ---------------------------------------------------------------------------------

    def kept_share(self, count: int, step: int) -> float:
        """Return the share that a round keeps: ``prune.keep``, or less if the budget needs it."""
        left = sum(later >= step for later in rounds_of(self.cloud.cfg.prune))
        if self.cloud.cfg.budget in (None, AUTO) or not left:
            return self.cloud.cfg.prune.keep
        to_least = (min_count(self.cloud.cfg) / max(count, 1)) ** (1 / left)
        return min(self.cloud.cfg.prune.keep, to_least)

    def pruning_at(self, step: int) -> bool:
        """Return whether the next step is before a round of pruning, or between two."""
        rounds = rounds_of(self.cloud.cfg.prune)
        return bool(rounds) and rounds[0] - self.cloud.cfg.prune.every <= step < rounds[-1]

    def schedule_problem(self, step: int, max_steps: int) -> Optional[str]:
        """Describe why the remaining rounds can't do what they are to."""
        cfg, count = self.cloud.cfg, len(self.cloud)
        end, problems = max_steps if max_steps > 0 else math.inf, []
        growth = rounds_of(cfg.densify) if cfg.densify.enabled else range(0)
        left = max(growth, default=0) > step
        if cfg.densify.enabled:
            problems.append(round_problem("densification", "densify", growth, end))
        if count > cfg.max_gaussians or left and count == cfg.max_gaussians:
            problems.append(
                f"{count} Gaussians leave no room for more below system.geometry.max_gaussians "
                f"({cfg.max_gaussians}), which limits only the start and densification: for fewer, "
                "set system.geometry.budget, or prune the result"
            )
        if cfg.budget is not None:
            problems.append(self._pruning_problem(step, end))
        return "; ".join(filter(None, problems)) or None

    def _pruning_problem(self, step: int, end: float) -> Optional[str]:
        budget, keep, count = self.cloud.cfg.budget, self.cloud.cfg.prune.keep, len(self.cloud)
        rounds = rounds_of(self.cloud.cfg.prune)
        if problem := round_problem("pruning", "prune", rounds, end):
            return problem
        if budget == AUTO and rounds.step < importance.SAMPLES:
            return (
                f"budget=auto samples once a step, too rarely in {rounds.step} steps a round: set "
                f"system.geometry.prune.every to {importance.SAMPLES} or more"
            )
        if budget == AUTO or count <= budget:
            return None
        left = [round_ for round_ in rounds if step < round_ <= end]
        share = self.kept_share(count, left[0]) if left else 0.0
        # equal in the two decimals of the message
        if share >= keep - 0.005:
            return None
        each = f": each keeps {share:.2f} instead of {keep:g}, which loses quality" if left else ""
        return (
            f"{len(left)} rounds of pruning must reduce {count} Gaussians to {budget}{each}; use "
            "more rounds (system.geometry.prune.start, stop and every) or start with fewer"
        )

    # -- statistics --------------------------------------------------------------------------------

    def before_backward(
        self, pictures: dict[str, Any], step: int, error: Optional[MeanError] = None
    ) -> None:
        """Sample the removal error if the next round uses it, and the error that ``auto`` needs."""
        if not self.samples_removal(step):
            return
        if self.cloud.cfg.budget == AUTO:
            likely = 10 ** (-0.1 * self.cloud.cfg.prune.likeness)
            mean = max(float(error()), LEAST_ERROR) if error else likely
            pixels = pictures["comp_rgb"].numel()
            self.cloud.error += all_sum(torch.full_like(self.cloud.error, mean * pixels))
        rng, image = generator(run_seed(), "removal", step), pictures["comp_rgb"]
        # Composite over a random background per view, so that Gaussians of the background's colour
        # still have a removal error.
        random = draw_shared(len(image), lambda count: torch.rand(count, 1, 1, 3, generator=rng))
        random = to_device(random, image.device).to(image)
        added = pictures["opacity"], random - pictures["comp_rgb_bg"].detach()
        opacities = pictures["gaussian_opacities"]
        self.cloud.removal += importance.removal_error(image, opacities, rng, added)
        if self.cloud.wants_absgrad:
            # removal_error has added its gradients to absgrad, which is for those of the loss only
            pictures["rasterized"].means2d.absgrad.zero_()

    def samples_removal(self, step: int) -> bool:
        """Return whether a sample of the removal error is due after ``step`` finished steps."""
        cfg = self.cloud.cfg
        if cfg.budget is None or not self.pruning_at(step) or len(self.cloud) <= min_count(cfg):
            return False
        return step % max(1, round(cfg.prune.every / importance.SAMPLES)) == 0

    def after_backward(
        self, out: Rasterized, width: int, height: int, loss_scale: float = 1.0
    ) -> None:
        """Add contributions, and for densification screen-space gradients, to the statistics."""
        cloud = self.cloud
        if out.means2d.grad is not None and cloud.cfg.densify.enabled:
            pixels = out.means2d.absgrad if cloud.wants_absgrad else out.means2d.grad
            norms = densify.screen_gradients(pixels, width, height, loss_scale)
            cloud.gradient_sum += all_sum(norms.sum(0))
            cloud.gradient_count += all_sum((out.radii > 0).sum(0))
        torch.maximum(cloud.contribution, all_max(out.contribution.amax(0)), out=cloud.contribution)

    # -- changes of the cloud ----------------------------------------------------------------------

    def after_step(self, optimizer: torch.optim.Optimizer, step: int) -> Optional[Need]:
        """Densify and prune if it is due at ``step``; return what ``budget: auto`` has found."""
        change, needed = None, None
        if self.cloud.cfg.budget == AUTO and self.pruning_at(step - 1):
            self.decay_opacities(optimizer)
        if self.cloud.cfg.densify.enabled and step in rounds_of(self.cloud.cfg.densify):
            change = self.densified(step)
            self.cloud.gradient_sum.zero_()
            self.cloud.gradient_count.zero_()
            if not change.is_new.any() and len(change.parents) == len(self.cloud):
                change = None
        if self.cloud.cfg.budget is not None and step in rounds_of(self.cloud.cfg.prune):
            change, needed = self._prune(step, change)
        if change is not None:
            self.cloud.apply_change(change, optimizer)
        return needed

    @torch.no_grad()
    def decay_opacities(self, optimizer: torch.optim.Optimizer) -> None:
        """Lower all opacities by ``DECAY`` of their learning rate."""
        for group in optimizer.param_groups:
            if group.get("name") == "logit_opacities":
                self.cloud.logit_opacities.sub_(DECAY * group["lr"])

    def densified(self, step: int) -> Change:
        """Clone, split and drop Gaussians; under a budget up to it, or to the current number."""
        cfg, cloud, budget = self.cloud.cfg.densify, self.cloud, self.cloud.cfg.budget
        most = cloud.cfg.max_gaussians
        if budget not in (None, AUTO):
            most = min(most, max(budget, len(cloud)))
        gradient = cloud.gradient_sum / cloud.gradient_count.clamp_min(1)
        statistics, rng = (gradient, cloud.contribution), generator(run_seed(), "split", step)
        counts = cloud.cfg.min_gaussians, most
        return densify.densify_and_prune(cloud.parameters_by_name(), *statistics, cfg, *counts, rng)

    def _prune(self, step: int, first: Optional[Change]) -> tuple[Change, Optional[Need]]:
        """Prune once, after densification ``first`` of this step; return both, and the need."""
        cloud, cfg = self.cloud, self.cloud.cfg.prune
        change = densify.unchanged(cloud.parameters_by_name()) if first is None else first
        removal = cloud.removal[change.parents]
        scores = importance.importance(cloud.contribution[change.parents], removal)
        here, needed = len(scores), None
        share = self.kept_share(here, step)
        count = min(here, max(min_count(cloud.cfg), int(share * here)))
        if cloud.cfg.budget == AUTO:
            error = float(cloud.error)
            needed = importance.needed_count(scores, removal, error, cfg.gain, cfg.keep)
            count = max(count, needed.count)
            if needed.gain >= 0 and (not needed.enough or cloud.gain < 0):
                cloud.gain.fill_(LOSSY if needed.enough else needed.gain)
        return densify.select(change, densify.highest(scores, count)), needed

    def summary(self) -> str:
        budget, gain = self.cloud.cfg.budget, float(self.cloud.gain)
        none = "a round would have lost too much" if gain == LOSSY else "no round has dropped any"
        why = {None: "no budget", AUTO: Need(len(self.cloud), gain) if gain >= 0 else none}
        return f"{super().summary()}: {why.get(budget, f'the budget is {budget}')}"


def round_problem(what: str, option: str, rounds: range, end: float) -> Optional[str]:
    """Describe that there are no rounds, or how many would come after the last step."""
    late = sum(round_ > end for round_ in rounds)
    if rounds and not late:
        return None
    found = f"{late} of the {len(rounds)} rounds of {what} would come after step {end}, the last"
    return (
        f"{found if late else f'{what} has no round'}: set system.geometry.{option}.start, stop "
        "and every accordingly"
    )
