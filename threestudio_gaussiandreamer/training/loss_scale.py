"""The loss scale of automatic mixed precision: a factor on all gradients. If it makes them
infinite, it is halved and the step is skipped.
"""

from typing import Any

from ..host import warn


class LossScale:
    """Track the loss scale of a run, and count the skipped steps."""

    def __init__(self) -> None:
        self.skipped_steps = 0

    @property
    def numbers(self) -> dict[str, float]:
        """Return what is logged."""
        return {"train/skipped_steps": self.skipped_steps}

    def value(self, trainer: Any) -> float:
        """Return the current factor on the gradients; 1 without mixed precision."""
        scaler = getattr(trainer.precision_plugin, "scaler", None)
        return 1.0 if scaler is None else float(scaler.get_scale())

    def has_skipped(self, trainer: Any, before: float) -> bool:
        """Return whether the step that began with the scale ``before`` was skipped; if so, count
        and report it.
        """
        if self.value(trainer) >= before:
            return False
        self.skipped_steps += 1
        warn(
            f"step {trainer.global_step}: gradients overflowed at the loss scale {before:g}, "
            "so its update was skipped; schedules continue "
            f"({self.skipped_steps} such steps so far)"
        )
        return True
