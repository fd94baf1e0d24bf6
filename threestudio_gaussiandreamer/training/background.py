"""Background ``gaussiandreamer-background``: one colour per view, composited inside the rasteriser.

==========  ========================================================================================
option      meaning
==========  ========================================================================================
mode        ``fixed``: always ``color``; ``random``: in training a random colour per view, otherwise
            ``color``; ``learned``
color       RGB in [0, 1]
lr          learning rate of the learned colour: a number or a schedule
==========  ========================================================================================
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, Tuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..core.devices import to_device
from ..core.distributed import first_item
from ..core.options import each, in_range, one_of, schedule
from ..core.streams import generator
from ..host import BaseBackground, register, run_seed


@register("gaussiandreamer-background")
class FlatBackground(BaseBackground):
    @dataclass
    class Config(BaseBackground.Config):
        mode: str = field(default="fixed", metadata=one_of(("fixed", "random", "learned")))
        color: Tuple[float, float, float] = field(
            default=(0.0, 0.0, 0.0), metadata=each(in_range(0, 1))
        )
        lr: Any = field(default=1e-2, metadata=schedule(min=0))

        REMOVED: ClassVar[dict[str, Any]] = {"hold_steps": (1, "each step has its own colours")}

    cfg: Config

    def configure(self) -> None:
        color = torch.tensor(self.cfg.color, dtype=torch.float32)
        if self.cfg.mode == "learned":
            self.logit = nn.Parameter(torch.logit(color.clamp(1e-3, 1 - 1e-3)))
        else:
            self.register_buffer("fixed", color, persistent=False)
        self.step = 0

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        self.step = global_step

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return the optimiser's group of the learned colour; none for the other modes."""
        if self.cfg.mode != "learned":
            return []
        return [{"params": [self.logit], "name": "background", "lr": 0.0}]

    def color(self, batch_size: int) -> Float[Tensor, "B 3"]:
        """Return a colour per view, in [0, 1]; random ones are a function of (seed, step, view)."""
        if self.cfg.mode == "learned":
            return torch.sigmoid(self.logit).expand(batch_size, 3)
        if self.cfg.mode == "random" and self.training:
            first = first_item(batch_size)
            colors = [
                torch.rand(3, generator=generator(run_seed(), "background", self.step, item))
                for item in range(first, first + batch_size)
            ]
            return to_device(torch.stack(colors), self.fixed.device).to(self.fixed)
        return self.fixed.expand(batch_size, 3)

    @classmethod
    def is_flat(cls, background: Any) -> bool:
        """Whether a background has one colour per view: ours, unless it has its own ``forward``."""
        return isinstance(background, cls) and type(background).forward is cls.forward

    def forward(self, dirs: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B H W 3"]:
        return self.color(len(dirs))[:, None, None].expand(*dirs.shape[:-1], 3)
