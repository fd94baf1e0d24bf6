"""The options of density control: ``densify``, ``prune`` and ``budget`` of the geometry, whose head
describes them.
"""

import contextlib
import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

from ..core.errors import UserError
from ..core.options import at_least, between, in_range, is_whole, positive, shown

AUTO = "auto"


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
            require_order(cfg)


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
        require_order(cfg)


def require_order(cfg: Any) -> None:
    """Raise UserError unless a schedule of rounds starts before it stops."""
    if cfg.start >= cfg.stop:
        raise UserError(f"stop: expected more than start ({cfg.start}), got {cfg.stop}")


def as_budget(given: Any) -> Any:
    """Read a budget however it is written: ``none`` as None, whole numbers as int."""
    if isinstance(given, str):
        given = given.lower()
        with contextlib.suppress(ValueError):
            given = float(given)  # 5e3 is text to PyYAML
    if given == "none":
        return None
    return int(given) if isinstance(given, float) and given.is_integer() else given


def check_budget(cfg: Any) -> None:
    """Raise UserError for a budget that can't be met."""
    if cfg.budget in (None, AUTO) or is_whole(cfg.budget) and cfg.budget >= cfg.min_gaussians:
        return
    raise UserError(
        "budget: expected none, auto or a number from min_gaussians "
        f"({cfg.min_gaussians}) on, got {shown(cfg.budget)}"
    )


def min_count(cfg: Any) -> int:
    """Return how many Gaussians pruning leaves at least; ``cfg`` has ``min_gaussians`` and a
    ``budget``.
    """
    return max(cfg.min_gaussians, 0 if cfg.budget == AUTO else cfg.budget)


def rounds_of(schedule: Any) -> range:
    """Return the steps at which a schedule with ``start``, ``stop`` and ``every`` has a round: the
    multiples of ``every``.
    """
    first = math.ceil(schedule.start / schedule.every) * schedule.every
    return range(first, schedule.stop, schedule.every)
