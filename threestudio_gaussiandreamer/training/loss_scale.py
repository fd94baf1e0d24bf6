"""The loss scale of automatic mixed precision: a factor on all gradients, which is halved, and the
step left out, where it makes them infinite.
"""

from typing import Any

from ..host import warn


class LossScale:
    """Follows the scale through a run and counts the steps that were left out."""

    def __init__(self) -> None:
        self.skipped_steps = 0

    def value(self, trainer: Any) -> float:
        """Return the factor on the gradients now; 1 without mixed precision."""
        scaler = getattr(trainer.precision_plugin, "scaler", None)
        return 1.0 if scaler is None else float(scaler.get_scale())

    def has_skipped(self, trainer: Any, before: float) -> bool:
        """Return whether the step that began at the scale ``before`` was left out; if so, count it
        and say so.
        """
        if self.value(trainer) >= before:
            return False
        self.skipped_steps += 1
        warn(
            f"step {trainer.global_step}: gradients overflowed at the loss scale {before:g}, "
            "so nothing was learnt in it; schedules go on "
            f"({self.skipped_steps} such steps so far)"
        )
        return True
