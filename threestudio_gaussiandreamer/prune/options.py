"""What a pruning may be asked for, and how its numbers are read.

Errors are multiplied and added as mean squared errors: those of independent losses add up."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Optional

from ..core.errors import UserError
from ..core.options import at_least, in_range
from ..gaussians.simplify import Budget
from ..gaussians.views import LEAST_ERROR

BUDGETS = ("count", "bytes", "psnr", "within")
LOSSES = (1e-3, 30.0)
"""Range of ``within``, dB."""


@dataclass
class PruneOptions:
    """A budget, at most one of the first four, and how it is met."""

    count: Any = None
    """How many Gaussians to keep."""
    bytes: Any = None
    """The largest size of the file, such as 500kB."""
    psnr: Any = None
    """The smallest PSNR to the original, dB."""
    within: Any = None
    """The largest loss against the truth, dB, to which the original has the PSNR ``quality``."""
    quality: float = field(default=35.0, metadata=in_range(-200, 200, "dB"))
    size: int = field(default=256, metadata=in_range(16, 4096, "pixels"))
    """Pixels each way of the views that quality is measured in."""
    steps: int = field(default=60, metadata=in_range(1, 100_000))
    """Of recovery after each round."""
    eps2d: Optional[float] = field(default=None, metadata=at_least(0, "square pixels"))
    """Screen-space dilation of the viewer, square pixels; None is that of most viewers."""
    antialias: Optional[bool] = None

    @property
    def asked_for(self) -> bool:
        return any(getattr(self, name) is not None for name in BUDGETS)

    @staticmethod
    def check(cfg: "PruneOptions") -> None:
        """Check the rules across fields, and what users write as text.

        Raises:
            UserError: more than one budget, or a number out of its range.
        """
        given = [name for name in BUDGETS if getattr(cfg, name) is not None]
        if len(given) > 1:
            raise UserError(f"{given[1]}: give one budget; {given[0]} is one too")
        budget_of(cfg, "")


def budget_of(
    options: PruneOptions, where: str, count_within: Callable[[int], int] = lambda size: size
) -> Budget:
    """Return the budget that the options ask for.

    Args:
        where: what the names of options begin with in messages.
        count_within: how many Gaussians fit into so many bytes.

    Raises:
        UserError: a number out of its range.
    """
    if options.count is not None:
        return Budget(count=parse_count(options.count, f"{where}count"))
    if options.bytes is not None:
        count = count_within(parse_bytes(options.bytes, f"{where}bytes"))
        return Budget(count=parse_count(count, f"{where}bytes, in Gaussians,"))
    if options.psnr is not None:
        psnr = parse_number(options.psnr, f"{where}psnr", "dB")
        if psnr <= 0:
            raise UserError(f"{where}psnr: expected a number above 0, got {psnr:g}")
        return Budget(psnr=psnr)
    if options.within is not None:
        return Budget(psnr=psnr_for_loss(parse_loss(options.within, where), options.quality))
    return Budget()


# ---- numbers that users write --------------------------------------------------------------------


def parse_number(value: Any, option: str, unit: str = "") -> float:
    """Read a finite number, with or without its unit.

    Raises:
        UserError: it is no such number.
    """
    text = str(value).strip()
    try:
        found = float(re.sub(rf"\s*{unit}$", "", text, flags=re.IGNORECASE))
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise UserError(f"{option}: expected a number, got {text!r}")
    return found


def parse_count(value: Any, option: str) -> int:
    """Read a whole number from 1 on.

    Raises:
        UserError: it is no such number.
    """
    found = parse_number(value, option)
    if found < 1 or found != int(found):
        raise UserError(f"{option}: expected a whole number from 1 on, got {found:g}")
    return int(found)


def parse_bytes(value: Any, option: str) -> int:
    """Read a size such as 500kB or 2MB; k, M and G are powers of 1000.

    Raises:
        UserError: it is no size.
    """
    found = re.fullmatch(r"\s*([\d.]+)\s*(k|m|g)?b?\s*", str(value).lower())
    if not found:
        raise UserError(f"{option}: expected a size such as 500kB or 2MB, got {str(value)!r}")
    factor = 1000 ** ("kmg".index(found[2]) + 1 if found[2] else 0)
    return int(parse_number(found[1], option) * factor)


def parse_loss(value: Any, where: str) -> float:
    """Read ``within``, dB.

    Raises:
        UserError: it is out of its range.
    """
    loss = parse_number(value, f"{where}within", "dB")
    if not LOSSES[0] <= loss <= LOSSES[1]:
        raise UserError(
            f"{where}within: expected a loss from {LOSSES[0]:g} to {LOSSES[1]:g} dB, got {loss:g}"
        )
    return loss


# ---- dB ------------------------------------------------------------------------------------------


def psnr_for_loss(loss: float, quality: float) -> float:
    """Return the PSNR to the original at which the PSNR to the truth falls by ``loss`` from
    ``quality``, all in dB.

    With independent errors ``10^(loss / 10) = 1 + 10^((quality - psnr) / 10)``.
    """
    return quality - 10 * math.log10(10 ** (loss / 10) - 1)


def remaining_psnr_budget(asked: float, spent: float) -> Optional[float]:
    """Return the PSNR to a cloud pruned to ``spent`` dB that is ``asked`` dB to its original; None
    where nothing is left.
    """
    left = error_of(asked) - error_of(spent)
    return -10 * math.log10(left) if left > LEAST_ERROR else None


def combined_psnr(*psnrs: float) -> float:
    """Return the PSNR after several independent losses."""
    return -10 * math.log10(sum(map(error_of, psnrs)))


def error_of(psnr: float) -> float:
    """Return the mean squared error of a PSNR, at least the smallest that is measured."""
    return max(10 ** (-psnr / 10), LEAST_ERROR)
