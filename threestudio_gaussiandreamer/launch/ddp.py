"""Lightning's strategy for several GPUs: every process has a copy of the cloud, and gradients are
averaged without DistributedDataParallel.

DistributedDataParallel ties its buckets to the parameters of its first iteration, which
densification replaces. The cloud is small, so the system averages the gradients itself
(``distributed.average_gradients``). The statistics for densification are combined over all
processes, so that they make the same changes."""

import torch

from ..host import pl


class ReplicatedStrategy(pl.strategies.DDPStrategy):
    """Launch and connect processes as DDP does, without wrapping the module."""

    def _setup_model(self, model: torch.nn.Module) -> torch.nn.Module:
        return model

    def configure_ddp(self) -> None:
        """Leave the module unwrapped, and register no communication hooks."""
