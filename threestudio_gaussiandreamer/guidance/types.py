"""What guidances and variants of score distillation pass to each other."""

from typing import Any, NamedTuple, Optional

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..core.errors import UserError

Batch = dict[str, Any]
Latents = Float[Tensor, "B c h w"]
"""Clean or noisy ones, noise, predictions of it, or gradients."""
Timesteps = Int[Tensor, " B"]
Good = Bool[Tensor, " B"]
"""Items whose residual is finite."""
Residual = tuple[Latents, Float[Tensor, " B"]]
"""A residual e of the latents, and abar of each item, float64, which gives e its weight."""
State = dict[str, Tensor]
Embeddings = Float[Tensor, "kB N F"]
"""Of a text-to-image network, a row for each row of a :class:`Condition`."""


class Noised(NamedTuple):
    """A batch of noisy latents, the input of the score model."""

    t: Timesteps
    abar: Float[Tensor, " B"]
    """float64."""
    noise: Latents
    z: Latents


class Condition(NamedTuple):
    """The text embeddings of B views, k rows per view, with what else a model is conditioned on in
    further tokens (:func:`.text_encoders.pack`).
    """

    embeddings: Embeddings
    """Prompts of all views, their negative prompts, and with Perp-Neg two rows of each view."""
    negative_weights: Optional[Float[Tensor, "B 2"]]
    """The weights of the two Perp-Neg rows, <= 0; None without Perp-Neg."""
    empty: Optional[Float[Tensor, "_ N F"]] = None
    """Of an empty prompt, if the variant needs it; B rows if it depends on the view."""
    opposite: Optional[Float[Tensor, "B N F"]] = None
    """The prompts of the opposite views; None without view contrast."""

    def select(self, rows: Int[Tensor, " R"]) -> "Condition":
        """Return the conditions of some views."""
        views = len(self.embeddings) // (2 if self.negative_weights is None else 4)
        index, weights = torch.cat([rows, views + rows]), self.negative_weights
        if weights is not None:
            pairs = 2 * (views + rows)[:, None] + torch.arange(2, device=rows.device)
            index, weights = torch.cat([index, pairs.flatten()]), weights[rows]
        empty = self.empty if self.empty is None or len(self.empty) == 1 else self.empty[rows]
        opposite = None if self.opposite is None else self.opposite[rows]
        return Condition(self.embeddings[index], weights, empty, opposite)


def view_of_row(views: int, rows: int, device: torch.device | str = "cpu") -> Int[Tensor, " kB"]:
    """Return the view of each row of a :class:`Condition`: 0..B-1, 0..B-1, then 0, 0, 1, 1, ..."""
    order = torch.arange(views, device=device)
    return torch.cat([order, order, order.repeat_interleave(2)])[:rows]


def items_of(batch: Batch, size: int, index: Any) -> Batch:
    """Select items of a batch of ``size`` items by what indexes a tensor's first dimension."""
    return {
        k: v[index] if isinstance(v, Tensor) and v.dim() and len(v) == size else v
        for k, v in batch.items()
    }


def require_pair(what: str, found: Any, accepted: list[tuple], expected: str) -> Any:
    """Return what a method returned; raise UserError unless it is a pair of one of the ``accepted``
    pairs of shapes, with "NoneType" for None: others might be broadcast.
    """
    entries = found if isinstance(found, (tuple, list)) else (found,)
    shapes = tuple(tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__ for x in entries)
    if entries is not found or shapes not in accepted:
        said = " and ".join(map(str, shapes))
        raise UserError(f"{what} returned {said}; expected {expected}")
    return found


def require_resumable(state: State, names: set[str]) -> None:
    """Raise UserError if the state in a checkpoint isn't empty and hasn't these tensors."""
    if state and set(state) != names:
        raise UserError(
            f"the checkpoint's guidance had learnt {len(state)} tensors that aren't those of this "
            "one: resume with the configuration that the run was started with"
        )
