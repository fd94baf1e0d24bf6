"""Losses and accuracies of classifiers of the attributes in LABELS."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

IGNORED = -100
"""The label of classes that losses ignore."""


def classified(logits: dict[str, Tensor], labels: Int[Tensor, "B L"]) -> tuple[Tensor, Tensor]:
    """Return the mean cross entropy over the attributes, and the share recognised."""
    pairs = list(zip(logits.values(), labels.unbind(1), strict=True))
    sums = [_summed_error(value.float(), label) for value, label in pairs]
    known = (labels != IGNORED).sum(dim=0).clamp(min=1)  # a batch may have no label of a column
    loss = (torch.stack(sums) / known).mean()
    right = torch.stack([(value.argmax(-1) == label).sum() for value, label in pairs]).sum()
    return loss, right / known.sum()


def _summed_error(logits: Float[Tensor, "B C"], label: Int[Tensor, " B"]) -> Tensor:
    return F.cross_entropy(logits, label, ignore_index=IGNORED, reduction="sum")


def accuracies(logits: dict[str, Tensor], labels: Int[Tensor, "B L"]) -> dict[str, float]:
    """Return the share recognised of each attribute."""
    out = {}
    for (name, value), label in zip(logits.items(), labels.unbind(1), strict=True):
        known = label != IGNORED
        out[name] = float((value.argmax(-1)[known] == label[known]).float().mean())
    return out
