"""What a text-to-image model is conditioned on in a step."""

from typing import NamedTuple, Optional

import torch
from jaxtyping import Float, Int
from torch import Tensor

Latents = Float[Tensor, "kB c h w"]
Timesteps = Int[Tensor, " kB"]
Embeddings = Float[Tensor, "kB N F"]
"""Inputs of the network, a row for each row of a :class:`Condition`."""


class Condition(NamedTuple):
    """The text embeddings of B views, k rows per view. What else a model is conditioned on is in
    further tokens of each row (``models/pooled_embeddings.py``).
    """

    embeddings: Float[Tensor, "kB N F"]
    """Prompts of all views, negative prompts of all views, and with Perp-Neg two further rows for
    each view, adjacent.
    """
    negative_weights: Optional[Float[Tensor, "B 2"]]
    """The weights of the two Perp-Neg rows, <= 0; None without Perp-Neg."""
    empty: Optional[Float[Tensor, "_ N F"]] = None
    """The embedding of an empty prompt, if the variant needs it and the prompts have it; B rows if
    it depends on the view.
    """
    opposite: Optional[Float[Tensor, "B N F"]] = None
    """The prompts of the opposite views; None without view contrast, and with Perp-Neg, which
    excludes it.
    """

    def select(self, rows: Int[Tensor, " R"]) -> "Condition":
        """Return the conditions of some views."""
        views = len(self.embeddings) // (2 if self.negative_weights is None else 4)
        index = torch.cat([rows, views + rows])
        empty = self.empty if self.empty is None or len(self.empty) == 1 else self.empty[rows]
        if self.negative_weights is None:
            opposite = None if self.opposite is None else self.opposite[rows]
            return self._replace(embeddings=self.embeddings[index], empty=empty, opposite=opposite)
        pairs = 2 * (views + rows)[:, None] + torch.arange(2, device=rows.device)
        return self._replace(
            embeddings=self.embeddings[torch.cat([index, pairs.flatten()])],
            negative_weights=self.negative_weights[rows],
            empty=empty,
        )


def view_of_row(views: int, rows: int, device: torch.device | str = "cpu") -> Int[Tensor, " kB"]:
    """Return the view of each row of a :class:`Condition`: 0..B-1, 0..B-1, then 0, 0, 1, 1, ..."""
    order = torch.arange(views, device=device)
    return torch.cat([order, order, order.repeat_interleave(2)])[:rows]
