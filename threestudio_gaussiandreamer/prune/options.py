"""The options of pruning, and the parsing of their values.

PSNRs are combined through their mean squared errors, which add up for independent errors."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Optional

from ..core.errors import UserError
from ..core.options import (
    INT64_MAX,
    RULE,
    Rule,
    at_least,
    between,
    in_range,
    is_number,
    positive,
    satisfies,
    wrong,
)
from ..gaussians.simplify import Budget
from ..gaussians.views import LEAST_ERROR

BUDGETS = ("count", "bytes", "psnr", "within", "auto")
NUMBER = satisfies("a number", is_number)
WHOLE = satisfies("a whole number from 1 on", lambda v: is_number(v) and 1 <= v == int(v))
LOSSES, GAINS = in_range(1e-3, 30, "dB"), between(0, 6, "dB")


@dataclass
class PruneOptions:
    """A budget, which is at most one of the first five options, and how pruning meets it."""

    count: Any = None
    """How many Gaussians to keep."""
    bytes: Any = None
    """The largest size of the file, such as 500kB."""
    psnr: Any = None
    """The smallest PSNR to the original, dB."""
    within: Any = None
    """The largest loss of PSNR to the ground truth, dB; the original's PSNR is ``quality``."""
    auto: Any = None
    """As many Gaussians as are needed: twice as many would gain less than this, dB."""
    quality: Optional[float] = field(default=None, metadata=in_range(-200, 200, "dB"))
    size: int = field(default=256, metadata=in_range(16, 4096, "pixels"))
    """Height and width of the views in which PSNR is measured, pixels."""
    steps: int = field(default=60, metadata=in_range(1, 100_000))
    """Optimisation steps that recover quality after each round of pruning."""
    eps2d: Optional[float] = field(default=None, metadata=at_least(0, "square pixels"))
    """Screen-space dilation of the viewer, square pixels; None for the value of most viewers."""
    antialias: Optional[bool] = None

    @property
    def asked_for(self) -> bool:
        return any(getattr(self, name) is not None for name in BUDGETS)

    @staticmethod
    def check(cfg: "PruneOptions") -> None:
        """Check that at most one budget is given, and its value."""
        given = [name for name in BUDGETS if getattr(cfg, name) is not None]
        if len(given) > 1:
            raise UserError(f"{given[1]}: give one budget only; {given[0]} is set too")
        if cfg.quality is None and given == ["within"]:
            raise UserError(
                "within: give quality (--quality) too, the PSNR of the unpruned cloud to the "
                "ground truth in dB, such as 35"
            )
        if cfg.quality is not None and given not in (["within"], ["auto"]):
            raise UserError("quality: has no effect without the budget within or auto")
        budget_of(cfg, "")


def budget_of(
    options: PruneOptions, where: str, count_within: Callable[[int], int] = lambda size: size
) -> Budget:
    """Convert the options to a budget in Gaussians or in PSNR to the original.

    Args:
        where: the prefix of options' names in messages.
        count_within: returns how many Gaussians fit into a number of bytes.

    Raises:
        UserError: a number out of its range.
    """
    if options.count is not None:
        return Budget(count=parse_count(options.count, f"{where}count"))
    if options.bytes is not None:
        count = count_within(parse_bytes(options.bytes, f"{where}bytes"))
        return Budget(count=parse_count(count, f"{where}bytes: the number of Gaussians that fit"))
    if options.psnr is not None:
        return Budget(psnr=parse_number(options.psnr, f"{where}psnr", "dB", positive("dB")))
    if options.within is not None:
        loss = parse_number(options.within, f"{where}within", "dB", LOSSES)
        return Budget(psnr=psnr_for_loss(loss, options.quality))
    if options.auto is not None:
        gain = parse_number(options.auto, f"{where}auto", "dB", GAINS)
        error = Budget().error if options.quality is None else error_of(options.quality)
        return Budget(gain=gain, error=error)
    return Budget()


def parse_number(value: Any, option: str, unit: str = "", rule: Rule = NUMBER) -> float:
    """Parse a number, with or without its unit, and check it."""
    text = str(value).strip()
    number = text[: -len(unit)] if unit and text.lower().endswith(unit.lower()) else text
    try:
        found: Any = float(number)
    except ValueError:
        found = text  # which no rule for numbers accepts
    rule[RULE](option, found)
    return found


def parse_count(value: Any, option: str) -> int:
    """Parse a whole number of at least 1."""
    return int(parse_number(value, option, rule=WHOLE))


def parse_bytes(value: Any, option: str) -> int:
    """Parse a size such as 500kB or 2MB into bytes; k, M and G are powers of 1000."""
    # no two neighbouring parts of the pattern match the same character, so it takes linear time
    found = re.fullmatch(r"([\d.]+)\s*(k|m|g)?b?", str(value).strip().lower())
    factor = 1000 ** ("kmg".index(found[2]) + 1) if found and found[2] else 1
    size = parse_number(found[1], option) * factor if found else math.inf
    if size > INT64_MAX:
        raise wrong(option, "a size such as 500kB or 2MB, below 2^63 bytes", value)
    return int(size)


def psnr_for_loss(loss: float, quality: float) -> float:
    """Return the PSNR to the original at which that to the truth is ``loss`` below ``quality``, dB.

    For independent errors ``10^(loss / 10) = 1 + 10^((quality - psnr) / 10)``.
    """
    return quality - 10 * math.log10(10 ** (loss / 10) - 1)


def combined_psnr(*psnrs: float) -> float:
    """Return the PSNR that results from several independent errors, dB."""
    return -10 * math.log10(sum(map(error_of, psnrs)))


def error_of(psnr: float) -> float:
    """Return the mean squared error of a PSNR in dB, at least ``LEAST_ERROR``."""
    return max(10 ** (-psnr / 10), LEAST_ERROR)
