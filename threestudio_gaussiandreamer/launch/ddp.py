"""Lightning's strategy for several GPUs: processes that hold the same cloud and average gradients,
without DDP's wrapper.

DistributedDataParallel binds its buckets to the parameters that it sees first; densification
replaces them. The cloud is small, so the system averages the gradients itself
(``distributed.average_gradients``), and every process densifies alike from statistics that are
combined over all of them."""

import torch

from ..host import pl


class ReplicatedStrategy(pl.strategies.DDPStrategy):
    """Launches and connects processes as DDP does; the module isn't wrapped."""

    def _setup_model(self, model: torch.nn.Module) -> torch.nn.Module:
        return model

    def configure_ddp(self) -> None:
        """Do nothing: no module is wrapped, and no hooks are registered."""
