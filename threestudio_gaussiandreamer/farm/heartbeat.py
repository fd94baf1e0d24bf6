"""Lightning's callback by which a run reports its steps to the board and learns of the farm's
stop."""

from collections.abc import Callable
from typing import Any

from ..host import pl
from .board import Beat


class Heartbeat(pl.Callback):
    """Report the steps of a run, and stop it as SIGTERM does when the farm is stopping: with a
    checkpoint.

    Args:
        on_step: called after each training step, such as to upload a new checkpoint.
    """

    def __init__(
        self,
        name: str,
        attempt: int,
        report: Callable[[Beat], bool],
        stop: Callable[[], None],
        on_step: Callable[[], None],
    ) -> None:
        self.name, self.attempt = name, attempt
        self.report, self.stop, self.on_step = report, stop, on_step
        self.asked = False

    def on_train_batch_end(self, trainer: Any, *args: Any) -> None:
        self.on_step()
        stopping = self.beat("training", trainer.global_step, max(trainer.max_steps, 0))
        if stopping and not self.asked:
            self.asked = True
            self.stop()

    def on_validation_batch_end(
        self, trainer: Any, module: Any, outputs: Any, batch: Any, batch_idx: int, *args: Any
    ) -> None:
        self.beat("validating", batch_idx + 1)

    def on_test_batch_end(
        self, trainer: Any, module: Any, outputs: Any, batch: Any, batch_idx: int, *args: Any
    ) -> None:
        self.beat("rendering", batch_idx + 1)

    def beat(self, stage: str, step: int, steps: int = 0) -> bool:
        return self.report(Beat(self.name, self.attempt, stage, step, steps))
